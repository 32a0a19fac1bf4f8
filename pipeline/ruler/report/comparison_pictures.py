"""Pictures of one building side by side: its points in plan, and the model of each run in one view and scale."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap

from pipeline.geometry import top_visible
from pipeline.model import FloatArray
from pipeline.report.perspective import View, draw_view, projected
from pipeline.report.pictures import blank, png_of
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.report.section import RESIDUAL_CLASSES, UNCOVERED, residual_class
from pipeline.ruler.report.viewed_models import viewed_faces
from pipeline.ruler.report.worst_cases import TRUTH_COLOUR

WIDTH_PX = 480
"""Width of a picture."""
REACH_M = 0.3
"""Points up to this far outside the footprints belong to the building."""
LOW_M = 1.5
"""Points up to this height above the floor are ground or low walls: grey in plan, left out of the views."""
PLAN_POINTS, VIEW_POINTS = 8_000, 2_500
"""Most points of a picture; more are thinned evenly."""
BLOCK_COLOUR = "#b9bcc0"
"""Roofs of blocks, which are hatched too."""
LOW_COLOUR = "#9aa0a6"
HEIGHT_COLOURS = ("#8707a6", "#b12a90", "#d5546e", "#f0804e", "#fdb42f", "#f0f921")
"""Colours of points in plan, from low to high: the plasma map without its darkest colours, for dark pages."""
_HATCH = "//"
_GOOD = 2
_MARGIN = 0.06
_LENGTHS_M = (0.1, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_SEEN_FROM_DEG = 200.0
_OFF_AXIS_DEG = 35.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingPictures:
    """All pictures of a building, of one width and height."""

    width_px: int
    """Width of each."""
    height_px: int
    """Height of each."""
    plan: bytes | None
    """Points by elevation; None without points."""
    low_m: float
    """Elevation of the darkest points; nan without points."""
    high_m: float
    """Elevation of the brightest points."""
    n_points: int
    """Points in plan before thinning."""
    scale_m: float
    """Length of the scale bar."""
    scale_share: float
    """Its share of the width of the plan."""
    views: tuple[bytes | None, ...]
    """One per run; None without a model."""
    truth: bytes | None
    """The true model; None without one."""


def place_of(models: Sequence[RoofModel], truth: RoofModel | None) -> shapely.Geometry:
    """The area of the points of a building: the footprints of at least half of the runs, and true roofs.

    A single run may spread a rectangle over neighbours, whose points do not belong to this building.
    """
    footprints = [model.footprint for model in models if not model.footprint.is_empty]
    needed = (len(footprints) + 1) // 2
    held = [shapely.intersection_all(list(some)) for some in itertools.combinations(footprints, needed) if needed]
    if truth is not None and truth.surfaces:
        held.append(truth.footprint)
    return shapely.union_all(held).buffer(REACH_M, join_style="mitre")


def draw_building(models: Sequence[RoofModel | None], truth: RoofModel | None, xyz: FloatArray) -> BuildingPictures:
    """Draw a building with its points (n, 3) in metres; all views have one direction and scale."""
    shown = [model for model in (*models, truth) if model is not None and model.surfaces]
    corners = [ring for model in shown for face in viewed_faces(model) for ring in face.rings]
    everything = np.concatenate([*corners, xyz]) if corners else xyz
    if len(everything) == 0:
        return _nothing(len(models))
    origin = np.floor(everything.min(axis=0))
    floor_m = min((float(ring[:, 2].min()) for ring in corners), default=float(everything[:, 2].min()))
    high = xyz[xyz[:, 2] > floor_m + LOW_M]
    seen = _thinned(high[top_visible(high)], VIEW_POINTS)
    view = View(azimuth_deg=_azimuth_deg(everything[:, :2] - origin[:2]))
    screen = projected(np.concatenate([*corners, seen]) - origin, view) if corners else np.zeros((1, 2))
    size = np.ptp(screen, axis=0)
    height_px = round(WIDTH_PX * float(np.clip(size[1] / max(size[0], 1e-6), 0.6, 1.1)))
    frame = _frame(screen, height_px)
    plan_frame = _frame(everything[:, :2] - origin[:2], height_px)
    wide_m = plan_frame[1] - plan_frame[0]
    scale_m = max(length for length in _LENGTHS_M if length <= max(_LENGTHS_M[0], wide_m / 3.0))
    low_m, high_m = _elevations(seen if len(seen) else xyz)

    def viewed(model: RoofModel | None) -> bytes | None:
        return None if model is None or not model.surfaces else _view(model, seen, origin, view, frame, height_px)

    return BuildingPictures(
        width_px=WIDTH_PX,
        height_px=height_px,
        plan=_plan(xyz, floor_m, (low_m, high_m), truth, origin, plan_frame, height_px) if len(xyz) else None,
        low_m=low_m,
        high_m=high_m,
        n_points=len(xyz),
        scale_m=scale_m,
        scale_share=scale_m / wide_m,
        views=tuple(viewed(model) for model in models),
        truth=None if truth is None or not truth.surfaces else _view(truth, seen[:0], origin, view, frame, height_px),
    )


def _nothing(runs: int) -> BuildingPictures:
    """Pictures of a building without points and models."""
    return BuildingPictures(
        width_px=WIDTH_PX,
        height_px=WIDTH_PX,
        plan=None,
        low_m=math.nan,
        high_m=math.nan,
        n_points=0,
        scale_m=1.0,
        scale_share=0.0,
        views=(None,) * runs,
        truth=None,
    )


def _thinned(xyz: FloatArray, most: int) -> FloatArray:
    return xyz[:: max(1, math.ceil(len(xyz) / most))]


def _azimuth_deg(xy: FloatArray) -> float:
    """Azimuth of the view: 35 deg off the normal of the longer axis, as near to the usual view as possible."""
    rectangle = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shapely.multipoints(xy)))
    if len(rectangle) < 5:
        return _SEEN_FROM_DEG
    sides = np.diff(rectangle[:3], axis=0)
    longer = sides[int(np.argmax(np.hypot(sides[:, 0], sides[:, 1])))]
    across = math.degrees(math.atan2(longer[0], longer[1])) + 90.0
    found = [(across + turn + off) % 360.0 for turn in (0.0, 180.0) for off in (-_OFF_AXIS_DEG, _OFF_AXIS_DEG)]
    return min(found, key=lambda azimuth: (abs((azimuth - _SEEN_FROM_DEG + 180.0) % 360.0 - 180.0), azimuth))


def _frame(places: FloatArray, height_px: int) -> tuple[float, float, float, float]:
    """Left, right, bottom, top of a picture that holds all places at one scale."""
    low, high = places.min(axis=0), places.max(axis=0)
    (x, y), (wide, tall) = (low + high) / 2.0, high - low
    scale = (1.0 + 2.0 * _MARGIN) * max(wide / WIDTH_PX, tall / height_px, 1e-3)
    half_x, half_y = scale * WIDTH_PX / 2.0, scale * height_px / 2.0
    return float(x - half_x), float(x + half_x), float(y - half_y), float(y + half_y)


def _set_frame(axes: Axes, frame: tuple[float, float, float, float]) -> None:
    axes.set_aspect("auto")
    axes.set_xlim(frame[0], frame[1])
    axes.set_ylim(frame[2], frame[3])


def _elevations(xyz: FloatArray) -> tuple[float, float]:
    """Range of elevations of the colours: the middle 98 % of the points."""
    if len(xyz) == 0:
        return math.nan, math.nan
    low, high = (float(value) for value in np.quantile(xyz[:, 2], (0.01, 0.99)))
    return low, max(high, low + 0.1)


def _plan(
    xyz: FloatArray,
    floor_m: float,
    range_m: tuple[float, float],
    truth: RoofModel | None,
    origin: FloatArray,
    frame: tuple[float, float, float, float],
    height_px: int,
) -> bytes:
    """Points by elevation, low ones grey beneath; true edges dashed."""
    figure, axes = blank(WIDTH_PX, height_px)
    shown = _thinned(xyz, PLAN_POINTS)
    is_low = shown[:, 2] <= floor_m + LOW_M
    size = _dot(len(shown))
    low, high = shown[is_low] - origin, shown[~is_low] - origin
    high = high[np.argsort(high[:, 2], kind="stable")]
    axes.scatter(low[:, 0], low[:, 1], s=size, c=LOW_COLOUR, linewidths=0)
    axes.scatter(
        high[:, 0],
        high[:, 1],
        s=size,
        c=high[:, 2] + origin[2],
        cmap=LinearSegmentedColormap.from_list("elevation", HEIGHT_COLOURS),
        vmin=range_m[0],
        vmax=range_m[1],
        linewidths=0,
    )
    if truth is not None:
        outlines = [surface.polygon for surface in truth.surfaces] or [truth.footprint]
        rings = [shapely.get_coordinates(ring)[:, :2] - origin[:2] for ring in shapely.get_rings(outlines)]
        axes.add_collection(LineCollection(rings, colors=TRUTH_COLOUR, linewidths=1.6, linestyles=(0, (5, 2.5))))
    _set_frame(axes, frame)
    return png_of(figure)


def _dot(points: int) -> float:
    """Area of a dot in square typographic points: so many cover a third of a picture."""
    return float(np.clip(0.33 * (0.72 * WIDTH_PX) ** 2 / max(points, 1), 1.5, 20.0))


def _view(
    model: RoofModel,
    xyz: FloatArray,
    origin: FloatArray,
    view: View,
    frame: tuple[float, float, float, float],
    height_px: int,
) -> bytes:
    """A model with its points in the colours of their distances to it; blocks grey and hatched."""
    figure, axes = blank(WIDTH_PX, height_px)
    is_block = not model.status.has_roof
    faces = [
        dataclasses.replace(face, rings=tuple(ring - origin for ring in face.rings))
        for face in viewed_faces(model, BLOCK_COLOUR if is_block else None)
    ]
    draw_view(axes, [faces], view, shadows=False)
    if is_block:
        axes.collections[0].set_hatch(_HATCH)
    kinds = residual_class(xyz[:, 2] - model.top(xyz[:, 0], xyz[:, 1]))
    screen = projected(xyz - origin, view)
    size = float(np.clip(0.3 * _dot(len(xyz)), 3.5, 8.0))
    for place in (_GOOD, 1, 3, 0, 4, UNCOVERED):
        at = kinds == place
        dot = size if place == _GOOD else 1.6 * size
        axes.scatter(screen[at, 0], screen[at, 1], s=dot, c=RESIDUAL_CLASSES[place].colour, linewidths=0, zorder=3)
    _set_frame(axes, frame)
    return png_of(figure)
