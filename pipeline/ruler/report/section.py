"""A profile across a building as inline SVG: points, the model's roof, the true roof, at one scale."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely
from markupsafe import Markup

from pipeline.model import FloatArray, LabelArray
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.report.svg_chart import line, polyline, svg, text, ticks


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResidualClass:
    """A class of distances of points to the model, with one colour."""

    low_m: float
    """Lower end; nan: no roof at the point."""
    colour: str
    label: str


RESIDUAL_CLASSES = (
    ResidualClass(low_m=-math.inf, colour="#1c69bd", label="point more than 0.5 m below the model"),
    ResidualClass(low_m=-0.5, colour="#62a7dc", label="0.2 to 0.5 m below"),
    ResidualClass(low_m=-0.2, colour="#8f979f", label="within 0.2 m"),
    ResidualClass(low_m=0.2, colour="#e8963c", label="0.2 to 0.5 m above"),
    ResidualClass(low_m=0.5, colour="#c44f1d", label="more than 0.5 m above"),
    ResidualClass(low_m=math.nan, colour="#b0308f", label="no roof at the point"),
)
"""In ascending order; blue and orange differ for all kinds of colour vision."""
UNCOVERED = len(RESIDUAL_CLASSES) - 1
"""The class of points without a roof."""
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 380.0, 40.0, 8.0, 10.0, 38.0
_MIN_HEIGHT, _MAX_HEIGHT = 130.0, 330.0
_MARGIN_M = 2.0
_BELOW_M = 1.5
_STEPS = 400
_INNER = 0.85
_STRETCH_M = 2.0
_GOOD_M = 0.2
_FAR_M = 1.0
_CLEARLY_WORSE = 1.5
_REACHES_M = (0.5, 1.0, 2.0)
_ENOUGH_POINTS = 40
_POINTS = 400


def top_of(models: Sequence[RoofModel], x: FloatArray, y: FloatArray) -> FloatArray:
    """Elevation of the highest roof face of several models at places x, y; nan without one."""
    top = np.full(len(x), np.nan)
    for model in models:
        top = np.fmax(top, model.top(x, y))
    return top


def residual_class(residual: FloatArray) -> LabelArray:
    """Index into `RESIDUAL_CLASSES` of distances point minus model in metres; `UNCOVERED` for nan."""
    borders = [entry.low_m for entry in RESIDUAL_CLASSES[1:UNCOVERED]]
    found = np.searchsorted(borders, residual, side="right")
    return np.where(np.isnan(residual), UNCOVERED, found).astype(np.int32)


def section_svg(truth: RoofModel, models: Sequence[RoofModel], xyz: FloatArray) -> Markup | None:
    """The profile of a building along `profile_line` as an `svg` element; None without roofs and points.

    Points (n, 3) near the profile are drawn in the colours of their distances to the models.
    """
    middle, along, half = profile_line(truth, models, xyz)
    s = np.linspace(-half - _MARGIN_M, half + _MARGIN_M, _STEPS)
    x, y = (middle[axis] + s * along[axis] for axis in (0, 1))
    roofs = {"truth": top_of([truth], x, y), "model": top_of(models, x, y)}
    near, kinds = _near_points(middle, along, models, xyz)
    heights = np.concatenate([roofs["truth"], roofs["model"], near[:, 1]])
    heights = heights[np.isfinite(heights)]
    if len(heights) == 0:
        return None
    frame = _Frame(left_m=float(s[0]), right_m=float(s[-1]), low_m=float(heights.min()), high_m=float(heights.max()))
    parts = frame.grid()
    parts += [
        f'<circle class="p{kind}" cx="{frame.across(place):.1f}" cy="{frame.down(z):.1f}" r="1.9"/>'
        for (place, z), kind in zip(near, kinds, strict=True)
    ]
    for name, top in roofs.items():
        parts += [polyline(name, corners) for corners in frame.lines(s, top, walls=name == "model")]
    label = f"Section across {truth.building_id}: {len(near)} points" + ("" if models else "; no model stands here")
    return svg("section", _WIDTH, frame.height, label, parts)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Frame:
    """From metres along the profile and elevations to pixels of the view box, one scale for both."""

    left_m: float
    right_m: float
    low_m: float
    high_m: float

    @property
    def floor_m(self) -> float:
        return self.low_m - _BELOW_M

    @property
    def scale(self) -> float:
        wide = (_WIDTH - _LEFT - _RIGHT) / (self.right_m - self.left_m)
        return min(wide, (_MAX_HEIGHT - _TOP - _BOTTOM) / (self.high_m + 0.5 - self.floor_m))

    @property
    def height(self) -> float:
        return max(_MIN_HEIGHT, _TOP + _BOTTOM + self.scale * (self.high_m + 0.5 - self.floor_m))

    def across(self, place_m: float) -> float:
        middle = (_LEFT + _WIDTH - _RIGHT) / 2.0
        return middle + self.scale * (place_m - (self.left_m + self.right_m) / 2.0)

    def down(self, elevation_m: float) -> float:
        return self.height - _BOTTOM - self.scale * (elevation_m - self.floor_m)

    def grid(self) -> list[str]:
        """Lines and texts."""
        floor = self.height - _BOTTOM
        parts = []
        for tick in ticks(self.floor_m, self.high_m + 0.5, 3):
            place = self.down(tick)
            parts.append(line("grid", _LEFT, _WIDTH - _RIGHT, place, place))
            parts.append(text("tick", _LEFT - 4.0, place + 3.5, f"{tick:g}", anchor="end"))
        parts.append(line("axis", _LEFT, _WIDTH - _RIGHT, floor, floor))
        across = ticks(self.left_m, self.right_m, 5)
        parts += [text("tick", self.across(tick), floor + 14.0, f"{tick:g}") for tick in across]
        name = "metres across the building; elevation upwards, same scale"
        parts.append(text("name", (_LEFT + _WIDTH - _RIGHT) / 2.0, self.height - 6.0, name))
        return parts

    def lines(self, s: FloatArray, top: FloatArray, *, walls: bool) -> list[list[tuple[float, float]]]:
        """The pieces of a roof line, optionally with walls down to the floor."""
        known = np.isfinite(top)
        borders = np.flatnonzero(np.diff(known.astype(np.int8), prepend=0, append=0))
        found = []
        for first, end in zip(borders[::2].tolist(), borders[1::2].tolist(), strict=True):
            corners = [(self.across(s[i]), self.down(top[i])) for i in range(first, end)]
            if walls:
                floor = self.height - _BOTTOM
                corners = [(corners[0][0], floor), *corners, (corners[-1][0], floor)]
            found.append(corners)
        return found


def profile_line(
    truth: RoofModel, models: Sequence[RoofModel], xyz: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """The place of the profile: across the building, where its points are farthest from the models.

    Returns its middle (2,), the unit vector (2,) of the shorter side of the rectangle of the footprint, and half the
    length of that side, metres. The middle lies on the longer axis, not at its ends: in the stretch of 2 m with the
    largest sum of distances beyond 0.2 m, each at most 1 m; at the middle of the building if none is clearly worse.
    """
    rectangle = shapely.get_coordinates(shapely.minimum_rotated_rectangle(truth.footprint))
    sides = np.diff(rectangle[:3], axis=0)
    lengths = np.hypot(sides[:, 0], sides[:, 1])
    shorter = int(np.argmin(lengths))
    along, across = sides[shorter] / lengths[shorter], sides[1 - shorter] / lengths[1 - shorter]
    along, across = (axis if axis[0] >= 0.0 else -axis for axis in (along, across))
    middle = rectangle[:4].mean(axis=0)
    half = float(lengths[shorter]) / 2.0
    if len(xyz) == 0 or not models:
        return middle, along, half
    residual = xyz[:, 2] - top_of(models, xyz[:, 0], xyz[:, 1])
    away_m = np.nan_to_num(np.abs(residual), nan=_FAR_M)
    weight = np.where(away_m > _GOOD_M, np.minimum(away_m, _FAR_M), 0.0)
    long_half = _INNER * float(lengths[1 - shorter]) / 2.0
    stretches = max(1, round(2.0 * long_half / _STRETCH_M))
    edges = np.linspace(-long_half, long_half, stretches + 1)
    place = (xyz[:, :2] - middle) @ across
    sums = np.histogram(place, edges, weights=weight)[0]
    worst = int(np.argmax(sums))
    if sums[worst] <= _CLEARLY_WORSE * np.median(sums):
        return middle, along, half
    in_it = (place >= edges[worst]) & (place <= edges[worst + 1])
    return middle + across * np.average(place[in_it], weights=weight[in_it]), along, half


def _near_points(
    middle: FloatArray, along: FloatArray, models: Sequence[RoofModel], xyz: FloatArray
) -> tuple[FloatArray, LabelArray]:
    """Places along the profile with elevations, (k, 2), and classes of the points near it, thinned evenly."""
    away = xyz[:, :2] - middle
    across = np.abs(away @ np.array([-along[1], along[0]]))
    chosen = np.zeros(len(xyz), bool)
    for reach in _REACHES_M:
        chosen = across <= reach
        if chosen.sum() >= _ENOUGH_POINTS:
            break
    held = np.flatnonzero(chosen)
    held = held[:: max(1, math.ceil(len(held) / _POINTS))]
    residual = xyz[held, 2] - top_of(models, xyz[held, 0], xyz[held, 1])
    return np.column_stack([away[held] @ along, xyz[held, 2]]), residual_class(residual)
