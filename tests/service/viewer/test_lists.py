"""The list of a job's objects, its filters, the objects that were left out, and the map, in a real Chromium."""

import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from chromium import Visit, at_rest, of_hue
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Locator, Page, Route, expect

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]

TILES = "https://tiles.example.org/"
"""Origin of the tiles beneath the map, as in conftest.py."""

MANY = 20_000
"""Buildings of the made-up job."""
MAGENTA = (255, 0, 255)
"""Colour of the made-up tiles beneath the map."""
MOST_ROWS = 60
"""Rows of the list that may be in the page at once: what fits the window, and some beyond it."""


@pytest.fixture(scope="module")
def records(shared_service: str, suburb_job: str) -> dict[str, dict[str, Any]]:
    """The records of its buildings, by id."""
    features = httpx.get(f"{shared_service}jobs/{suburb_job}/buildings", params={"limit": 1000}).json()["features"]
    return {feature["id"]: feature["properties"] for feature in features}


@pytest.fixture(scope="module")
def left_out(shared_service: str, suburb_job: str) -> list[dict[str, Any]]:
    """The objects that it left out."""
    table = httpx.get(f"{shared_service}jobs/{suburb_job}/results/rejected").raise_for_status().content
    rows: list[dict[str, Any]] = pq.read_table(io.BytesIO(table)).to_pylist()
    assert rows, "the tile has no object to leave out"
    return rows


def listed(page: Page) -> Locator:
    """The ids of the rows in the page, in their order."""
    return page.locator(".buildings .building-id")


def tally(page: Page) -> Locator:
    """The number of listed objects beside the heading."""
    return page.locator(".list-title .tally")


def open_address(visit: Open, shared_service: str, address: str, **options: object) -> Visit:
    """A page at an address within a job, with its models."""
    opened = visit(f"{shared_service}#/jobs/{address}", **options)
    opened.url = shared_service
    opened.elsewhere.clear()
    opened.page.wait_for_selector("canvas[data-ready]", state="attached")
    return opened


def test_search_order_and_filters_apply_to_list_and_view_and_a_link_brings_them_back(
    visit: Open, shared_service: str, suburb_job: str, records: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    opened = visit(shared_service)
    opened.open_job(suburb_job)
    page = opened.page
    expect(tally(page)).to_have_text(str(len(records)))
    page.get_by_role("combobox", name="Sort by").select_option("height")
    page.get_by_role("button", name="Order: ascending").click()
    by_height = sorted(records, key=lambda name: (-(records[name]["height_m"] or 0.0), name))
    for place, name in enumerate(by_height[:5]):
        expect(listed(page).nth(place)).to_have_text(name)
    expect(page).to_have_url(f"{shared_service}#/jobs/{suburb_job}?sort=-height")

    before = of_hue(opened.pixels(), "gable").sum()
    bound = float(np.median([record["height_m"] for record in records.values()]))
    low = [name for name in by_height if records[name]["height_m"] <= bound]
    page.locator("summary", has_text="Filters").click()
    page.get_by_role("spinbutton", name="Height to, m").fill(str(bound))
    expect(tally(page)).to_have_text(f"{len(low)} of {len(records)}")
    expect(page.locator("#status")).to_contain_text(f"{len(low)} of")
    assert of_hue(opened.pixels(), "gable").sum() < before, "buildings that do not fit are still drawn"
    page.get_by_role("checkbox", name="Hip").first.uncheck()
    chosen = [name for name in low if records[name]["roof_type"] != "hip"]
    assert len(chosen) < len(low)
    expect(tally(page)).to_contain_text(f"{len(chosen)} of")
    page.get_by_label("Search ids and reasons").fill(chosen[0][:6])
    expect(tally(page)).to_contain_text("1 of")
    expect(listed(page)).to_have_text([chosen[0]])
    page.screenshot(path=tmp_path / "filtered.png")

    page.reload()
    opened.wait_for_models()
    expect(listed(page)).to_have_text([chosen[0]])
    expect(page.get_by_label("Search ids and reasons")).to_have_value(chosen[0][:6])
    expect(page.locator("#legend-hip")).not_to_be_checked()
    page.get_by_role("button", name="Clear filters").click()
    expect(tally(page)).to_have_text(str(len(records)))
    expect(page).to_have_url(f"{shared_service}#/jobs/{suburb_job}?sort=-height")
    page.get_by_label("Search ids and reasons").fill("no such building")
    expect(page.locator(".list-empty")).to_have_text("No object fits these filters.")


def test_arrows_home_end_and_enter_lead_through_the_list(
    visit: Open, shared_service: str, suburb_job: str, records: dict[str, dict[str, Any]]
) -> None:
    opened = visit(shared_service)
    opened.open_job(suburb_job)
    page = opened.page
    page.get_by_role("combobox", name="Sort by").select_option("id")
    ids = sorted(records)

    def at(place: int) -> None:
        """The row with the focus is at this place of the list, and says so."""
        row = page.locator(f'li[data-id="{ids[place]}"]')
        expect(row.locator("a")).to_be_focused()
        expect(row).to_have_attribute("aria-posinset", str(place + 1))
        expect(row).to_have_attribute("aria-setsize", str(len(ids)))
        expect(page.locator('.building[tabindex="0"]')).to_have_count(1)

    page.locator('.building[tabindex="0"]').focus()
    page.keyboard.press("Home")
    at(0)
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    at(2)
    page.keyboard.press("ArrowUp")
    at(1)
    page.keyboard.press("End")
    at(len(ids) - 1)
    page.keyboard.press("ArrowDown")
    at(len(ids) - 1)
    page.keyboard.press("PageUp")
    page.keyboard.press("Home")
    page.keyboard.press("Enter")
    expect(page.locator(".record-id")).to_have_text(ids[0])
    page.get_by_role("button", name="All buildings").press("Enter")
    at(0)


def test_what_was_left_out_is_listed_counted_and_drawn_with_its_reasons(
    visit: Open, shared_service: str, suburb_job: str, left_out: list[dict[str, Any]], tmp_path: Path
) -> None:
    opened = visit(shared_service)
    opened.open_job(suburb_job)
    page = opened.page
    models = int(page.locator("canvas").get_attribute("data-models") or 0)
    assert not any("results/rejected" in url for url in opened.urls), "it is loaded before it is wanted"
    page.get_by_role("button", name="Without a model").click()
    expect(tally(page)).to_have_text(str(len(left_out)))
    opened.pixels(tmp_path / "left_out.png")
    expect(page.locator("canvas")).to_have_attribute("data-models", str(models + len(left_out)))
    reasons = page.get_by_role("group", name="Reason").locator("label")
    counted = {row["reason"] for row in left_out}
    expect(reasons).to_have_count(len(counted))
    numbers = [int(text.split()[-1]) for text in reasons.all_inner_texts()]
    assert sum(numbers) == len(left_out)
    assert numbers == sorted(numbers, reverse=True)

    chosen = left_out[0]
    page.get_by_label("Search ids and reasons").fill(chosen["object_id"])
    expect(listed(page)).to_have_text([chosen["object_id"]])
    still = opened.pixels_at_rest()
    page.locator(".building").click()
    record = page.locator(".record")
    expect(record.get_by_role("heading", name="Not a building")).to_be_visible()
    expect(record.locator(".notice")).to_contain_text(chosen["reason_detail"])
    confidence = chosen["detection_confidence"]
    shown = "\N{EN DASH}" if confidence is None else f"{100 * confidence:.1f}"
    expect(record).to_contain_text(f"Confidence that it is a building{shown}")
    assert (opened.pixels_at_rest() != still).any(axis=2).mean() > 0.01, "the view did not go there"
    page.reload()
    opened.wait_for_models()
    expect(record.locator(".record-id")).to_have_text(chosen["object_id"])

    # a link without any filter finds it, too
    other = open_address(visit, shared_service, f"{suburb_job}/buildings/{chosen['object_id']}")
    expect(other.page.locator(".record").get_by_role("heading", name="Not a building")).to_be_visible()


def test_the_map_shares_selection_and_filters_and_loads_nothing_from_elsewhere(
    visit: Open, shared_service: str, suburb_job: str, records: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    opened = visit(shared_service)
    opened.open_job(suburb_job)
    page = opened.page
    page.get_by_role("button", name="Map", exact=True).click()
    drawn = page.locator(".map-canvas")
    expect(drawn).to_have_attribute("data-outlines", str(len(records)))
    expect(page).to_have_url(f"{shared_service}#/jobs/{suburb_job}?view=map")
    box = drawn.bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 200)
    all_of_it = at_rest(drawn)
    page.screenshot(path=tmp_path / "map.png")
    page.mouse.wheel(0, -600)
    page.mouse.move(box["x"] + 310, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 380, box["y"] + 260, steps=4)
    page.mouse.up()
    assert at_rest(drawn) != all_of_it
    assert "/buildings/" not in page.url, "a drag has opened a record"
    drawn.press("f")
    drawn.press("+")
    drawn.press("ArrowLeft")
    drawn.press("-")
    drawn.press("ArrowRight")
    drawn.press("f")

    # list to map, then map to list: the selected building is in the middle
    page.get_by_label("Search ids and reasons").fill(max(records, key=lambda name: records[name]["footprint_area_m2"]))
    expect(drawn).to_have_attribute("data-outlines", "1")
    page.locator(".building").click()
    expect(page.locator(".record-id")).to_be_visible()
    chosen = page.locator(".record-id").inner_text()
    page.get_by_role("button", name="All buildings").click()
    opened.page.wait_for_function("() => !location.hash.includes('/buildings/')")
    at_rest(drawn)
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(page.locator(".record-id")).to_have_text(chosen)
    page.screenshot(path=tmp_path / "selected.png")
    drawn.press("Escape")
    expect(page.locator(".record")).to_have_count(0)

    page.reload()
    page.wait_for_selector("canvas[data-ready]", state="attached")
    expect(drawn).to_have_attribute("data-outlines", "1")
    page.get_by_role("button", name="3D", exact=True).click()
    expect(drawn).to_have_count(0)
    expect(page.locator("canvas")).to_be_visible()


def test_tiles_of_the_operator_lie_beneath_the_map_where_the_buildings_are(
    visit: Open, with_tiles: str, suburb_job: str, tmp_path: Path
) -> None:
    picture = io.BytesIO()
    Image.new("RGB", (256, 256), MAGENTA).save(picture, "PNG")
    opened = visit(f"{with_tiles}#/jobs/{suburb_job}")
    opened.url = with_tiles
    opened.elsewhere.clear()
    page = opened.page
    page.route(f"{TILES}**", lambda route: route.fulfill(body=picture.getvalue(), content_type="image/png"))
    opened.wait_for_models()
    assert opened.elsewhere == [], "tiles are loaded before the map is shown"
    page.get_by_role("button", name="Map", exact=True).click()
    expect(page.locator(".map-credit")).to_have_text("© the owners")
    drawn = page.locator(".map-canvas")
    while not (pixels_of(drawn, tmp_path / "tiles.png") == MAGENTA).all(axis=2).mean() > 0.3:
        page.evaluate("() => new Promise(done => requestAnimationFrame(done))")
    assert all(address.startswith(TILES) for address in opened.elsewhere)
    asked = {tuple(map(int, re.findall(r"\d+", address.removeprefix(TILES)))) for address in opened.elsewhere}
    (level,) = {tile[0] for tile in asked}
    features = httpx.get(f"{with_tiles}jobs/{suburb_job}/buildings", params={"limit": 1000}).json()["features"]
    to_mercator = pyproj.Transformer.from_crs("OGC:CRS84", "EPSG:3857", always_xy=True)
    for feature in features:
        x, y = to_mercator.transform(*feature["geometry"]["coordinates"][0][0])
        half = 20_037_508.342789244
        tile = (level, int((x + half) / (2 * half) * 2**level), int((half - y) / (2 * half) * 2**level))
        assert tile in asked
    opened.elsewhere.clear()


def pixels_of(drawn: Locator, save_as: Path) -> NDArray[np.uint8]:
    """What an element shows, as rows of red, green, blue."""
    shot = drawn.screenshot(path=save_as)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def test_two_fingers_zoom_the_map(visit: Open, shared_service: str, suburb_job: str) -> None:
    opened = open_address(visit, shared_service, f"{suburb_job}?view=map", has_touch=True)
    page = opened.page
    box = page.locator(".map-canvas").bounding_box()
    at_rest(page.locator(".map-canvas"))
    bar = page.locator(".map-scale").inner_text()
    session = page.context.new_cdp_session(page)
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def touch(kind: str, apart: float) -> None:
        points = [{"x": middle[0] + side * apart, "y": middle[1], "id": n} for n, side in enumerate((-1, 1))]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points if kind != "touchEnd" else []})

    touch("touchStart", 20)
    for apart in (40, 80, 160):
        touch("touchMove", apart)
    touch("touchEnd", 160)
    expect(page.locator(".map-scale")).not_to_have_text(bar)
    expect(page.locator(".record")).to_have_count(0)


def test_with_reduced_motion_the_view_is_there_at_once(visit: Open, shared_service: str, suburb_job: str) -> None:
    opened = visit(shared_service, reduced_motion="reduce")
    opened.open_job(suburb_job)
    opened.pixels_at_rest()
    # every frame that the page asks for from now on
    opened.page.evaluate(
        """() => {
            window.heights = new Set();
            new MutationObserver(() => window.heights.add(document.querySelector("canvas").dataset.eyeM))
                .observe(document.querySelector("canvas"), { attributes: true, attributeFilter: ["data-eye-m"] });
        }"""
    )
    opened.page.locator(".building").nth(2).click()
    expect(opened.page.locator(".record")).to_be_visible()
    opened.pixels_at_rest()
    assert opened.page.evaluate("window.heights.size") == 1, "the camera passed through places on its way"


def made_up(models: str) -> str:
    """CityJSON text sequence with the first line of another, and many flat blocks of 10 by 8 m side by side."""
    head = json.loads(models.splitlines()[0])
    scale, corner = head["transform"]["scale"], head["transform"]["translate"]
    side = int(np.ceil(np.sqrt(MANY)))
    head["metadata"]["geographicalExtent"] = [*corner, corner[0] + 40.0 * side, corner[1] + 40.0 * side, corner[2] + 20]
    step, wide, deep, high = (round(metres / scale[0]) for metres in (40.0, 10.0, 8.0, 6.0))
    ring = [(0, 0), (wide, 0), (wide, deep), (0, deep)]
    walls = [[[n, (n + 1) % 4, (n + 1) % 4 + 4, n + 4]] for n in range(4)]
    solid = {
        "type": "Solid",
        "lod": "2.2",
        "boundaries": [[[[3, 2, 1, 0]], [[4, 5, 6, 7]], *walls]],
        "semantics": {
            "surfaces": [{"type": "GroundSurface"}, {"type": "RoofSurface"}, {"type": "WallSurface"}],
            "values": [[0, 1, 2, 2, 2, 2]],
        },
    }
    text = json.dumps(solid)
    lines = [json.dumps(head)]
    for n in range(MANY):
        x, y = n % side * step, n // side * step
        vertices = [[x + east, y + north, z] for z in (0, high) for east, north in ring]
        record = f'{{"status":"ok","roof_type":"flat","height_m":{2.0 + n / 1000.0:.3f},"footprint_area_m2":80.0}}'
        lines.append(
            f'{{"type":"CityJSONFeature","id":"made{n:020d}","CityObjects":{{"made{n:020d}":{{"type":"Building",'
            f'"attributes":{record},"geometry":[{text}]}}}},"vertices":{vertices}}}'
        )
    return "\n".join(lines)


def test_twenty_thousand_buildings_keep_few_rows_in_the_page(
    visit: Open, shared_service: str, suburb_job: str, tmp_path: Path
) -> None:
    opened = visit(shared_service)

    def answer(route: Route) -> None:
        response = route.fetch()
        route.fulfill(response=response, body=made_up(response.text()))

    opened.page.route("**/results/cityjson", answer)
    opened.open_job(suburb_job)
    page = opened.page
    expect(tally(page)).to_have_text("20\u202f000")
    page.get_by_role("combobox", name="Sort by").select_option("height")
    expect(listed(page).first).to_have_text(f"made{0:020d}")
    assert page.locator(".building").count() < MOST_ROWS
    page.locator('.building[tabindex="0"]').focus()
    page.keyboard.press("End")
    last = page.locator(f'li[data-id="made{MANY - 1:020d}"]')
    expect(last.locator("a")).to_be_focused()
    expect(last).to_have_attribute("aria-posinset", str(MANY))
    page.keyboard.press("PageUp")
    expect(last.locator("a")).not_to_be_focused()
    page.locator(".building-window").evaluate("window => (window.scrollTop = window.scrollHeight / 2)")
    expect(page.locator(f'li[data-id="made{MANY // 2:020d}"]')).to_be_visible()
    assert page.locator(".building").count() < MOST_ROWS

    page.locator("summary", has_text="Filters").click()
    page.get_by_role("spinbutton", name="Height from, m").fill("21.9")
    expect(tally(page)).to_have_text("100 of 20\u202f000")
    page.get_by_label("Search ids and reasons").fill("19999")
    expect(tally(page)).to_have_text("1 of 20\u202f000")
    page.get_by_role("button", name="Clear filters").click()
    page.get_by_role("button", name="Map", exact=True).click()
    drawn = page.locator(".map-canvas")
    expect(drawn).to_have_attribute("data-outlines", str(MANY))
    at_rest(drawn)
    page.screenshot(path=tmp_path / "many.png")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1000])
def test_list_filters_and_map_fit_narrow_screens(
    visit: Open,
    shared_service: str,
    suburb_job: str,
    records: dict[str, dict[str, Any]],
    left_out: list[dict[str, Any]],
    width: int,
    scheme: str,
    tmp_path: Path,
) -> None:
    address = f"{suburb_job}?sort=-residual&show=rejected&view=map"
    opened = open_address(visit, shared_service, address, viewport={"width": width, "height": 844}, color_scheme=scheme)
    page = opened.page
    page.locator("summary", has_text="Filters").click()
    expect(tally(page)).to_have_text(str(len(records) + len(left_out)))
    at_rest(page.locator(".map-canvas"))
    assert page.evaluate("document.documentElement.scrollWidth") == width
    for row in page.locator(".building").all():
        box = row.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
    page.screenshot(path=tmp_path / f"{width}-{scheme}.png", full_page=True)


def test_addresses_with_a_filter_name_the_same_job_and_building(
    visit: Open, shared_service: str, suburb_job: str, records: dict[str, dict[str, Any]]
) -> None:
    chosen = sorted(records)[3]
    opened = open_address(visit, shared_service, f"{suburb_job}/buildings/{chosen}?height=..100&q={chosen[:4]}")
    page = opened.page
    expect(page.locator(".record-id")).to_have_text(chosen)
    expect(page.locator(f'.job[href="#/jobs/{suburb_job}"]')).to_have_attribute("aria-current", re.compile("page|true"))
    page.get_by_role("button", name="All buildings").click()
    expect(listed(page).filter(has_text=chosen)).to_have_count(1)
    expect(page).to_have_url(f"{shared_service}#/jobs/{suburb_job}?q={chosen[:4]}&height=..100")
