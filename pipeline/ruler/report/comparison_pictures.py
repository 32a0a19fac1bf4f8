"""Pictures of one building side by side: its points in plan, and the model of each run in one view and scale."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely
from matplotlib.colors import LinearSegmentedColormap

from pipeline.geometry import top_visible
from pipeline.model import FloatArray
from pipeline.report.perspective import View, draw_view, projected
from pipeline.report.pictures import blank, png_of, set_frame
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.report.model_pictures import corners_of, draw_true_edges, scale_bar, viewed_faces
from pipeline.ruler.report.section import RESIDUAL_CLASSES, UNCOVERED, residual_class

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
_GOOD = 2
_SEEN_FROM_DEG, _OFF_AXIS_DEG = 200.0, 35.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingPictures:
    """All pictures of a building, of one width and height."""

    height_px: int = WIDTH_PX
    plan: bytes | None = None
    """Points by elevation; None without points."""
    range_m: tuple[float, float] = (math.nan, math.nan)
    """Elevations of the darkest and of the brightest points; nan without points."""
    n_points: int = 0
    scale: tuple[float, float] = (1.0, 0.0)
    """Length of the scale bar in metres, and its share of the width of the plan."""
    views: tuple[bytes | None, ...] = ()
    """One per run; None without a model."""
    truth: bytes | None = None
    """The true model; None without one."""

    @property
    def width_px(self) -> int:
        """Width of each."""
        return WIDTH_PX


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
    corners = corners_of([viewed_faces(model) for model in shown])
    everything = np.concatenate([corners, xyz])
    if len(everything) == 0:
        return BuildingPictures(views=(None,) * len(models))
    origin = np.floor(everything.min(axis=0))
    floor_m = float((corners if len(corners) else xyz)[:, 2].min())
    high = xyz[xyz[:, 2] > floor_m + LOW_M]
    seen = _thinned(high[top_visible(high)], VIEW_POINTS)
    view = View(azimuth_deg=_azimuth_deg(everything[:, :2] - origin[:2]))
    screen = projected(np.concatenate([corners, seen]) - origin, view) if len(corners) else np.zeros((1, 2))
    size = np.ptp(screen, axis=0)
    height_px = round(WIDTH_PX * float(np.clip(size[1] / max(size[0], 1e-6), 0.6, 1.1)))
    elevations = (seen if len(seen) else xyz)[:, 2]
    low_m, high_m = np.quantile(elevations, (0.01, 0.99)).tolist() if len(elevations) else (math.nan, math.nan)
    range_m = low_m, max(high_m, low_m + 0.1)

    def plan() -> tuple[bytes, float]:
        """Points by elevation, low ones grey beneath; true edges dashed. And the width in metres."""
        figure, axes = blank(WIDTH_PX, height_px)
        points = _thinned(xyz, PLAN_POINTS)
        is_low, dot = points[:, 2] <= floor_m + LOW_M, _dot(len(points))
        low, upper = points[is_low] - origin, points[~is_low] - origin
        upper = upper[np.argsort(upper[:, 2], kind="stable")]
        axes.scatter(low[:, 0], low[:, 1], s=dot, c=LOW_COLOUR, linewidths=0)
        colours = LinearSegmentedColormap.from_list("elevation", HEIGHT_COLOURS)
        heights, (vmin, vmax) = upper[:, 2] + origin[2], range_m
        axes.scatter(upper[:, 0], upper[:, 1], s=dot, c=heights, cmap=colours, vmin=vmin, vmax=vmax, linewidths=0)
        if truth is not None:
            draw_true_edges(axes, truth, origin, 1.6)
        width_m = set_frame(axes, everything[:, :2] - origin[:2])
        return png_of(figure), width_m

    def viewed(model: RoofModel | None, points: FloatArray) -> bytes | None:
        """A model with its points in the colours of their distances to it; blocks grey and hatched."""
        if model is None or not model.surfaces:
            return None
        figure, axes = blank(WIDTH_PX, height_px)
        is_block = not model.status.has_roof
        faces = viewed_faces(model, BLOCK_COLOUR if is_block else None)
        draw_view(axes, [faces], view, origin=origin, shadows=False)
        if is_block:
            axes.collections[0].set_hatch("//")
        kinds = residual_class(points[:, 2] - model.top(points[:, 0], points[:, 1]))
        at, dot = projected(points - origin, view), float(np.clip(0.3 * _dot(len(points)), 3.5, 8.0))
        for kind in (_GOOD, 1, 3, 0, 4, UNCOVERED):
            some, larger = at[kinds == kind], dot if kind == _GOOD else 1.6 * dot
            axes.scatter(some[:, 0], some[:, 1], s=larger, c=RESIDUAL_CLASSES[kind].colour, linewidths=0, zorder=3)
        set_frame(axes, screen)
        return png_of(figure)

    drawn, width_m = plan() if len(xyz) else (None, float(np.ptp(everything[:, 0])) or 1.0)
    return BuildingPictures(
        height_px=height_px,
        plan=drawn,
        range_m=range_m,
        n_points=len(xyz),
        scale=scale_bar(width_m),
        views=tuple(viewed(model, seen) for model in models),
        truth=viewed(truth, seen[:0]),
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


def _dot(points: int) -> float:
    """Area of a dot in square typographic points: so many cover a third of a picture."""
    return float(np.clip(0.33 * (0.72 * WIDTH_PX) ** 2 / max(points, 1), 1.5, 20.0))
