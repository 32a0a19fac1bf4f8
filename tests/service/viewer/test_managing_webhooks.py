"""Schedules and webhooks on the page: made, changed, removed, and what became of each time and each message."""

from collections.abc import Callable

import httpx
import pytest
from chromium import Visit, at, posted, rows
from playwright.sync_api import expect
from processes import wait_for
from stocked_state import HOOK, Stock

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]
Stocked = tuple[str, Stock]

LISTED = "http://127.0.0.1:9/hook"


def test_a_webhook_is_made_shown_with_its_secret_once_and_removed(visit: Open, stocked: Stocked) -> None:
    url, _ = stocked
    opened = at(visit, url, "#/webhooks")
    opened.expect_error("status of 403")
    page = opened.page
    page.get_by_role("button", name="New webhook…").click()
    form = page.get_by_role("dialog", name="New webhook")
    form.get_by_label("URL").fill("http://hooks.example.org/")
    form.get_by_label("Description").fill("ours")
    form.get_by_label("a job has begun").check()
    form.get_by_role("button", name="Make it").click()
    expect(form.get_by_role("alert")).to_contain_text("Use another URL")
    form.get_by_label("URL").fill(LISTED)
    form.get_by_role("button", name="Make it").click()
    secret = page.get_by_role("dialog", name="The secret", exact=True)
    assert secret.get_by_label("Secret", exact=True).input_value().startswith("whsec_")
    secret.get_by_role("button", name="Done").click()
    row = rows(page, "Receivers").filter(has_text="ours")
    expect(row).to_contain_text("a job has begun")
    made = next(one for one in httpx.get(f"{url}webhooks").json()["webhooks"] if one["url"] == LISTED)
    assert set(made["events"]) == {"job.running", "job.successful", "job.failed", "job.dismissed"}

    menu = page.get_by_label("Actions for ours")
    menu.click()
    page.get_by_role("button", name="Remove…").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove it").click()
    expect(row).to_have_count(0)
    assert HOOK in [one["url"] for one in httpx.get(f"{url}webhooks").json()["webhooks"]]


def test_the_log_of_messages_is_filtered_and_a_message_is_sent_again(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    opened = at(visit, url, "#/webhooks")
    page = opened.page
    expect(rows(page, "Messages")).to_have_count(25)
    page.get_by_label("State").select_option("delivered")
    expect(rows(page, "Messages")).to_have_count(1)
    expect(rows(page, "Messages")).to_contain_text("the map server")
    page.get_by_label("State").select_option("")
    page.get_by_label("Id of the job").fill(stock.failed)
    page.get_by_label("Id of the job").press("Enter")
    expect(rows(page, "Messages")).to_have_count(1)
    rows(page, "Messages").get_by_role("link", name="a job failed").click()
    main = page.get_by_role("main")
    expect(main).to_contain_text("the receiver answered 403")
    expect(main).to_contain_text("Mend the receiver")
    expect(rows(page, "Attempts")).to_have_count(1)
    expect(main.locator("pre")).to_contain_text('"type": "job.successful"')
    page.get_by_role("button", name="Send again").click()
    expect(main.locator(".chip")).to_have_text("waiting")
    expect(page.locator("#status")).to_have_text("The message is waiting.")
    delivery = page.url.rsplit("/", 1)[1]
    assert httpx.get(f"{url}webhooks/deliveries/{delivery}").json()["state"] == "waiting"
    main.get_by_role("link", name=stock.failed).click()
    page.get_by_label("Actions for Delft Oost").click()
    page.get_by_role("link", name="Messages about it").click()
    expect(rows(page, "Messages")).to_have_count(1)


def test_a_webhook_is_sent_what_it_missed(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    page = at(visit, url, "#/webhooks").page
    page.get_by_label("Actions for the map server").click()
    with page.expect_response(f"**/webhooks/{stock.webhook}/replay") as answered:
        page.get_by_role("button", name="Send what it missed").click()
    assert answered.value.status == 202
    expect(rows(page, "Receivers").filter(has_text="the map server").locator(".chip")).to_have_text("enabled")


def test_the_secret_of_a_key_is_shown_only_when_it_is_asked_for(visit: Open, stocked: Stocked) -> None:
    url, _ = stocked
    opened = at(visit, url, "#/webhooks")
    page = opened.page
    expect(rows(page, "Messages")).to_have_count(25)
    assert not [address for address in opened.urls if "secret" in address]
    page.get_by_role("button", name="Show the secret…").click()
    shown = page.get_by_role("dialog", name="The secret", exact=True).get_by_label("Secret", exact=True)
    assert shown.input_value() == httpx.get(f"{url}webhooks/secret").json()["secret"]


def test_a_key_that_is_not_admins_sees_its_own_messages_only(visit: Open, locked: tuple[str, str]) -> None:
    url, key = locked
    opened = visit(url)
    opened.expect_error("status of 401", "status of 403")
    page = opened.page
    page.get_by_label("Your key").fill(key)
    page.get_by_role("button", name="Use this key").click()
    expect(page.locator("#jobs")).to_contain_text("None yet")
    page.get_by_role("link", name="Jobs", exact=True).click()
    expect(page.get_by_text("No jobs yet.")).to_be_visible()
    page.get_by_role("link", name="Schedules", exact=True).click()
    expect(page.get_by_text("No schedules yet.")).to_be_visible()
    page.get_by_role("link", name="Webhooks", exact=True).click()
    expect(page.get_by_text("Only keys with the scope admin")).to_be_visible()
    expect(page.get_by_text("No messages yet")).to_be_visible()
    expect(page.get_by_role("button", name="New webhook…")).to_be_hidden()


def test_a_schedule_shows_its_next_times_and_what_happened(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    page = at(visit, url, "#/schedules").page
    expect(rows(page, "Schedules")).to_have_count(2)
    rows(page, "Schedules").get_by_role("link", name="Every night").click()
    found = httpx.get(f"{url}schedules/{stock.schedule}").json()
    times = page.locator(".facts-list ol li")
    expect(times).to_have_count(5)
    assert [
        time.replace(" ", "T") in found["nextTimes"][n]
        for n, time in enumerate(words[4:] for words in times.all_inner_texts())
    ] == [True] * 5
    expect(page.get_by_role("main")).to_contain_text("1 started, 2 skipped, 4 missed")
    outcomes = [one["outcome"] for one in httpx.get(f"{url}schedules/{stock.schedule}/runs").json()["runs"]]
    words = [{"submitted": "started"}.get(outcome, outcome) for outcome in outcomes]
    expect(rows(page, "What happened").locator(".chip")).to_have_text(words)
    page.get_by_label("Actions for Every night").click()
    page.get_by_role("link", name="Its jobs").click()
    expect(rows(page)).to_have_count(1)
    expect(page.get_by_role("main")).to_contain_text(f"Only jobs of schedule {stock.schedule[:8]}")


def test_a_schedule_is_made_from_a_job_paused_changed_run_and_removed(visit: Open, stocked: Stocked) -> None:
    url, stock = stocked
    opened = at(visit, url, f"#/jobs/{stock.cancelled}")
    opened.expect_error("status of 400")
    page = opened.page
    page.get_by_label("Actions for Cancelled by hand").click()
    page.get_by_role("link", name="Repeat on a schedule…").click()
    expect(page.get_by_label("Repeat this job")).to_have_value(stock.cancelled)
    expect(page.get_by_label("Title", exact=True).last).to_have_value("Cancelled by hand")
    main = page.get_by_role("main")
    main.get_by_label("Title").fill("Workdays")
    main.get_by_label("Times", exact=True).fill("30 2 * *")
    main.get_by_label("Time zone").fill("Europe/Amsterdam")
    page.get_by_role("button", name="Make the schedule").click()
    expect(main.get_by_role("alert")).to_contain_text("30 2 * *")
    main.get_by_label("Times", exact=True).fill("30 2 * * 1-5")
    with page.expect_request("**/schedules") as sent:
        page.get_by_role("button", name="Make the schedule").click()
    assert posted(sent.value)["execute"]["inputs"]["message"] == "hello"
    expect(main.get_by_role("heading", name="Workdays")).to_be_visible()
    schedule = page.url.rsplit("/", 1)[1]
    menu = page.get_by_label("Actions for Workdays")
    menu.click()
    page.get_by_role("button", name="Pause").click()
    expect(main).to_contain_text("none while it is paused")
    menu.click()
    page.get_by_role("button", name="Resume").click()
    expect(main.locator(".facts-list ol li")).to_have_count(5)
    menu.click()
    page.get_by_role("button", name="Change the times…").click()
    form = page.get_by_role("dialog", name="Change the times")
    form.get_by_label("When").select_option("every hour")
    form.get_by_role("button", name="Save").click()
    expect(main.locator("code").first).to_have_text("0 * * * *")
    assert httpx.get(f"{url}schedules/{schedule}").json()["cron"] == "0 * * * *"
    menu.click()
    page.get_by_role("button", name="Run now").click()
    expect(main.get_by_role("progressbar", name="Progress of the job")).to_be_visible()
    job = page.url.rsplit("/", 1)[1]
    assert httpx.get(f"{url}jobs/{job}").json()["scheduleID"] == schedule
    page.go_back()
    menu.click()
    page.get_by_role("button", name="Remove…").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove it").click()
    expect(page.get_by_role("dialog")).to_have_count(0)
    expect(rows(page, "Schedules").filter(has_text="Workdays")).to_have_count(0)
    wait_for(lambda: httpx.get(f"{url}schedules/{schedule}").status_code == 404, "the end of the schedule")
