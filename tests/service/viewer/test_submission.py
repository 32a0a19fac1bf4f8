"""The form: what a card says about a file, and what the page asks before it submits."""

import json
from collections.abc import Callable
from pathlib import Path

import laspy
import pyproj
import pytest
from chromium import Visit
from playwright.sync_api import expect

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]

LONG_NAME = "LHD_FXX_0643_6864_PTS_LAMB93_IGN69_2021_06_12.laz"
"""As those of the IGN: nothing in it may be broken over lines by itself."""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1000])
def test_a_long_name_stays_within_its_card_with_the_button_that_removes_it(
    visit: Open, service: str, house: Path, width: int, scheme: str, tmp_path: Path
) -> None:
    tile = tmp_path / LONG_NAME
    tile.write_bytes(house.read_bytes())
    opened = visit(service, viewport={"width": width, "height": 844}, color_scheme=scheme)
    opened.drop(tile)
    page = opened.page
    page.screenshot(path=tmp_path / f"{width}-{scheme}.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    card = page.locator(".file").bounding_box()
    name = page.locator(".file-name")
    button = page.get_by_role("button", name=f"Remove {LONG_NAME}").bounding_box()
    assert button["x"] + button["width"] <= card["x"] + card["width"]
    assert name.evaluate("name => name.scrollWidth <= name.clientWidth"), "the end of the name is cut off"
    page.get_by_role("button", name=f"Remove {LONG_NAME}").click()
    expect(page.locator(".file")).to_have_count(0)


def _in_the_dutch_grid(house: Path, folder: Path) -> Path:
    """The house with a header that has the grid of the Netherlands."""
    las = laspy.read(house)
    las.header.vlrs = [record for record in las.header.vlrs if "LASF_Projection" not in record.user_id]
    las.header.add_crs(pyproj.CRS.from_user_input("EPSG:28992"))
    path = folder / "wrong.laz"
    las.write(path)
    return path


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (390, "dark"), (1280, "light"), (1280, "dark")])
def test_a_wrong_crs_is_shown_with_the_place_and_waits_for_a_correction_or_a_confirmation(
    visit: Open, service: str, house: Path, width: int, scheme: str, tmp_path: Path
) -> None:
    opened = visit(service, viewport={"width": width, "height": 844}, color_scheme=scheme)
    page = opened.page
    opened.drop(house)
    expect(page.locator(".file")).to_contain_text("Lies at 53.55°")
    expect(page.get_by_label("Use the tiles where they lie")).to_be_hidden()
    page.get_by_role("button", name="Remove").click()

    opened.drop(_in_the_dutch_grid(house, tmp_path))
    card = page.locator(".file")
    expect(card).to_contain_text("Netherlands")
    expect(card).to_contain_text("“CRS” under Options")
    expect(card).not_to_contain_text("--")
    button = page.locator("button[type=submit]")
    expect(button).to_have_text("Correct the CRS")
    expect(button).to_have_attribute("aria-disabled", "true")
    page.screenshot(path=tmp_path / f"outside-{width}-{scheme}.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.get_by_label("CRS", exact=True).fill("EPSG:25832")
    expect(button).to_have_text("Reconstruct")
    page.get_by_label("CRS", exact=True).fill("")
    page.get_by_label("Use the tiles where they lie").check()
    expect(button).to_have_attribute("aria-disabled", "false")
    with page.expect_request("**/execution") as sent:
        button.click()
    assert json.loads(sent.value.post_data or "")["inputs"]["allowOutsideAreaOfUse"] is True


def test_a_wrong_crs_of_the_form_is_refused_with_the_place_and_can_be_confirmed(
    visit: Open, service: str, house: Path, tmp_path: Path
) -> None:
    opened = visit(service)
    opened.expect_error("status of 422")
    page = opened.page
    opened.drop(house)
    page.locator("summary", has_text="Options").click()
    page.get_by_label("CRS", exact=True).fill("EPSG:28992")
    page.locator("button[type=submit]").click()
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("gable.laz: in EPSG:28992")
    expect(alert).to_contain_text("“CRS” under Options")
    box = page.get_by_label("Use the tiles where they lie")
    expect(box).to_be_visible()
    page.screenshot(path=tmp_path / "refused.png", full_page=True)
    box.check()
    with page.expect_response("**/execution") as answer:
        page.locator("button[type=submit]").click()
    assert answer.value.status == 201


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1280, "dark")])
def test_the_dialog_about_the_key_speaks_to_users(
    visit: Open, locked: tuple[str, str], width: int, scheme: str, tmp_path: Path
) -> None:
    url, _ = locked
    opened = visit(url, viewport={"width": width, "height": 844}, color_scheme=scheme)
    opened.expect_error("status of 401")
    dialog = opened.page.get_by_role("dialog")
    expect(dialog).to_contain_text("This service needs a key")
    opened.page.screenshot(path=tmp_path / f"key-{width}-{scheme}.png")
    words = dialog.inner_text()
    for jargon in ("header", "Bearer", "Authorization", "gablework keys", "--"):
        assert jargon not in words
    dialog.get_by_label("Your key").fill("gw_" + "0" * 40)
    dialog.get_by_role("button", name="Use this key").click()
    expect(opened.page.get_by_role("dialog")).to_contain_text("This key is not valid")
