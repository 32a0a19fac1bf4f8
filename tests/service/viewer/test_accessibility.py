"""Every view under the rules of axe-core, in light and dark, on a desk and on a phone; nothing is cut off."""

from collections.abc import Callable
from pathlib import Path

import pytest
from checkout import ROOT
from chromium import Visit, at
from playwright.sync_api import Page, expect
from processes import missing
from stocked_state import Stock

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]

AXE = ROOT / "service" / "viewer" / "node_modules" / "axe-core" / "axe.min.js"

LOOK = """async () => {
    const { violations } = await axe.run(document, { resultTypes: ["violations"] });
    const words = id => ({ html, failureSummary }) => `${id}: ${html} ${failureSummary}`;
    return violations.flatMap(({ id, nodes }) => nodes.map(words(id)));
}"""


def violations(page: Page) -> list[str]:
    """What the page breaks, one line per element."""
    if not AXE.is_file():
        missing("axe-core is not installed beside the page (`make viewer` does it)")
    page.evaluate(AXE.read_text(encoding="utf-8"))
    found: list[str] = page.evaluate(LOOK)
    return found


def places(stock: Stock) -> dict[str, str]:
    """Addresses, and words that are seen once the view is there."""
    return {
        "": "A LiDAR tile in",
        "#/jobs": "Delft West",
        "#/jobs?q=nothing": "No job fits",
        f"#/jobs/{stock.failed}": "An input could not be used",
        f"#/jobs/{stock.cancelled}": "This job was cancelled",
        f"#/jobs/{stock.running}": "Cancel the job",
        f"#/jobs/{stock.done}": "Pent",
        f"#/jobs/{'0' * 32}": "This job is not here",
        f"#/changes?old={stock.done}&new={stock.compared}&newMethod=fuzzy-sart-faithful": "Gone",
        "#/schedules": "Every night",
        f"#/schedules/{stock.schedule}": "What happened",
        f"#/schedules/new?job={stock.cancelled}": "Repeat this job",
        "#/webhooks": "the map server",
        f"#/webhooks/deliveries/{stock.undelivered}": "Mend the receiver",
    }


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_every_view_keeps_the_rules_and_its_width(
    visit: Open, stocked: tuple[str, Stock], width: int, scheme: str, tmp_path: Path
) -> None:
    url, stock = stocked
    opened = visit(url, viewport={"width": width, "height": 844}, color_scheme=scheme, reduced_motion="reduce")
    opened.expect_error("status of 404")
    page = opened.page
    broken: dict[str, list[str]] = {}
    for number, (place, words) in enumerate(places(stock).items()):
        page.evaluate("place => { location.hash = place }", place or "#/")
        expect(page.get_by_role("main")).to_contain_text(words)
        if place.endswith(stock.done):
            opened.wait_for_models()
        page.screenshot(path=tmp_path / f"{number:02}-{width}-{scheme}.png", full_page=True)
        found = violations(page)
        if page.evaluate("document.documentElement.scrollWidth") != width:
            found.append("the page is wider than the screen")
        if found:
            broken[place] = found
    assert broken == {}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_dialogs_and_menus_keep_the_rules(visit: Open, stocked: tuple[str, Stock], scheme: str, tmp_path: Path) -> None:
    url, _ = stocked
    page = at(visit, url, "#/jobs?q=Delft", color_scheme=scheme, viewport={"width": 390, "height": 844}).page
    menu = page.get_by_label("Actions for Delft Oost")
    menu.click()
    assert violations(page) == []
    page.get_by_role("button", name="Remove…").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    assert violations(page) == []
    page.keyboard.press("Escape")
    expect(menu).to_be_focused()
    menu.click()
    page.get_by_role("button", name="Try again…").click()
    expect(page.get_by_role("dialog", name="Try again")).to_be_visible()
    page.locator("dialog summary").click()
    page.screenshot(path=tmp_path / f"retry-{scheme}.png")
    assert violations(page) == []
