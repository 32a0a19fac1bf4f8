"""Ridge steps: where a gable roof goes on a little higher or lower, one house of a row ends and the next one begins.

Houses of one design often differ by a decimetre or two. That is near the noise of single points, so one patch grows
over several houses. On average over a few metres the step is plain: both slopes step at the same place, by the same
amount and in the same sense. Solar panels, dormers and gutters show on one slope only, and a shift between two strips
in plan shows in opposite senses.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.terrain.roof_patches import Borders, GrownPatches

# Not settings: they follow from the size of houses and from statistics. The least step is a setting.
_BIN_M = 0.25
"""Steps are looked for at multiples of this along the ridge."""
_WINDOW_BINS = 12
"""3 m of roof on either side of a step: narrower than a house, so that the next step lies outside."""
_NEAR_MM = 300.0
"""Points farther from the plane of their patch are chimneys, dormers and what hangs over the roof."""
_ALIKE = 0.5
"""The steps of the two slopes differ by no more than this share of their mean."""
_SIGNIFICANT = 5.0
"""Least step on each slope in standard errors."""
_FEWEST = 5
"""Fewest points on one slope in a window."""
_ACROSS = 0.97
"""Cosine of 14 deg: a slope falls within this of the perpendicular of the ridge."""


def cut_at_ridge_steps(
    grown: GrownPatches, borders: Borders, ridges: IntArray, min_step_m: float
) -> tuple[GrownPatches, IntArray]:
    """The patches, cut where both slopes of a roof step by at least `min_step_m`, and what each was cut from, (k,).

    `ridges` are the rows of `borders` that are ridges between opposite slopes.
    """
    passed = np.zeros(len(grown.label), np.int64)
    roof = united(len(grown.planes), borders.first[ridges], borders.second[ridges])
    of_ridge = roof[borders.first[ridges]]
    for number in np.unique(of_ridge):
        rows = ridges[of_ridge == number]
        # the mean of doubled angles does not depend on the sense in which a border runs
        dx, dy = borders.direction[rows].T
        turn = 0.5 * np.angle(np.sum(borders.length_m[rows] * (dx + 1j * dy) ** 2))
        vertex = np.flatnonzero(roof[grown.label] == number)
        slopes = _slopes(grown, vertex, np.array([np.cos(turn), np.sin(turn)]))
        if slopes is not None:
            passed[vertex] = np.searchsorted(ridge_steps(slopes, min_step_m), slopes.way_m, side="right")
    keys, label = np.unique(grown.label * (passed.max() + 1) + passed, return_inverse=True)
    origin = keys // (passed.max() + 1)
    planes = grown.planes[origin]
    off, near = _off_mm(grown, np.arange(len(label)))
    count = np.bincount(label[near], minlength=len(keys))
    is_cut = (np.bincount(origin)[origin] > 1) & (count > 0)
    planes[is_cut, 2] += (np.bincount(label[near], off[near], minlength=len(keys)) / np.maximum(count, 1))[is_cut]
    return dataclasses.replace(grown, label=label.reshape(-1).astype(np.int32), planes=planes), origin


def _off_mm(grown: GrownPatches, vertex: IntArray) -> tuple[FloatArray, BoolArray]:
    """Elevation of vertices above the planes of their patches, and whether they lie near them."""
    x, y, z = (values[vertex] for values in grown.vertices[:3])
    a, b, level = grown.planes[grown.label[vertex]].T
    off = z - level - a * x - b * y
    return off, np.abs(off) <= _NEAR_MM


@dataclasses.dataclass(frozen=True, kw_only=True)
class Slopes:
    """Vertices of a roof of two slopes, in the frame of its ridge; n of them."""

    way_m: FloatArray
    """(n,) position along the ridge."""
    height_m: FloatArray
    """(n,) elevation above a roof that is level along the ridge."""
    side: IntArray
    """(n,) 0 or 1, the slope; -1 where a vertex lies on neither."""


def _slopes(grown: GrownPatches, vertex: IntArray, along: FloatArray) -> Slopes | None:
    """The frame of a ridge of direction `along`; None where one of the slopes does not fall across it."""
    ux, uy = along.tolist()
    patch = grown.label[vertex]
    number, size = np.unique(patch, return_counts=True)
    slope_x, slope_y = grown.planes[number, :2].T
    fall = slope_y * ux - slope_x * uy
    if (np.abs(fall) < _ACROSS * np.hypot(slope_x, slope_y)).any():
        return None
    pitch = np.array([np.average(fall[part], weights=size[part]) for part in (fall <= 0.0, fall > 0.0)])
    side = (fall > 0.0).astype(np.int64)[np.searchsorted(number, patch)]
    x, y, z = (values[vertex] / 1000.0 for values in grown.vertices[:3])
    _, near = _off_mm(grown, vertex)
    return Slopes(way_m=x * ux + y * uy, height_m=z - pitch[side] * (y * ux - x * uy), side=np.where(near, side, -1))


def ridge_steps(slopes: Slopes, min_step_m: float) -> FloatArray:
    """Positions along the ridge where both slopes step up or down by at least `min_step_m`, metres, ascending."""
    place = np.floor(slopes.way_m / _BIN_M).astype(np.int64)
    first, bins = int(place.min()), int(np.ptp(place)) + 1
    if bins < 2 * _WINDOW_BINS:
        return np.empty(0)
    (one, one_error), (other, other_error) = (
        _steps(place[on] - first, slopes.height_m[on], bins) for on in (slopes.side == 0, slopes.side == 1)
    )
    mean = 0.5 * (one + other)
    is_step = (np.abs(mean) >= min_step_m) & (np.abs(one - other) <= _ALIKE * np.abs(mean))
    is_step &= (np.abs(one) >= _SIGNIFICANT * one_error) & (np.abs(other) >= _SIGNIFICANT * other_error)
    size = np.where(is_step, np.abs(mean), 0.0)
    found = []
    while size.max() > 0.0:  # a step shows in all windows that hold it, and most where it is
        best = int(np.argmax(size))
        found.append((first + best) * _BIN_M)
        size[max(0, best - _WINDOW_BINS) : best + _WINDOW_BINS + 1] = 0.0
    return np.array(sorted(found))


def _steps(place: IntArray, height: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Step of the mean height at the start of every bin, (bins,), and its standard error, infinite without points."""
    sums = np.zeros((3, bins + 1))
    for k, values in enumerate((np.ones(len(height)), height, height**2)):
        sums[k, 1:] = np.cumsum(np.bincount(place, values, minlength=bins))
    step, variance = np.zeros(bins), np.full(bins, np.inf)
    inner = np.arange(_WINDOW_BINS, bins - _WINDOW_BINS + 1)
    inner = inner[inner < bins]
    before = sums[:, inner] - sums[:, inner - _WINDOW_BINS]
    behind = sums[:, inner + _WINDOW_BINS] - sums[:, inner]
    enough = np.minimum(before[0], behind[0]) >= _FEWEST
    inner, before, behind = inner[enough], before[:, enough], behind[:, enough]
    step[inner] = behind[1] / behind[0] - before[1] / before[0]
    variance[inner] = sum(part[2] / part[0] ** 2 - part[1] ** 2 / part[0] ** 3 for part in (before, behind))
    return step, np.sqrt(np.maximum(variance, 0.0))
