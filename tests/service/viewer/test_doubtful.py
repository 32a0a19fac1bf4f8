"""Doubtful models on the page, in a real Chromium: list, map, legend, record, dossier, and downloads without them."""

import hashlib
import json
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from chromium import Visit, at_rest
from finished_jobs import finished_job
from playwright.sync_api import expect

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]


def records_of(shared_service: str, job: str) -> dict[str, dict[str, Any]]:
    """The records of a job's buildings, by id."""
    features = httpx.get(f"{shared_service}jobs/{job}/buildings", params={"limit": 1000}).json()["features"]
    return {feature["id"]: feature["properties"] for feature in features}


@pytest.fixture(scope="module")
def job(shared_service: str, suburb_job: str, tile: Path) -> str:
    """A job of which some models are doubtful: those that explain fewer of their points than the median."""
    usual = records_of(shared_service, suburb_job)
    least = round(statistics.median(one["share_within_0_2m"] for one in usual.values()), 3)
    return finished_job(shared_service, tile, settings={"support": {"min_share_on_roof": least}})


def test_doubtful_models_come_first_and_say_why_with_figure_and_threshold(
    visit: Open, shared_service: str, job: str, tmp_path: Path
) -> None:
    records = records_of(shared_service, job)
    doubtful = {name for name, one in records.items() if one["status"] == "doubtful"}
    ok = {name for name, one in records.items() if one["status"] == "ok"}
    assert doubtful
    assert ok
    opened = visit(shared_service)
    opened.open_job(job)
    page = opened.page
    expect(page.locator(".result-title")).to_contain_text(f"{len(records)} buildings · {len(doubtful)} doubtful")
    ids = page.locator(".buildings .building-id").all_inner_texts()
    assert set(ids[: len(records) - len(ok)]).isdisjoint(ok)
    expect(page.locator(".legend")).to_contain_text(f"Doubtful model {len(doubtful)}", use_inner_text=True)

    name = next(name for name in ids if name in doubtful)
    page.goto(f"{shared_service}#/jobs/{job}/buildings/{name}")
    detail = records[name]["reason_detail"]
    assert "of its roof returns lie within 0.2 m of the roof, less than" in detail
    expect(page.locator(".record")).to_contain_text(detail)
    page.locator(".record").get_by_role("link", name="Dossier").click()
    dossier = page.get_by_role("dialog", name="Dossier")
    expect(dossier).to_contain_text(f"The model is doubtful: too few of its points lie on the model: {detail}.")
    expect(dossier.locator("tr", has_text="Points on the roof")).to_contain_text("too few: the model is doubtful")
    page.screenshot(path=tmp_path / "dossier.png")


def test_the_map_has_the_colours_of_the_legend(visit: Open, shared_service: str, job: str, tmp_path: Path) -> None:
    opened = visit(shared_service)
    opened.open_job(job)
    page = opened.page
    page.get_by_role("button", name="Map", exact=True).click()
    canvas = page.locator(".map-canvas")
    pictures = {}
    for colouring in ("type", "status", "residual", "reason"):
        page.get_by_label("Colour", exact=True).select_option(colouring)
        at_rest(canvas)
        pictures[colouring] = hashlib.sha256(canvas.screenshot(path=tmp_path / f"{colouring}.png")).hexdigest()
    assert len(set(pictures.values())) == len(pictures)


def test_the_models_that_are_ok_are_downloaded_alone(visit: Open, shared_service: str, job: str) -> None:
    ok = {name for name, one in records_of(shared_service, job).items() if one["status"] == "ok"}
    opened = visit(shared_service)
    opened.open_job(job)
    page = opened.page
    page.locator(".menu summary", has_text="Download").click()
    links = page.locator(".menu-list a[download]")
    everything = links.count()
    box = page.get_by_label(f"Only the {len(ok)} models that are ok")
    box.focus()
    page.keyboard.press("Space")
    expect(page.locator('.menu-list a[href$="/results/geojson?status=ok"]')).to_be_visible()
    expect(box).to_be_focused()
    with page.expect_download() as download:
        page.get_by_role("link", name="GeoJSON").click()
    assert download.value.suggested_filename.endswith("ok-buildings.geojson")
    features = json.loads(Path(download.value.path()).read_text())["features"]
    assert {feature["id"] for feature in features} == ok
    box.uncheck()
    expect(links).to_have_count(everything)
