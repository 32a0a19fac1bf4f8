"""Returns that the survey misplaces: the border of strips through a rectangle, wrong scan rows."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray
from pipeline.ruler.simulation.beam import line_state, row_chance
from pipeline.ruler.simulation.simulated_scene import FaultKind, SurveyFault

_X0, _Y0, _X1, _Y1, _IS_SHIFT, _DX, _DY, _DZ, _SIN, _COS, _SHARE, _OTHER = range(12)


def fault_rows(faults: tuple[SurveyFault, ...], places: FloatArray) -> FloatArray:
    """The faults whose rectangles come near places (n, >= 2), as an array (k, 12) for `move_faulty`."""
    rows = []
    if faults and len(places):
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        for fault in faults:
            x0, y0, x1, y1 = fault.extent
            if x0 <= high[0] and y0 <= high[1] and x1 >= low[0] and y1 >= low[1]:
                azimuth = math.radians(fault.azimuth_deg)
                is_shift = float(fault.kind is FaultKind.STRIP_SHIFT)
                border = math.sin(azimuth), math.cos(azimuth)
                other = -1.0 if fault.other_strip is None else float(fault.other_strip)
                rows.append((*fault.extent, is_shift, *fault.shift, *border, fault.share, other))
    return np.array(rows, dtype=np.float64).reshape(-1, 12)


@kernel
def move_faulty(places: FloatArray, lines: LabelArray, faults: FloatArray, seed: int, strip: int) -> LabelArray:
    """Move the returns at places (n, >= 3) of the scene frame that faults (k, 12) affect, in place.

    The place without any fault decides whether a return is affected; seed, strip and the scan line of each return (n,)
    decide which rows are wrong. Returns the number of the other strip that each return belongs to, (n,) int32; -1 where
    it stays in its own.
    """
    others = np.full(len(places), -1, np.int32)
    for k in range(len(places)):
        x, y = places[k, 0], places[k, 1]
        for fault in range(len(faults)):
            if x < faults[fault, _X0] or y < faults[fault, _Y0] or x >= faults[fault, _X1] or y >= faults[fault, _Y1]:
                continue
            if faults[fault, _IS_SHIFT] > 0.0:
                away_x = x - 0.5 * (faults[fault, _X0] + faults[fault, _X1])
                away_y = y - 0.5 * (faults[fault, _Y0] + faults[fault, _Y1])
                # To the right of the border's direction (sin, cos).
                is_wrong = away_x * faults[fault, _COS] - away_y * faults[fault, _SIN] > 0.0
            else:
                is_wrong = row_chance(line_state(seed, strip, lines[k]), 1) < faults[fault, _SHARE]
            if is_wrong:
                places[k, 0] += faults[fault, _DX]
                places[k, 1] += faults[fault, _DY]
                places[k, 2] += faults[fault, _DZ]
                if faults[fault, _OTHER] >= 0.0:
                    others[k] = np.int32(faults[fault, _OTHER])
    return others
