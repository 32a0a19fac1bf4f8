"""The camera over a hilly city: wheel, keys and drags never leave a blank view."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from chromium import Visit
from numpy.typing import NDArray
from playwright.sync_api import Route

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]

SLOPE = 0.8
"""Slope of both sides of the ridge on which the tests put the suburb: its middle rises by 80 m."""
EYE_M = 1.7
"""Least height of the camera above the ground, as in navigation.ts."""


def on_a_ridge(models: str) -> str:
    """CityJSON text sequence with each building moved up by a ridge: the middle of all boxes is inside the hill."""
    lines = [json.loads(line) for line in models.splitlines() if line]
    scale, extent = lines[0]["transform"]["scale"], lines[0]["metadata"]["geographicalExtent"]
    ridge, half = (extent[0] + extent[3]) / 2, (extent[3] - extent[0]) / 2
    for feature in lines[1:]:
        east = [x * scale[0] + lines[0]["transform"]["translate"][0] for x, _, _ in feature["vertices"]]
        rise = round(SLOPE * (half - abs(np.mean(east) - ridge)) / scale[2])
        feature["vertices"] = [[x, y, z + rise] for x, y, z in feature["vertices"]]
    return "\n".join(json.dumps(line) for line in lines)


@pytest.fixture
def hill(visit: Open, shared_service: str, suburb_job: str) -> Visit:
    """The page with the models of a hilly city."""
    # a quarter of the pixels, which take most of the time: the tests look at shares of them
    opened = visit(shared_service, device_scale_factor=0.5)

    def answer(route: Route) -> None:
        response = route.fetch()
        route.fulfill(response=response, body=on_a_ridge(response.text()))

    opened.page.route("**/results/cityjson", answer)
    opened.open_job(suburb_job)
    return opened


def eye_m(opened: Visit) -> float:
    """Height of the camera above the drawn ground."""
    return float(opened.canvas.get_attribute("data-eye-m") or "nan")


def share_of_background(pixels: NDArray[np.uint8]) -> float:
    """Share of the pixels that show nothing."""
    return float((pixels == BACKGROUND).all(axis=2).mean())


def shades(pixels: NDArray[np.uint8]) -> int:
    """Number of clearly different brightnesses that fill at least 1 % of the view: one surface alone has one."""
    share = np.bincount((pixels.mean(axis=2) // 16).astype(np.int64).ravel(), minlength=16) / pixels[..., 0].size
    return int((share > 0.01).sum())


BACKGROUND = np.array([0xEE, 0xF1, 0xF4], dtype=np.uint8)


def test_zooming_in_with_the_wheel_ends_at_the_surface_under_the_pointer(hill: Visit, tmp_path: Path) -> None:
    box = hill.canvas.bounding_box()
    for x, y in ((0.5, 0.5), (0.3, 0.6), (0.7, 0.45)):
        hill.page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        for delta in (-100, -500) * 10:
            hill.page.mouse.wheel(0, delta)
        seen = hill.pixels(tmp_path / f"wheel-{x}.png")
        assert eye_m(hill) > EYE_M - 0.01
        assert share_of_background(seen) < 0.5
        assert shades(seen) > 1
        for delta in (100, 500) * 13:
            hill.page.mouse.wheel(0, delta)
        seen = hill.pixels(tmp_path / f"out-{x}.png")
        assert share_of_background(seen) < 0.99
        hill.page.get_by_role("button", name="Fit").click()
        hill.pixels_at_rest()


def test_zooming_in_with_keys_never_leaves_a_blank_view(hill: Visit, tmp_path: Path) -> None:
    canvas = hill.canvas
    for n in range(30):
        canvas.press("+")
        seen = hill.pixels(tmp_path / f"plus-{n}.png")
        assert eye_m(hill) > EYE_M - 0.01
        assert share_of_background(seen) < 0.5
        assert shades(seen) > 1
    for key in ("ArrowDown", "ArrowLeft") * 12:
        canvas.press(key)
    hill.pixels(tmp_path / "turned.png")
    assert eye_m(hill) > EYE_M - 0.01


def test_a_drag_turns_around_the_surface_under_the_pointer(hill: Visit, tmp_path: Path) -> None:
    box = hill.canvas.bounding_box()
    mouse = hill.page.mouse
    mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.6 * box["height"])
    for _ in range(10):
        mouse.wheel(0, -100)
    before = hill.pixels(tmp_path / "before.png")
    mouse.down()
    for step in range(1, 30):
        mouse.move(box["x"] + 0.4 * box["width"] + 12 * step, box["y"] + 0.6 * box["height"] - 6 * step)
        assert eye_m(hill) > EYE_M - 0.01
    mouse.up()
    seen = hill.pixels_at_rest()
    assert (seen != before).any(axis=2).mean() > 0.2
    assert share_of_background(seen) < 0.9
