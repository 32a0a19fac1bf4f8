"""The history of jobs, and what can be done with a job; the service has jobs in every state."""

import re
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from chromium import Visit, at, posted, rows
from live_service import POINTS
from playwright.sync_api import expect
from stocked_state import Stock

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]
Stocked = tuple[str, Stock]


def cancelled_job(url: str, **inputs: object) -> str:
    """Id of a job on a tile that no driver has run; its upload is there."""
    with httpx.Client(base_url=url, timeout=60.0) as client:
        upload = client.post("uploads", params={"filename": "points.xyz"}, content=POINTS).raise_for_status().json()
        asked = {"tiles": [{"href": f"uploads/{upload['uploadID']}"}], "crs": "EPSG:28992", **inputs}
        job = client.post("processes/reconstruct/execution", json={"inputs": asked}).raise_for_status().json()["jobID"]
        assert client.delete(f"jobs/{job}").raise_for_status().json()["status"] == "dismissed"
        return str(job)


def test_the_history_is_searched_filtered_and_paged_and_its_address_leads_back(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    opened = visit(url)
    page = opened.page
    page.get_by_role("link", name="All jobs").click()
    expect(rows(page)).to_have_count(25)
    expect(page.get_by_role("navigation", name="Views").get_by_role("link", name="Jobs")).to_have_attribute(
        "aria-current", "page"
    )
    all_jobs = httpx.get(f"{url}jobs?limit=1").json()["numberMatched"]
    expect(page.locator(".pager")).to_contain_text(f"1 to 25 of {all_jobs}")
    page.get_by_role("link", name="Next").click()
    expect(rows(page)).to_have_count(all_jobs - 25)
    expect(page).to_have_url(f"{url}#/jobs?offset=25")
    page.go_back()
    expect(rows(page)).to_have_count(25)

    page.get_by_label("Search in title").fill("WEST")
    expect(rows(page)).to_have_count(1)
    expect(rows(page)).to_contain_text("6 buildings · 1 block · 1 failed")
    expect(rows(page)).to_contain_text("kept")
    expect(page.get_by_label("Search in title")).to_be_focused()
    page.reload()
    expect(page.get_by_label("Search in title")).to_have_value("WEST")
    expect(rows(page)).to_have_count(1)
    page.get_by_label("Search in title").fill(stock.failed[4:14])
    expect(rows(page).get_by_role("link", name="Delft Oost")).to_be_visible()
    page.get_by_label("Search in title").fill("no such words")
    page.get_by_role("link", name="Show all jobs").click()
    page.get_by_label("Status").select_option("failed")
    expect(rows(page)).to_have_count(1)
    expect(rows(page)).to_contain_text("An input could not be used")
    page.get_by_label("Status").select_option("")
    page.get_by_label("Process", exact=True).select_option("compare")
    expect(rows(page)).to_have_count(1)
    expect(rows(page)).to_contain_text("2 methods · 6 buildings")


def test_a_job_is_kept_and_no_longer_kept_from_its_menu(visit: Open, stocked: Stocked) -> None:
    url, _ = stocked
    page = at(visit, url, "#/jobs?q=Tile+no003").page
    menu = page.get_by_label("Actions for Tile no003")
    menu.click()
    page.get_by_role("button", name="Keep it", exact=True).click()
    expect(rows(page)).to_contain_text("kept")
    expect(page.locator("#status")).to_have_text("The job is kept.")
    expect(page.get_by_label("Actions for Tile no003")).to_be_visible()
    page.get_by_label("Actions for Tile no003").press("Enter")
    page.get_by_role("button", name="No longer keep it").press("Enter")
    expect(rows(page)).not_to_contain_text("kept")
    page.get_by_label("Actions for Tile no003").click()
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="Keep it", exact=True)).to_be_hidden()


def test_a_job_is_removed_only_after_a_question(visit: Open, stocked: Stocked) -> None:
    url, _ = stocked
    opened = at(visit, url, "#/jobs?q=Tile+no004")
    page = opened.page
    expect(rows(page)).to_have_count(1)
    job = rows(page).get_by_role("link").get_attribute("href").rsplit("/", 1)[1]
    page.get_by_label("Actions for Tile no004").click()
    page.get_by_role("button", name="Remove…").click()
    dialog = page.get_by_role("dialog", name="Remove the job?")
    expect(dialog).to_contain_text("Tile no004")
    expect(dialog.get_by_role("button", name="No, go back")).to_be_focused()
    page.keyboard.press("Enter")
    expect(dialog).to_have_count(0)
    assert httpx.get(f"{url}jobs/{job}").status_code == 200
    page.get_by_label("Actions for Tile no004").click()
    page.get_by_role("button", name="Remove…").click()
    dialog.get_by_role("button", name="Remove it").click()
    expect(page.get_by_text("No job fits.")).to_be_visible()
    assert httpx.get(f"{url}jobs/{job}").status_code == 404


def test_a_job_is_tried_again_with_other_settings(visit: Open, stocked: Stocked, tmp_path: Path) -> None:
    url, _ = stocked
    settings = {"method": "fuzzy-sart", "candidates": {"min_area_m2": 15.0, "min_width_m": 3.0}}
    job = cancelled_job(url, title="Again", settings=settings)
    opened = at(visit, url, f"#/jobs/{job}")
    opened.expect_error("status of 400")
    page = opened.page
    page.get_by_role("button", name="Try again…").click()
    dialog = page.get_by_role("dialog", name="Try again")
    expect(dialog.get_by_label("CRS", exact=True)).to_have_value("EPSG:28992")
    expect(dialog.get_by_label("Method", exact=True)).to_have_value("fuzzy-sart")
    dialog.get_by_label("Method", exact=True).select_option("kmeans")
    expect(dialog.get_by_label("candidates.min_area_m2", exact=True)).to_have_value("15")
    dialog.get_by_label("candidates.min_area_m2", exact=True).fill("100000")
    dialog.get_by_role("button", name="Remove candidates.min_width_m").click()
    dialog.get_by_label("Another setting").fill("candidates.min_height_m")
    dialog.get_by_label("Another setting").press("Enter")
    height = dialog.get_by_label("candidates.min_height_m", exact=True)
    expect(height).to_be_focused()
    height.fill("3.5")
    page.screenshot(path=tmp_path / "retry.png")
    dialog.get_by_role("button", name="Start the new job").click()
    # what the service refuses stays in the form, with the reason
    expect(dialog.get_by_role("alert")).to_contain_text("min_area_m2")
    dialog.get_by_label("candidates.min_area_m2", exact=True).fill("20")
    with page.expect_request("**/retry") as sent:
        dialog.get_by_role("button", name="Start the new job").click()
    changes = {"candidates": {"min_area_m2": 20, "min_width_m": None, "min_height_m": 3.5}}
    assert posted(sent.value) == {"inputs": {"method": "kmeans", "settings": changes}}
    expect(page.get_by_role("progressbar", name="Progress of the job")).to_be_visible()
    new = re.search(r"#/jobs/(\w{32})$", page.url)[1]
    assert new != job
    made = httpx.get(f"{url}jobs/{new}").json()["request"]["inputs"]
    assert made["settings"] == {"method": "kmeans", "candidates": {"min_area_m2": 20.0, "min_height_m": 3.5}}
    assert (made["title"], made["crs"]) == ("Again", "EPSG:28992")


def test_a_failed_job_says_why_and_what_to_do_and_one_that_is_gone_where_to_go(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    page = at(visit, url, f"#/jobs/{stock.failed}").page
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("An input could not be used")
    expect(alert).to_contain_text("set “CRS” under Options")
    expect(alert).to_contain_text("try again with another one")
    expect(page.get_by_role("button", name="Try again…")).to_be_visible()
    gone = at(visit, url, f"#/jobs/{'0' * 32}")
    gone.expect_error("status of 404")
    expect(gone.page.get_by_role("heading", name="This job is not here")).to_be_visible()
    gone.page.get_by_role("main").get_by_role("link", name="All jobs").click()
    expect(rows(gone.page)).to_have_count(25)


def test_only_a_job_that_runs_is_cancelled_after_a_question(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    opened = at(visit, url, f"#/jobs/{stock.running}")
    page = opened.page
    page.get_by_role("button", name="Cancel the job").click()
    dialog = page.get_by_role("dialog", name="Cancel the job?")
    expect(dialog).to_contain_text("is lost")
    # the way back is a way out of the dialog, too
    page.evaluate("location.hash = '#/jobs'")
    expect(dialog).to_have_count(0)
    assert httpx.get(f"{url}jobs/{stock.running}").json()["status"] == "running"
    page.evaluate(f"location.hash = '#/jobs/{stock.waiting}'")
    page.get_by_role("button", name="Cancel the job").click()
    expect(page.locator("#main")).to_contain_text("This job was cancelled")


def test_lists_wait_for_a_service_that_is_away(visit: Open, stocked: Stocked) -> None:
    url, _ = stocked
    opened = visit(url)
    opened.expect_error("ERR_INTERNET_DISCONNECTED")
    page = opened.page
    page.get_by_role("link", name="All jobs").click()
    expect(rows(page)).to_have_count(25)
    page.context.set_offline(True)
    page.get_by_label("Status").select_option("failed")
    alert = page.locator("main").get_by_role("alert")
    expect(alert).to_contain_text("The service does not answer")
    # a view that was not loaded yet says the same
    page.get_by_role("link", name="Schedules", exact=True).click()
    expect(page).to_have_url(f"{url}#/schedules")
    expect(page.get_by_label("Status")).to_have_count(0)
    expect(alert).to_contain_text("The service does not answer")
    page.context.set_offline(False)
    page.go_back()
    expect(rows(page)).to_have_count(1)
