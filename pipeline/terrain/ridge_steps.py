"""Ridge steps: where a gable roof continues a little higher or lower, one house of a row ends and the next one begins.

Houses of one design often differ by a decimetre or two. That is near the noise of single points, so one patch grows
over several houses. On average over a few metres the step is plain: both slopes step at the same place, by the same
amount and in the same sense. Solar panels, dormers and gutters show on one slope only, and a shift between two strips
in plan shows in opposite senses. A ridge that sags or slopes steps nowhere. Strips differ in elevation, so only points
of one strip are compared.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.terrain.roof_patches import MIN_COSINE, Borders, GrownPatches

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
"""Least step on each slope in standard errors; also how far a step has to fit better than an even slope."""
_FEWEST = 5
"""Fewest points on one slope in a window."""
_ACROSS = 0.97
"""Cosine of 14 deg: a slope falls within this of the perpendicular of the ridge."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows of `Borders` by which patches are of one row of houses."""

    ridges: IntArray
    """Ridges between opposite slopes."""
    continued: IntArray
    """Between patches of one slope, one beside the other or one below the other."""


def cut_at_ridge_steps(
    grown: GrownPatches, borders: Borders, rows: Rows, strip: IntArray, min_step_m: float
) -> tuple[GrownPatches, IntArray, IntArray]:
    """The patches, cut where both slopes of a roof step by at least `min_step_m`; roof and house of each, both (k,).

    What ridges and slopes that go on unite is one roof, however its patches grew. Its houses are numbered along the
    ridge. `strip` (n,) are the flight strips of the vertices.
    """
    passed = np.zeros(len(grown.label), np.int64)
    every = np.concatenate((rows.ridges, rows.continued))
    roof = united(len(grown.planes), borders.first[every], borders.second[every])
    for number in np.unique(roof[borders.first[rows.ridges]]):
        slopes = _slopes(grown, np.flatnonzero(roof[grown.label] == number), strip)
        passed[slopes.vertex] = np.searchsorted(ridge_steps(slopes, min_step_m), slopes.way_m, side="right")
    if not passed.any():
        return grown, roof, np.zeros(len(roof), np.int64)
    keys, label = np.unique(grown.label * (passed.max() + 1) + passed, return_inverse=True)
    origin = keys // (passed.max() + 1)
    planes = grown.planes[origin]
    off, near = _off_mm(grown, np.arange(len(label)))
    count = np.bincount(label[near], minlength=len(keys))
    is_cut = (np.bincount(origin)[origin] > 1) & (count > 0)
    planes[is_cut, 2] += (np.bincount(label[near], off[near], minlength=len(keys)) / np.maximum(count, 1))[is_cut]
    cut = dataclasses.replace(grown, label=label.reshape(-1).astype(np.int32), planes=planes)
    return cut, roof[origin], keys % (passed.max() + 1)


def _off_mm(grown: GrownPatches, vertex: IntArray) -> tuple[FloatArray, BoolArray]:
    """Elevation of vertices above the planes of their patches, and whether they lie near them."""
    x, y, z = (values[vertex] for values in grown.vertices[:3])
    a, b, level = grown.planes[grown.label[vertex]].T
    off = z - level - a * x - b * y
    return off, np.abs(off) <= _NEAR_MM


@dataclasses.dataclass(frozen=True, kw_only=True)
class Slopes:
    """Vertices of a roof of two slopes, in the frame of its ridge; n of them."""

    vertex: IntArray
    """(n,) their numbers."""
    way_m: FloatArray
    """(n,) position along the ridge."""
    height_m: FloatArray
    """(n,) elevation above a roof that is level along the ridge."""
    side: IntArray
    """(n,) 0 or 1, the slope; -1 where a vertex lies on neither."""
    strip: IntArray
    """(n,) the flight strip."""


def _slopes(grown: GrownPatches, vertex: IntArray, strip: IntArray) -> Slopes:
    """Vertices of a roof in the frame of its ridge, which runs across the mean fall of the slopes.

    The planes show that direction to a tenth of a degree. Borders between points do not: along a ridge that is turned
    by one degree, steep slopes seem to step by 5 cm within 3 m, one up and the other one down.
    """
    patch = grown.label[vertex]
    counts = np.bincount(patch, minlength=len(grown.planes))
    number = np.flatnonzero(counts)
    inverse, size = (np.cumsum(counts > 0) - 1)[patch], counts[number]
    slope_x, slope_y = grown.planes[number, :2].T
    # doubled angles, since the slopes fall to both sides
    turn = 0.5 * np.angle(-np.sum(size * (slope_x + 1j * slope_y) ** 2))
    ux, uy = np.cos(turn), np.sin(turn)
    fall = slope_y * ux - slope_x * uy
    side_of = np.where(np.abs(fall) < _ACROSS * np.hypot(slope_x, slope_y), -1, (fall > 0.0).astype(np.int64))
    pitch = np.zeros(len(number))
    for side in (0, 1):
        part = np.flatnonzero(side_of == side)
        if len(part):  # the steep part of a mansard roof lies on neither slope
            main = fall[part[np.argmax(size[part])]]
            is_other = (1.0 + fall[part] * main) / np.sqrt((1.0 + fall[part] ** 2) * (1.0 + main**2)) < MIN_COSINE
            side_of[part[is_other]] = -1
            part = part[~is_other]
            pitch[part] = (fall[part] * size[part]).sum() / size[part].sum()
    x, y, z = (values[vertex] / 1000.0 for values in grown.vertices[:3])
    _, near = _off_mm(grown, vertex)
    return Slopes(
        vertex=vertex,
        way_m=x * ux + y * uy,
        height_m=z - pitch[inverse] * (y * ux - x * uy),
        side=np.where(near, side_of[inverse], -1),
        strip=strip[vertex],
    )


def ridge_steps(slopes: Slopes, min_step_m: float) -> FloatArray:
    """Positions along the ridge where both slopes step up or down by at least `min_step_m`, metres, ascending."""
    place = np.floor(slopes.way_m / _BIN_M).astype(np.int64)
    first, bins = int(place.min()), int(np.ptp(place)) + 1
    if bins < 2 * _WINDOW_BINS:
        return np.empty(0)
    one = _steps(slopes, place - first, bins, 0)
    if not (np.abs(one.step) >= _SIGNIFICANT * one.error).any():  # as on most roofs
        return np.empty(0)
    other = _steps(slopes, place - first, bins, 1)
    mean = 0.5 * (one.step + other.step)
    is_step = (np.abs(mean) >= min_step_m) & (np.abs(one.step - other.step) <= _ALIKE * np.abs(mean))
    is_step &= (np.abs(one.step) >= _SIGNIFICANT * one.error) & (np.abs(other.step) >= _SIGNIFICANT * other.error)
    noise = (one.left + other.left) / np.maximum(one.points + other.points - 4.0, 1.0)
    is_step &= one.as_step + other.as_step - one.as_slope - other.as_slope >= _SIGNIFICANT**2 * noise
    size = np.where(is_step, np.abs(mean), 0.0)
    found = []
    while size.max() > 0.0:  # a step shows in all windows that hold it, and most where it is
        best = int(np.argmax(size))
        found.append((first + best) * _BIN_M)
        size[max(0, best - _WINDOW_BINS) : best + _WINDOW_BINS + 1] = 0.0
    return np.array(sorted(found))


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Steps:
    """Step of one slope at the start of every bin, (bins,)."""

    step: FloatArray
    """Mean height behind less that before, metres; 0 without points."""
    error: FloatArray
    """Its standard error, metres; infinite without points."""
    as_step: FloatArray
    """Sum of squares in the window that a step explains, m2."""
    as_slope: FloatArray
    """The same for a ridge that rises or sags evenly over the window."""
    left: FloatArray
    """Sum of squares in the window that the step leaves, m2."""
    points: FloatArray
    """Points in the window."""


def _steps(slopes: Slopes, place: IntArray, bins: int, side: int) -> _Steps:
    """The steps of one slope, from the points of each strip for itself: strips may differ in elevation.

    With the strips' elevations as unknowns, least squares weigh the step of every strip by n m / (n + m) of the n
    points before it and the m points behind it.
    """
    weight, step, variance, tt, th, left, points = np.zeros((7, bins))
    inner = np.arange(_WINDOW_BINS, bins - _WINDOW_BINS + 1)
    inner = inner[inner < bins]
    on_side = np.flatnonzero(slopes.side == side)
    order = np.argsort(slopes.strip[on_side], kind="stable")
    _, counts = np.unique(slopes.strip[on_side], return_counts=True)
    for on in np.split(on_side[order], np.cumsum(counts)[:-1]):
        if len(on) < 2 * _FEWEST:
            continue
        t, h = slopes.way_m[on] - slopes.way_m[0], slopes.height_m[on] - slopes.height_m[0]
        sums = np.zeros((6, bins + 1))
        for k, values in enumerate((np.ones(len(on)), h, h * h, t, t * t, t * h)):
            sums[k, 1:] = np.cumsum(np.bincount(place[on], values, minlength=bins))
        before = sums[:, inner] - sums[:, inner - _WINDOW_BINS]
        behind = sums[:, inner + _WINDOW_BINS] - sums[:, inner]
        enough = np.minimum(before[0], behind[0]) >= _FEWEST
        at, before, behind = inner[enough], before[:, enough], behind[:, enough]
        n, _, _, t1, t2, _ = both = before + behind
        own = before[0] * behind[0] / n
        weight[at] += own
        step[at] += own * (behind[1] / behind[0] - before[1] / before[0])
        points[at] += n
        for part in (before, behind):
            squares = part[2] - part[1] ** 2 / part[0]
            left[at] += squares
            variance[at] += own**2 * squares / part[0] ** 2
        tt[at] += t2 - t1 * t1 / n
        th[at] += both[5] - t1 * both[1] / n
    seen = weight > 0.0
    step[seen] /= weight[seen]
    error = np.full(bins, np.inf)
    error[seen] = np.sqrt(np.maximum(variance[seen], 0.0)) / weight[seen]
    as_slope = np.divide(th**2, tt, out=np.zeros(bins), where=tt > 0.0)
    return _Steps(step=step, error=error, as_step=weight * step**2, as_slope=as_slope, left=left, points=points)
