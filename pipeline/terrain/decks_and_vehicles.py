"""Surfaces that look like roofs and are not: decks of bridges, and vehicles.

A deck is level with the ground along two opposite ends, over nearly their whole width, and free along its sides. A
house on a slope is level at one side only, the lid of an underground garage at three. Trees may hide one end of a
bridge: then its length distinguishes it. The moments of the outline where a surface is level with the ground show this,
compared with those of its area. For an area with second moments A about its centre, and level outline with second
moments L about the same place, both per weight, A^-1 L has eigenvalues that no stretching, turning or shearing of the
scene changes:

- two opposite ends: 3 across them and 1 along them, with the mean of the level outline at the centre;
- three sides of a square: 2.3 and 1.7; all four sides: 2 and 2;
- one side: 3 and 1, with the mean at this side.

A vehicle is narrow, low and free all around: the law limits its width to 2.55 m and its height to 4 m (directive
96/53/EC). Garden sheds are as narrow, and mostly lean on a hedge, a fence or a wall.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.terrain.fragment_sums import MOMENTS, Sum
from pipeline.terrain.terrain_settings import CandidateSettings

# Not settings: between two opposite ends and the shape nearest to them, three sides of a square.
_MIN_ACROSS, _MAX_ALONG = 2.45, 1.5
_MAX_OFFSET = 1.0
"""Largest offset of the mean of the level outline, squared, per second moment of the area.

It is 3 for one side and 0 for two. A car or a tree may hide half of one end: then it is a third. Where only a
quarter of one end is left, it is 1.
"""
_LONG = 8.0
"""Length over width from which one level end shows a deck."""
_LONG_OPEN_SHARE = 0.85
"""Share of the outline of such a deck that stands free."""
_MAX_SPACING = 0.25
"""Spacing of the points over the width of a vehicle up to which this width is known: an edge is known to half of it."""


def _centred(moments: IntArray, x: IntArray, y: IntArray) -> tuple[FloatArray, ...]:
    """First and second moments (x, y, xx, xy, yy) about places (k,) in dm, per weight, in m and m2.

    Sums of products wrap at 2^63, and so do these differences: the result is exact where it fits.
    """
    w, sx, sy, sxx, sxy, syy = moments.T
    each = np.maximum(1, w).astype(np.float64)
    return (
        (sx - w * x) / each / 10.0,
        (sy - w * y) / each / 10.0,
        (sxx - 2 * x * sx + w * x * x) / each / 100.0,
        (sxy - x * sy - y * sx + w * x * y) / each / 100.0,
        (syy - 2 * y * sy + w * y * y) / each / 100.0,
    )


def _columns(sums: IntArray, first: Sum) -> IntArray:
    """The moments (k, 6) of sums (k, N_SUMS)."""
    return sums[:, first : first + MOMENTS]


def _ends(level: tuple[FloatArray, ...], area: tuple[FloatArray, ...]) -> tuple[BoolArray, BoolArray, FloatArray]:
    """Whether level outlines (k,) lie at ends of areas, if at two opposite ones, and the length from end to end in m.

    `level` and `area` are moments about one place, those of the area about its centre.
    """
    x, y, lxx, lxy, lyy = level
    _, _, axx, axy, ayy = area
    determinant = np.maximum(1e-12, axx * ayy - axy * axy)
    m11, m12 = (ayy * lxx - axy * lxy) / determinant, (ayy * lxy - axy * lyy) / determinant
    m21, m22 = (axx * lxy - axy * lxx) / determinant, (axx * lyy - axy * lxy) / determinant
    middle = (m11 + m22) / 2.0
    half = np.sqrt(np.maximum(0.0, middle * middle - (m11 * m22 - m12 * m21)))
    across, along = middle + half, middle - half
    offset = (ayy * x * x - 2.0 * axy * x * y + axx * y * y) / determinant
    # the direction across the ends is an eigenvector; of its two forms the longer is the more exact
    first = (across - m22) * (across - m22) + m21 * m21 >= m12 * m12 + (across - m11) * (across - m11)
    p, q = np.where(first, across - m22, m12), np.where(first, m21, across - m11)
    # A p points from end to end; for a parallelogram of sides 2 s and 2 e, A = (s s^T + e e^T) / 3 and e is normal to p
    u, v = axx * p + axy * q, axy * p + ayy * q
    spread = (u * u + v * v) / np.maximum(1e-12, p * u + q * v)
    at_ends = (across >= _MIN_ACROSS) & (along <= _MAX_ALONG)
    return at_ends, at_ends & (offset <= _MAX_OFFSET), np.sqrt(12.0 * np.maximum(0.0, spread))


def shape_figures(sums: IntArray) -> dict[str, FloatArray]:
    """Measures of surfaces (k, N_SUMS) that show decks and vehicles, in metres and shares, each (k,).

    `end_share` is the share of a deck's two ends that is level with the ground; 0 where a surface does not look like a
    deck. Where the edge of the data cuts a deck that is longer than wide, or one end of a long deck is hidden, `ends`
    is 1, and the share is that of the other end.
    """
    area, level, gap = (_columns(sums, m) for m in (Sum.AREA_W, Sum.LEVEL_W, Sum.GAP_W))
    weight = np.maximum(1, area[:, 0])
    cx, cy = area[:, 1] // weight, area[:, 2] // weight
    dx, dy, axx, axy, ayy = _centred(area, cx, cy)
    about = (dx, dy, axx - dx * dx, axy - dx * dy, ayy - dy * dy)
    middle = (about[2] + about[4]) / 2.0
    half = np.sqrt(np.maximum(0.0, middle * middle - (about[2] * about[4] - about[3] * about[3])))
    # the facets end at the outermost points, half a spacing inside the edges
    facets_m2 = sums[:, Sum.AREA2] / 2e6
    spacing = np.sqrt(2.0 * facets_m2 / np.maximum(1, sums[:, Sum.FACETS]))
    level_m, share = level[:, 0] / 100.0, np.zeros(len(sums))
    distance, n_ends = np.zeros(len(sums)), np.zeros(len(sums))
    open_share = sums[:, Sum.OPEN] / np.maximum(1, sums[:, Sum.BOUNDARY])
    at_one, at_two, apart_m = _ends(_centred(level, cx, cy), about)
    at_one &= (apart_m * apart_m >= _LONG * facets_m2) & (open_share >= _LONG_OPEN_SHARE)
    at_cut, cut_m = _ends(_centred(level + gap, cx, cy), about)[1:]
    # a cut deck is longer than wide: any cut hall with one level side would look like a shorter one
    at_cut &= cut_m * cut_m >= facets_m2
    for found, ends, apart in ((at_one, 1.0, apart_m), (at_cut, 1.0, cut_m), (at_two, 2.0, apart_m)):
        ends_m = np.maximum(1e-6, ends * facets_m2 / np.maximum(1e-6, apart))
        share = np.where(found, level_m / ends_m, share)
        distance = np.where(found, apart, distance)
        n_ends = np.where(found, ends, n_ends)
    return {
        "end_share": share,
        "apart_m": distance,
        "ends": n_ends,
        "across_m": np.sqrt(12.0 * np.maximum(0.0, middle - half)) + spacing,
        "along_m": np.sqrt(12.0 * np.maximum(0.0, middle + half)) + spacing,
        "spacing_m": spacing,
        "open_share": open_share,
    }


def are_decks(f: dict[str, FloatArray], settings: CandidateSettings) -> BoolArray:
    """Which surfaces are decks of bridges, by their `shape_figures`."""
    decks: BoolArray = f["end_share"] >= settings.min_deck_end_share
    return decks


def are_vehicles(f: dict[str, FloatArray], settings: CandidateSettings) -> BoolArray:
    """Which surfaces are vehicles, by their `shape_figures` and the height of their top."""
    vehicles: BoolArray = (
        (f["across_m"] <= settings.max_vehicle_width_m)
        & (f["spacing_m"] <= _MAX_SPACING * settings.max_vehicle_width_m)
        & (f["along_m"] >= settings.min_vehicle_length_m)
        & (f["top_m"] <= settings.max_vehicle_height_m)
        & (f["open_share"] >= settings.min_vehicle_open_share)
    )
    return vehicles


def deck_detail(f: Mapping[str, float], settings: CandidateSettings) -> str:
    """What shows that a surface is a deck, with the threshold."""
    share, apart = f"level with the ground along {f['end_share']:.2f}", f"{f['apart_m']:.1f} m"
    ends = f"of two opposite ends, {apart} apart" if f["ends"] == 2.0 else f"of one end, {apart} from the other"
    return f"{share} {ends}, at least {settings.min_deck_end_share:g}"


def vehicle_detail(f: Mapping[str, float], settings: CandidateSettings) -> str:
    """What shows that a surface is a vehicle, with the threshold of its width."""
    size = f"{f['across_m']:.2f} m wide, at most {settings.max_vehicle_width_m:g}, {f['along_m']:.1f} m long"
    return f"{size}, {f['top_m']:.2f} m high, free along {f['open_share']:.2f} of the outline"
