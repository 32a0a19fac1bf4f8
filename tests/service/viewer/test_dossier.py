"""The dossier of a building in a real Chromium: its own address, its drawings, what it says, how it is printed."""

import re
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from chromium import Visit
from playwright.sync_api import expect

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]


@pytest.fixture(scope="module")
def building(shared_service: str, house_job: str) -> tuple[str, str]:
    """A finished job, and its gabled house."""
    buildings = f"{shared_service}jobs/{house_job}/buildings"
    (found,) = httpx.get(buildings, params={"roof_type": "gable"}).json()["features"]
    return house_job, found["id"]


def test_a_record_leads_to_the_dossier_and_its_address_can_be_shared(
    visit: Open, shared_service: str, building: tuple[str, str]
) -> None:
    job, name = building
    opened = visit(f"{shared_service}#/jobs/{job}/buildings/{name}")
    opened.url = shared_service
    opened.elsewhere.clear()
    page = opened.page
    opened.wait_for_models()
    assert not [address for address in opened.urls if "dossier" in address], "its scripts are loaded when it is opened"
    page.locator(".record").get_by_role("link", name="Dossier").click()
    dossier = page.get_by_role("dialog", name="Dossier")
    expect(dossier.get_by_role("img", name="The building from above, north up")).to_be_visible()
    expect(page).to_have_url(re.compile(f"/buildings/{name}/dossier$"))
    page.reload()
    opened.wait_for_models()
    expect(dossier.get_by_role("img", name="A section through the building")).to_be_visible()
    page.keyboard.press("Escape")
    expect(dossier).to_have_count(0)
    expect(page).to_have_url(re.compile(f"/buildings/{name}$"))
    expect(page.locator(".record-id")).to_have_text(name)


def test_a_dossier_draws_the_model_and_says_what_decided(
    visit: Open, shared_service: str, building: tuple[str, str], tmp_path: Path
) -> None:
    job, name = building
    answer = httpx.get(f"{shared_service}jobs/{job}/buildings/{name}/decisions").raise_for_status()
    decisions = answer.json()["decisions"]
    opened = visit(f"{shared_service}#/jobs/{job}/buildings/{name}/dossier")
    opened.url = shared_service
    opened.elsewhere.clear()
    page = opened.page
    opened.wait_for_models()
    dossier = page.get_by_role("dialog", name="Dossier")
    expect(dossier.locator(".edge-ridge")).to_have_count(1)
    expect(dossier.locator(".cut-roof")).to_have_count(2)
    expect(dossier.locator(".cut-wall")).to_have_count(2)
    expect(dossier.get_by_text("valid by the rules of ISO 19107")).to_be_visible()
    expect(dossier.locator(".dossier-nopoints")).to_contain_text("holds no points")
    expect(dossier.locator("canvas[data-drawn]")).to_be_visible()
    figures = dossier.locator(".dossier-table").first
    points = next(entry["value"] for entry in decisions if entry["name"] == "roof_points")
    expect(figures.get_by_role("row", name=re.compile("^Roof points ")).first).to_contain_text(f"{points:.0f} points")
    forms = [entry for entry in decisions if entry["kind"] == "form"]
    rows = dossier.locator(".dossier-table").last.locator("tbody tr")
    expect(rows).to_have_count(len(forms))
    expect(dossier.locator(".dossier-chosen")).to_contain_text("chosen")
    page.emulate_media(media="print")
    expect(page.locator("header.bar")).to_be_hidden()
    expect(dossier.get_by_role("button", name="Print")).to_be_hidden()
    pages = re.findall(rb"/Type\s*/Page[^s]", page.pdf(path=tmp_path / "dossier.pdf", prefer_css_page_size=True))
    assert 1 <= len(pages) <= 2
    page.emulate_media(media="screen")
    canvas = dossier.locator("canvas").element_handle()
    dossier.get_by_role("button", name="Close").click()
    expect(page.locator(".dossier")).to_have_count(0)
    # browsers allow a page few contexts at a time
    assert canvas.evaluate("canvas => canvas.getContext('webgl2').isContextLost()")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_dossier_fits_a_narrow_screen(
    visit: Open, shared_service: str, building: tuple[str, str], scheme: str, tmp_path: Path
) -> None:
    job, name = building
    opened = visit(
        f"{shared_service}#/jobs/{job}/buildings/{name}/dossier",
        viewport={"width": 390, "height": 844},
        color_scheme=scheme,
    )
    opened.url = shared_service
    opened.elsewhere.clear()
    opened.wait_for_models()
    dossier = opened.page.get_by_role("dialog", name="Dossier")
    expect(dossier.locator("canvas[data-drawn]")).to_be_visible()
    assert dossier.evaluate("dialog => dialog.scrollWidth") <= 390
    opened.page.screenshot(path=tmp_path / f"{scheme}.png")
