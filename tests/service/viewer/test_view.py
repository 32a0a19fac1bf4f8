"""What the 3D view can show beside roof types: other colours, the ground, measured distances, and points."""

import gzip
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from chromium import Visit, of_hue
from finished_jobs import finished_job
from numpy.typing import NDArray
from playwright.sync_api import Locator, expect
from shapely.geometry import shape

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]

BACKGROUND = np.array([0xEE, 0xF1, 0xF4], dtype=np.uint8)
SCRIPTS_BYTES = 250_000
"""Most bytes of scripts, compressed, before models are seen."""


@pytest.fixture(scope="module")
def with_points(shared_service: str, house: Path) -> str:
    """Id of a finished job on one gabled house, with points."""
    return finished_job(shared_service, house, points=True)


def figures(opened: Visit) -> dict[str, float]:
    """The figures of the shown measurement by name, in metres and degrees."""
    card = opened.page.get_by_role("region", name="Measurement")
    expect(card.locator("dd").first).to_be_visible()
    names, texts = card.locator("dt").all_inner_texts(), card.locator("dd").all_inner_texts()
    return {
        name: float(text.split("\u202f")[0].replace("\u2212", "-")) for name, text in zip(names, texts, strict=True)
    }


def shown_points(opened: Visit) -> dict[str, int]:
    """The numbers of drawn and missing points and nodes, once nothing is missing."""
    opened.page.wait_for_selector(".points[data-missing='0']")
    card = opened.page.locator(".points")
    return {name: int(card.get_attribute(f"data-{name}") or "0") for name in ("points", "nodes", "kept")}


def extremes(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Column and row of the corners of a rectangle in a picture, in turn."""
    rows, columns = np.nonzero(mask)
    # the sides of the house lie along the axes; a corner is farthest along a diagonal
    picks = [(columns + rows).argmin(), (columns - rows).argmax(), (columns + rows).argmax(), (rows - columns).argmax()]
    return [(int(columns[i]), int(rows[i])) for i in picks]


def test_colours_of_roofs_are_chosen_and_explained(visit: Open, shared_service: str, house_job: str) -> None:
    opened = visit(shared_service)
    opened.open_job(house_job)
    page = opened.page
    choice = page.get_by_label("Colour", exact=True)
    page.get_by_role("button", name="Top").click()  # both planes are seen from there
    typed = opened.pixels_at_rest()
    assert of_hue(typed, "gable").any()
    record = httpx.get(f"{shared_service}jobs/{house_job}/buildings").json()["features"][0]["properties"]
    classes = page.get_by_role("list", name="Colours")

    choice.select_option("Residual")
    assert record["share_within_0_2m"] >= 0.95
    expect(classes.get_by_role("listitem")).to_have_count(1)
    expect(classes).to_contain_text("95 % or more within 0.2 m")
    expect(page.locator("#status")).to_have_text("The roofs are coloured by residual.")
    assert not of_hue(opened.pixels(), "gable").any()

    choice.select_option("Status")
    expect(classes.get_by_role("listitem")).to_have_text("Modelled1")
    choice.select_option("Reason")
    expect(classes.get_by_role("listitem")).to_have_text("none: modelled in full1")

    choice.select_option("Roof plane")
    planes = opened.pixels()
    assert record["n_planes"] == 2
    # the second colour of the palette is that of gables
    share = of_hue(planes, "gable").sum() / of_hue(typed, "gable").sum()
    assert 0.1 < share < 0.9, "the planes of the roof have one colour"

    choice.select_option("Roof type")
    assert (opened.pixels() == typed).all()


def test_the_ground_is_switched_off_and_on(visit: Open, shared_service: str, house_job: str) -> None:
    opened = visit(shared_service)
    opened.open_job(house_job)
    ground = opened.page.get_by_role("button", name="Ground")
    expect(ground).to_have_attribute("aria-pressed", "true")
    before = opened.pixels_at_rest()
    ground.click()
    expect(ground).to_have_attribute("aria-pressed", "false")
    without = opened.pixels_at_rest()
    shares = [(seen == BACKGROUND).all(axis=2).mean() for seen in (before, without)]
    assert shares[1] > shares[0] + 0.2
    assert of_hue(without, "gable").sum() == of_hue(before, "gable").sum()
    ground.click()
    ground.blur()
    assert ((opened.pixels_at_rest() != before).any(axis=2)).mean() < 0.01


def test_two_clicks_on_the_corners_of_a_roof_measure_its_sides(
    visit: Open, shared_service: str, house_job: str, tmp_path: Path
) -> None:
    params = {"crs": "native"}
    feature = httpx.get(f"{shared_service}jobs/{house_job}/buildings", params=params).json()["features"][0]
    rectangle = np.array(shape(feature["geometry"]).minimum_rotated_rectangle.exterior.coords)
    sides = np.sort(np.hypot(*np.diff(rectangle, axis=0).T))
    opened = visit(shared_service)
    opened.open_job(house_job)
    opened.page.get_by_role("button", name="Top").click()
    opened.pixels_at_rest()
    for _ in range(4):
        opened.canvas.press("-")  # nothing lies over the house then
    corners = extremes(of_hue(opened.pixels_at_rest(), "gable"))
    opened.page.get_by_role("button", name="Measure").click()
    canvas = opened.canvas
    measured = []
    for ends in pairwise([*corners, corners[0]]):
        for column, row in ends:
            canvas.click(position={"x": column, "y": row})
        measured.append(figures(opened)["Horizontal distance"])
        slope, height = (figures(opened)[name] for name in ("Slope distance", "Height difference"))
        assert slope == pytest.approx(np.hypot(measured[-1], height), abs=0.02)
        assert abs(height) < 0.1, "the eaves of the house are level"
    opened.page.screenshot(path=tmp_path / "measured.png")
    # a corner of the model is taken if the click is near it, so the distances are those of the model
    assert np.sort(measured) == pytest.approx(sides, abs=0.05)
    assert opened.page.url.endswith(house_job), "a click of the tool has opened a record"
    opened.page.get_by_role("button", name="Measure").click()
    expect(opened.page.get_by_role("region", name="Measurement")).to_be_hidden()


def test_measuring_needs_no_pointer(visit: Open, shared_service: str, house_job: str) -> None:
    name = httpx.get(f"{shared_service}jobs/{house_job}/buildings").json()["features"][0]["id"]
    opened = visit(shared_service)
    page = opened.page
    page.goto(f"{shared_service}#/jobs/{house_job}/buildings/{name}")
    opened.wait_for_models()
    opened.pixels_at_rest()
    button, canvas = page.get_by_role("button", name="Measure"), opened.canvas
    button.focus()
    page.keyboard.press("Enter")
    expect(button).to_have_attribute("aria-pressed", "true")
    expect(canvas).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_have_text("First place set.")
    for _ in range(4):
        page.keyboard.press("ArrowDown")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_contain_text("Horizontal distance")
    shown = figures(opened)
    assert shown["Horizontal distance"] > 0.5

    # Escape closes first what is open over the view, then ends the measurement, and last closes the record
    menu = page.locator("details.menu", has_text="Download")
    menu.locator("summary").click()
    expect(menu).to_have_attribute("open", "")
    page.keyboard.press("Escape")
    expect(menu).not_to_have_attribute("open", "")
    page.locator(".record").get_by_role("link", name="Dossier").click()
    dossier = page.get_by_role("dialog", name="Dossier")
    expect(dossier).to_be_visible()
    page.keyboard.press("Escape")
    expect(dossier).to_have_count(0)
    assert figures(opened) == shown
    canvas.focus()
    page.keyboard.press("Escape")
    expect(button).to_be_focused()
    expect(button).to_have_attribute("aria-pressed", "false")
    expect(page.get_by_role("region", name="Measurement")).to_be_hidden()
    expect(page.locator(".record-id")).to_have_text(name)
    canvas.press("Escape")
    expect(page.locator(".record-id")).to_have_count(0)


def test_a_tap_measures_too(visit: Open, shared_service: str, house_job: str) -> None:
    opened = visit(shared_service, viewport={"width": 390, "height": 844}, has_touch=True)
    opened.open_job(house_job)
    opened.page.get_by_role("button", name="Measure").tap()
    box = opened.canvas.bounding_box()
    for share in (0.4, 0.6):
        opened.page.touchscreen.tap(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
    assert figures(opened)["Slope distance"] > 0.5


def points_button(opened: Visit) -> Locator:
    return opened.page.get_by_role("button", name="Points", exact=True)


def test_points_are_shown_over_the_models_coloured_and_hidden_by_class(
    visit: Open, shared_service: str, with_points: str, tmp_path: Path
) -> None:
    tileset: dict[str, Any] = httpx.get(f"{shared_service}jobs/{with_points}/points/tileset.json").json()
    opened = visit(shared_service)
    opened.open_job(with_points)
    page = opened.page
    models = opened.pixels_at_rest()
    early = [url for url in opened.urls if "/points/" in url or "points_panel" in url]
    assert [url.rpartition("/")[2] for url in early] == ["tileset.json", "terrain.json"], "only the terrain is there"
    points_button(opened).click()
    drawn = shown_points(opened)
    assert 0 < drawn["points"] <= tileset["extras"]["n_points"]
    assert drawn["points"] <= drawn["kept"]
    residuals = opened.pixels_at_rest()
    assert (residuals != models).any(axis=2).mean() > 0.1

    page.get_by_label("Points by").select_option("Class")
    legend = page.get_by_role("group", name="Shown points")
    expect(legend.get_by_label("Ground")).to_be_visible()
    reported = sum(int(text.replace("\u202f", "")) for text in legend.locator(".tally").all_inner_texts())
    assert reported == tileset["extras"]["n_points"]
    by_class = opened.pixels_at_rest()
    page.screenshot(path=tmp_path / "classes.png")
    legend.get_by_label("Ground").uncheck()
    without = opened.pixels_at_rest()
    assert (without != by_class).any(axis=2).mean() > 0.1
    page.get_by_label("Points by").select_option("Elevation")
    expect(legend).to_contain_text(re.compile(r"\d.m to \d+.m"))

    points_button(opened).click()
    expect(page.locator(".points")).to_have_count(0)
    points_button(opened).blur()
    assert (opened.pixels_at_rest() != models).any(axis=2).mean() < 0.001


def test_a_job_without_points_offers_none(visit: Open, shared_service: str, house_job: str) -> None:
    opened = visit(shared_service)
    opened.open_job(house_job)
    expect(opened.page.get_by_role("button", name="Measure")).to_be_visible()
    expect(points_button(opened)).to_have_count(0)


def test_points_that_cannot_be_read_are_reported_and_asked_for_again(
    visit: Open, shared_service: str, with_points: str
) -> None:
    opened = visit(shared_service)
    opened.expect_error("status of 503")
    opened.open_job(with_points)
    opened.page.route("**/points/**/*.glb", lambda route: route.fulfill(status=503))
    points_button(opened).click()
    alert = opened.page.get_by_role("alert")
    expect(alert).to_contain_text("Some points could not be read")
    opened.page.unroute("**/points/**/*.glb")
    alert.get_by_role("button", name="Try again").click()
    expect(alert).to_have_count(0)
    opened.page.wait_for_selector(".points:not([data-points='0'])")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_tools_and_legends_fit_on_a_phone(
    visit: Open, shared_service: str, with_points: str, scheme: str, tmp_path: Path
) -> None:
    opened = visit(shared_service, viewport={"width": 390, "height": 844}, color_scheme=scheme)
    opened.open_job(with_points)
    points_button(opened).click()
    shown_points(opened)
    opened.page.get_by_role("button", name="Measure").click()
    for option in ("Residual", "Reason"):
        opened.page.get_by_label("Colour", exact=True).select_option(option)
    opened.page.screenshot(path=tmp_path / f"{scheme}.png", full_page=True)
    assert opened.page.evaluate("document.documentElement.scrollWidth") == 390
    stage = opened.page.locator(".stage3d").bounding_box()
    for part in (".tools", ".points", ".measure"):
        box = opened.page.locator(part).bounding_box()
        assert box["x"] >= stage["x"]
        assert box["x"] + box["width"] <= stage["x"] + stage["width"]
        assert box["y"] >= stage["y"]
        assert box["y"] + box["height"] <= stage["y"] + stage["height"]


def test_few_scripts_are_loaded_before_the_first_picture(visit: Open, shared_service: str, house_job: str) -> None:
    opened = visit("about:blank")
    opened.url = shared_service
    opened.page.goto(f"{shared_service}#/jobs/{house_job}")
    opened.wait_for_models()
    scripts = {url for url in opened.urls if url.endswith(".js")}
    sizes = {url.rsplit("/", 1)[1]: len(gzip.compress(httpx.get(url).content, 9)) for url in scripts}
    assert len(sizes) >= 3
    assert sum(sizes.values()) < SCRIPTS_BYTES, sizes
