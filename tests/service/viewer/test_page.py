"""The web page in a real Chromium, against a real service: from a dropped tile to a record and its files."""

import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path

import httpx
import laspy
import numpy as np
import pyproj
import pytest
from chromium import Visit, inside_of, of_hue
from finished_jobs import finished_job
from playwright.sync_api import expect

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]

STAGES = [
    "Prepare the inputs",
    "Plan the tiles",
    "Read the points",
    "Mark duplicates and outliers",
    "Find the ground",
    "Find walls and roofs",
    "Join surfaces over borders",
    "Separate and outline the buildings",
    "Model the buildings",
    "Write the results",
    "Assemble the downloads",
]
SEE_STAGES = """() => {
    window.stagesSeen = [];
    new MutationObserver(() => {
        const now = document.querySelector(".stage-now")?.textContent;
        if (now && window.stagesSeen.at(-1) !== now) window.stagesSeen.push(now);
    }).observe(document.body, { subtree: true, childList: true, attributes: true, characterData: true });
}"""
"""Keeps what the page showed: a stage of a small job is over sooner than a test can look."""


@pytest.fixture(scope="module")
def finished(service: str, tile: Path) -> str:
    """Id of a finished job, submitted as any client would."""
    return finished_job(service, tile)


def test_a_dropped_tile_becomes_models_and_a_click_on_one_shows_its_record(
    visit: Open, service: str, tile: Path, tmp_path: Path
) -> None:
    opened = visit(service)
    page = opened.page
    opened.drop(tile)
    page.evaluate(SEE_STAGES)
    page.get_by_role("button", name="Reconstruct").click()
    progress = page.get_by_role("progressbar", name="Progress of the job")
    expect(progress).to_be_visible()
    expect(page.locator("#status")).not_to_be_empty()

    opened.wait_for_models()
    seen = [
        next(k for k, stage in enumerate(STAGES) if shown.startswith(stage)) for shown in page.evaluate("stagesSeen")
    ]
    assert seen
    assert seen == sorted(seen)
    job = re.search(r"#/jobs/(\w{32})$", page.url)
    listed = httpx.get(f"{service}jobs/{job[1]}/buildings", params={"limit": 1}).json()["numberMatched"]
    expect(page.locator("canvas")).to_have_attribute("data-models", str(listed))
    seen = opened.pixels(tmp_path / "models.png")
    gables = of_hue(seen, "gable")
    assert gables.mean() > 0.002, "no gable roof is seen"
    for other in ("hip", "pent", "combination"):
        assert of_hue(seen, other).any(), f"no {other} roof is seen"

    column, row = inside_of(gables)
    page.locator("canvas").click(position={"x": column, "y": row})
    record = page.locator(".record")
    expect(record.get_by_role("heading", name="Gable roof")).to_be_visible()
    building = page.url.rsplit("/", 1)[1]
    reported = httpx.get(f"{service}jobs/{job[1]}/buildings/{building}").json()["properties"]
    assert reported["roof_type"] == "gable"
    ridge = record.locator("dt", has_text="Ridge above floor").locator("xpath=following-sibling::dd[1]")
    # heights have millimetres, of which a half is rounded up
    height_m = Decimal(str(reported["height_m"])).quantize(Decimal("0.01"), ROUND_HALF_UP)
    expect(ridge).to_have_text(f"{height_m}\u202fm")
    expect(record.locator("tbody tr")).to_have_count(reported["n_planes"])
    page.screenshot(path=tmp_path / "record.png")
    assert (opened.pixels() != seen).any(axis=2).mean() > 0.0005, "the chosen building is not marked"


def test_a_reload_brings_back_job_and_building(visit: Open, service: str, finished: str) -> None:
    first = httpx.get(f"{service}jobs/{finished}/buildings", params={"limit": 1}).json()["features"][0]["id"]
    opened = visit(f"{service}#/jobs/{finished}/buildings/{first}")
    opened.url = service
    opened.elsewhere.clear()
    opened.wait_for_models()
    expect(opened.page.locator(".record-id")).to_have_text(first)
    opened.page.reload()
    opened.wait_for_models()
    expect(opened.page.locator(".record-id")).to_have_text(first)


def test_every_download_is_the_file_that_the_results_name(visit: Open, service: str, finished: str) -> None:
    results = httpx.get(f"{service}jobs/{finished}/results").json()
    opened = visit(service)
    opened.open_job(finished)
    opened.page.locator(".menu summary", has_text="Download").click()
    links = opened.page.locator(".menu-list a[download]")
    expect(links).to_have_count(len(results))
    digests = set()
    for n in range(len(results)):
        with opened.page.expect_download() as download:
            links.nth(n).click()
        digests.add(hashlib.sha256(Path(download.value.path()).read_bytes()).hexdigest())
    assert digests == {entry["sha256"] for entry in results.values()}

    opened.page.keyboard.press("Escape")
    expect(links.first).to_be_hidden()
    opened.page.locator(".building").first.click()
    expect(opened.page.locator(".record dl").first).to_be_visible()
    building = opened.page.url.rsplit("/", 1)[1]
    with opened.page.expect_download() as download:
        opened.page.get_by_role("link", name="OBJ", exact=True).click()
    assert Path(download.value.path()).read_bytes().count(b"\nv ") > 3
    with opened.page.expect_download() as download:
        opened.page.locator(".record").get_by_role("link", name="CityJSON").click()
    assert building in json.loads(Path(download.value.path()).read_text())["CityObjects"]


def test_the_legend_hides_and_shows_a_roof_type(visit: Open, service: str, finished: str) -> None:
    opened = visit(service)
    opened.open_job(finished)
    before = of_hue(opened.pixels(), "hip").sum()
    tally = opened.page.locator(".list-title .tally")
    listed = tally.inner_text()
    box = opened.page.get_by_role("checkbox", name="Hip")
    box.uncheck()
    expect(tally).not_to_have_text(listed)
    assert of_hue(opened.pixels(), "hip").sum() < 0.1 * before
    assert int(tally.inner_text()) < int(listed)
    box.check()
    expect(tally).to_have_text(listed)
    assert of_hue(opened.pixels(), "hip").sum() > 0.9 * before


def test_the_way_to_a_record_and_back_needs_no_pointer(visit: Open, service: str, finished: str) -> None:
    opened = visit(service)
    page = opened.page
    page.locator(f'a[href="#/jobs/{finished}"]').focus()
    page.keyboard.press("Enter")
    opened.wait_for_models()
    page.locator("canvas").focus()
    still = opened.pixels()
    page.keyboard.press("ArrowLeft")
    assert (opened.pixels() != still).any(), "the arrow key does not turn the view"
    page.keyboard.press("Tab")
    page.locator(".building").nth(3).focus()
    chosen = page.locator(".building").nth(3).get_attribute("href")
    page.keyboard.press("Enter")
    expect(page.locator(".record dl").first).to_be_visible()
    expect(page.get_by_role("button", name="All buildings")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator(f'.building[href="{chosen}"]')).to_be_focused()


def test_a_comparison_shows_each_method_and_the_page_of_all(
    visit: Open, service: str, tmp_path: Path, house: Path
) -> None:
    opened = visit(service)
    page = opened.page
    opened.drop(house)
    page.locator("summary", has_text="Options").click()
    expect(page.get_by_label("Method", exact=True)).to_have_value("arrangement")
    expect(page.get_by_role("checkbox", name="arrangement", exact=True)).to_be_disabled()
    expect(page.get_by_role("checkbox", name="arrangement, faithful")).to_have_count(0)
    page.get_by_label("Method", exact=True).select_option("fuzzy-sart")
    expect(page.get_by_label("Preset")).to_have_value("robust")
    # what is chosen above cannot be chosen once more
    expect(page.get_by_role("checkbox", name="fuzzy-sart", exact=True)).to_be_disabled()
    page.get_by_role("checkbox", name="fuzzy-sart, faithful").check()
    page.get_by_role("checkbox", name="kmeans", exact=True).check()
    page.get_by_role("button", name="Compare 3 methods").click()
    opened.wait_for_models()
    found = re.search(r"#/jobs/(\w{32})$", page.url)
    reported = httpx.get(f"{service}jobs/{found[1]}").json()
    labels = ["fuzzy-sart", "fuzzy-sart-faithful", "kmeans"]
    assert (reported["processID"], list(reported["summary"]["runs"])) == ("compare", labels)

    page.locator(".building").first.click()
    building = page.locator(".record-id").inner_text()
    choice = page.get_by_role("combobox", name="Models of the method")
    expect(choice.locator("option")).to_have_text(labels)
    with page.expect_response(lambda answer: answer.url.endswith("/results/cityjson?method=kmeans")):
        choice.select_option("kmeans")
    opened.wait_for_models()
    expect(page.locator(".record-id")).to_have_text(building)
    expect(page).to_have_url(f"{service}#/jobs/{found[1]}/methods/kmeans/buildings/{building}")
    planes = httpx.get(f"{service}jobs/{found[1]}/buildings/{building}?method=kmeans").json()["properties"]["n_planes"]
    expect(page.locator(".record tbody tr")).to_have_count(planes)
    page.screenshot(path=tmp_path / "kmeans.png")
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.set_viewport_size({"width": 1280, "height": 800})

    page.locator(".menu summary", has_text="Download").click()
    with page.expect_download() as download:
        page.get_by_role("link", name="The whole comparison in a zip file").click()
    with zipfile.ZipFile(download.value.path()) as archive:
        assert {f"runs/{label}/run.json" for label in labels} <= set(archive.namelist())

    with page.context.expect_page() as other:
        page.locator(".job-page a").first.click()
    side_by_side = Visit(other.value, service)
    other.value.wait_for_load_state()
    expect(other.value.get_by_role("heading", level=1)).to_contain_text("kmeans")
    assert other.value.evaluate("self.origin") == "null", "the page could reach the service"
    other.value.screenshot(path=tmp_path / "side_by_side.png")
    other.value.reload()
    other.value.wait_for_load_state()
    assert (side_by_side.errors, side_by_side.elsewhere) == ([], [])


def test_levels_of_detail_are_chosen_for_the_job_and_in_the_view(
    visit: Open, service: str, house: Path, finished: str, tmp_path: Path
) -> None:
    opened = visit(service)
    page = opened.page
    opened.drop(house)
    page.locator("summary", has_text="Options").click()
    boxes = page.get_by_role("group", name="Levels of detail").get_by_role("checkbox")
    names = ["one block", "level parts", "main roof", "roof faces", "roof faces with overhangs"]
    levels = ["LoD1.2", "LoD1.3", "LoD2.0", "LoD2.2", "LoD2.3"]
    expect(boxes.locator("..")).to_have_text([f"{lod}: {name}" for lod, name in zip(levels, names, strict=True)])
    assert [box.is_checked() for box in boxes.all()] == [False, False, False, True, False]
    button = page.locator("button[type=submit]")
    boxes.nth(3).uncheck()
    expect(button).to_have_text("Choose a level of detail")
    expect(button).to_have_attribute("aria-disabled", "true")
    other = page.get_by_role("checkbox", name="kmeans", exact=True)
    other.check()
    expect(boxes.first).to_be_hidden()
    expect(button).to_have_text("Compare 2 methods")
    other.uncheck()
    for box in reversed(boxes.all()[:4]):
        box.check()
    with page.expect_request("**/execution") as sent:
        button.click()
    assert json.loads(sent.value.post_data or "")["inputs"]["lods"] == "1.2,1.3,2.0,2.2"

    opened.wait_for_models()
    page.locator(".building").first.click()
    expect(page.locator(".record dl").first).to_be_visible()
    choice = page.locator(".tools").get_by_role("group", name="Level of detail").get_by_role("button")
    expect(choice).to_have_text(levels[:4])
    expect(choice.last).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Fit").click()
    roof = opened.pixels_at_rest()
    choice.first.click()
    expect(choice.first).to_have_attribute("aria-pressed", "true")
    expect(choice.last).to_have_attribute("aria-pressed", "false")
    block = opened.pixels()
    assert (block != roof).any(axis=2).mean() > 0.01, "the block looks like the roof"
    expect(page.locator("canvas")).to_have_attribute("data-models", "1")
    choice.last.click()
    expect(choice.last).to_have_attribute("aria-pressed", "true")
    assert (opened.pixels_at_rest() != roof).any(axis=2).mean() < 0.001, "the view has moved"

    opened.open_job(finished)  # of one level
    expect(page.get_by_role("button", name="Fit")).to_be_visible()
    expect(page.get_by_role("button", name="LoD2.2")).to_have_count(0)


def test_a_refused_file_is_reported_with_what_to_do(visit: Open, service: str, tmp_path: Path) -> None:
    broken = tmp_path / "broken.laz"
    broken.write_bytes(b"LASF" + bytes(500))
    opened = visit(service)
    opened.expect_error("status of 4")
    opened.page.set_input_files("#tiles", broken)
    alert = opened.page.get_by_role("alert")
    expect(alert).to_contain_text("broken.laz")
    button = opened.page.locator("button[type=submit]")
    expect(button).to_have_attribute("aria-disabled", "true")
    opened.page.get_by_role("button", name="Remove broken.laz").click()
    expect(alert).to_have_count(0)


def test_a_tile_without_crs_asks_for_one(visit: Open, service: str, tmp_path: Path) -> None:
    bare = _field(tmp_path / "bare.laz", crs=None)
    opened = visit(service)
    opened.page.set_input_files("#tiles", bare)
    expect(opened.page.locator(".facts")).to_contain_text("no CRS")


def test_a_result_without_buildings_says_what_to_try(visit: Open, service: str, tmp_path: Path) -> None:
    job = finished_job(service, _field(tmp_path / "field.laz", with_hut=True))
    opened = visit(service)
    opened.choose_job(job)
    expect(opened.page.get_by_role("heading", name="No building was found")).to_be_visible()
    expect(opened.page.locator(".stage-note")).to_contain_text("1 object was looked at and left out")
    expect(opened.page.locator(".stage-note")).to_contain_text("vertical unit")
    opened.page.get_by_role("button", name="Without a model").click()
    expect(opened.page.locator(".building")).to_have_count(1)
    expect(opened.page.locator(".stage-note .card")).to_have_count(0)
    opened.page.locator(".building").click()
    expect(opened.page.locator(".record").get_by_role("heading", name="Not a building")).to_be_visible()


def _field(path: Path, crs: str | None = "EPSG:25832", *, with_hut: bool = False) -> Path:
    """A hundred by hundred metres of meadow, with a hut of 3 by 3 m and 1.6 m if asked for: too low for a building."""
    rng = np.random.default_rng(11)
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.scales = np.full(3, 0.001)
    header.offsets = np.array([565_000.0, 5_934_000.0, 0.0])
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    x, y = rng.uniform(0.0, 100.0, (2, 40_000))
    hut = with_hut & (np.abs(x - 50.0) < 1.5) & (np.abs(y - 50.0) < 1.5)
    z = 90.0 + 0.01 * x + 1.6 * hut + rng.normal(0.0, 0.02, x.size)
    las.x, las.y, las.z = 565_000.0 + x, 5_934_000.0 + y, z
    las.return_number = las.number_of_returns = np.ones(x.size, dtype=np.uint8)
    las.write(path)
    return path


def test_a_key_is_asked_for_kept_for_the_tab_and_never_put_into_an_address(
    visit: Open, locked: tuple[str, str], tile: Path
) -> None:
    url, key = locked
    opened = visit(url)
    opened.expect_error("status of 401")
    page = opened.page
    field = page.get_by_label("Your key")
    expect(field).to_be_visible()
    field.fill(key)
    page.get_by_role("button", name="Use this key").click()
    expect(page.locator("#jobs")).to_contain_text("None yet")
    page.set_input_files("#tiles", tile)
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.locator(".message")).to_contain_text("driver")
    page.get_by_role("button", name="Cancel the job").click()
    expect(page.locator("#main")).to_contain_text("This job was cancelled")
    expect(page.locator(".job .chip")).to_have_text("cancelled")
    assert page.evaluate("Object.values(sessionStorage)") == [key]
    assert page.evaluate("Object.values(localStorage)") == []
    assert not [address for address in opened.urls if key in address]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1000])
def test_nothing_is_cut_off_on_narrow_screens(
    visit: Open, service: str, finished: str, width: int, scheme: str, tmp_path: Path
) -> None:
    opened = visit(service, viewport={"width": width, "height": 844}, color_scheme=scheme)
    opened.open_job(finished)
    assert opened.page.evaluate("document.documentElement.scrollWidth") == width
    box = opened.canvas.bounding_box()
    assert box["width"] > 0.4 * width
    assert of_hue(opened.pixels(), "gable").any()
    opened.page.screenshot(path=tmp_path / f"{width}-{scheme}.png", full_page=True)


def test_a_job_that_came_of_a_schedule_is_marked_in_the_list(visit: Open, service: str, tile: Path) -> None:
    with httpx.Client(base_url=service, timeout=60.0) as client:
        upload = client.post("uploads", params={"filename": tile.name}, content=tile.read_bytes()).raise_for_status()
        inputs = {"tiles": [{"href": f"uploads/{upload.json()['uploadID']}"}]}
        asked = {"title": "every night", "cron": "@daily", "paused": True, "execute": {"inputs": inputs}}
        schedule = client.post("schedules", json=asked).raise_for_status().json()["scheduleID"]
        job = client.post(f"schedules/{schedule}/run").raise_for_status().json()["jobID"]
        entry = visit(service).page.locator(f".job[href='#/jobs/{job}']")
        expect(entry.locator(".job-title")).to_have_text("every night")
        expect(entry.locator(".job-schedule")).to_have_text("scheduled")
        client.delete(f"jobs/{job}").raise_for_status()
        client.delete(f"schedules/{schedule}").raise_for_status()
