"""The form: what a card says about a file, and what the page asks before it submits."""

from collections.abc import Callable
from pathlib import Path

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
