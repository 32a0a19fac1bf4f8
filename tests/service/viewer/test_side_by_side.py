"""Two runs side by side: what differs is listed and coloured, and one camera moves both views."""

from collections.abc import Callable
from pathlib import Path

import pytest
from chromium import Visit, at, at_rest, rows
from playwright.sync_api import Route, expect
from stocked_state import Stock

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]
Stocked = tuple[str, Stock]


def test_two_methods_are_shown_side_by_side_with_what_differs(visit: Open, stocked: Stocked, tmp_path: Path) -> None:
    url, _ = stocked
    opened = at(visit, url, "#/jobs?q=Two+methods", reduced_motion="reduce")
    page = opened.page
    page.get_by_label("Actions for Two methods").click()
    page.get_by_role("link", name="Two methods in 3D").click()
    page.wait_for_selector("canvas[data-ready]")
    left, right = page.locator(".pair canvas").all()
    expect(left).to_have_attribute("data-models", "5")
    expect(right).to_have_attribute("data-models", "1")
    changes = page.get_by_role("group", name="Shown changes")
    expect(changes.locator("label")).to_have_text(["Gone 5", "Same 1"], use_inner_text=True)
    expect(rows(page, "Differences")).to_have_count(5)
    changes.get_by_role("checkbox", name="Same").check()
    expect(rows(page, "Differences")).to_have_count(6)

    before = at_rest(left), at_rest(right)
    left.focus()
    page.keyboard.press("ArrowLeft")
    expect(left).to_be_focused()
    after = at_rest(left), at_rest(right)
    assert after[0] != before[0], "the view does not turn"
    assert after[1] != before[1], "the other view does not follow"
    right.focus()
    page.keyboard.press("ArrowRight")
    assert at_rest(left) != after[0], "the left view does not follow the right one"

    rows(page, "Differences").filter(has_text="Same").get_by_role("link").click()
    expect(page.locator("tr[aria-current]")).to_contain_text("Same")
    expect(left).to_be_in_viewport(ratio=0.9)
    page.screenshot(path=tmp_path / "side_by_side.png", full_page=True)
    page.get_by_role("button", name="Swap").click()
    expect(changes).to_contain_text("New")
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") == 390


def test_another_run_is_chosen_and_a_run_without_difference_says_so(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    opened = at(visit, url, f"#/changes?old={stock.done}")
    page = opened.page
    main = page.get_by_role("main")
    expect(main).to_contain_text("Choose the runs that are shown side by side.")
    page.get_by_label("Right, or newer").select_option(
        label=page.get_by_label("Left, or older").locator("option:checked").inner_text()
    )
    page.wait_for_selector("canvas[data-ready]")
    expect(main).to_contain_text("No building differs above the limits.")
    expect(page).to_have_url(f"{url}#/changes?old={stock.done}&new={stock.done}")


def test_runs_of_two_versions_say_so_before_what_differs(visit: Open, stocked: Stocked, tmp_path: Path) -> None:
    url, stock = stocked
    opened = at(visit, url, "#/jobs")
    page = opened.page

    def answer(route: Route) -> None:
        response = route.fetch()
        # the reports are fetched at the same time: either may come first
        version = "0.2.0" if stock.done in route.request.url else "0.3.0"
        route.fulfill(response=response, json=response.json() | {"engine_version": version})

    page.route("**/results/report*", answer)
    page.goto(f"{url}#/changes?old={stock.done}&new={stock.compared}&newMethod=fuzzy-sart")
    page.wait_for_selector("canvas[data-ready]")
    main = page.get_by_role("main")
    expect(main).to_contain_text("The versions differ: left is of 0.2.0, right of 0.3.0.")
    expect(main).to_contain_text("Outlines and roofs may be drawn anew where nothing was built.")
    page.screenshot(path=tmp_path / "two_versions.png", full_page=True)
