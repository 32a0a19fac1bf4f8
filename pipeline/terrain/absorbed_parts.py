"""Parts of a roof that join another part: small ones, those that it encloses, and its annexes."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.union_find import root_of, unite, united
from pipeline.model import IntArray, LabelArray
from pipeline.terrain.roof_patches import Borders, Patches
from pipeline.terrain.terrain_settings import UnitSettings


def absorbed(unit: IntArray, patches: Patches, borders: Borders, settings: UnitSettings) -> LabelArray:
    """Join to its neighbour what is too small, enclosed by one other unit, or its annex; the smallest first."""
    beside: dict[int, dict[int, float]] = {int(k): {} for k in unit}
    area = dict.fromkeys(beside, 0.0)
    outline = dict.fromkeys(beside, 0.0)
    volume = dict.fromkeys(beside, 0.0)  # area times elevation
    top = dict.fromkeys(beside, -math.inf)
    for k, own in enumerate(unit.tolist()):
        area[own] += float(patches.areas_m2[k])
        outline[own] += float(patches.outlines_m[k])
        volume[own] += float(patches.areas_m2[k] * patches.centres_m[k, 2])
        top[own] = max(top[own], float(patches.tops_m[k]))
    for p, q, length in zip(borders.first.tolist(), borders.second.tolist(), borders.length_m.tolist(), strict=True):
        a, b = int(unit[p]), int(unit[q])
        if a == b:
            outline[a] -= 2.0 * length
        else:
            beside[a][b] = beside[a].get(b, 0.0) + length
            beside[b][a] = beside[b].get(a, 0.0) + length
    into = {k: k for k in beside}
    waiting = sorted(beside, key=lambda k: (area[k], k))
    while waiting:
        again = []
        for k in waiting:
            if into[k] != k or not beside[k]:
                continue
            other = max(beside[k], key=lambda o: (beside[k][o], -o))
            enclosed = beside[k][other] >= settings.enclosed_share * outline[k] and area[k] < area[other]
            annex = (
                len(beside[k]) == 1
                and area[k] < settings.annex_share * area[other]
                and top[k] * area[other] < volume[other]
            )
            if area[k] >= settings.min_area_m2 and not enclosed and not annex:
                continue
            into[k] = other
            area[other] += area[k]
            volume[other] += volume[k]
            top[other] = max(top[other], top[k])
            outline[other] += outline[k] - 2.0 * beside[k][other]
            for o, length in beside[k].items():
                del beside[o][k]
                if o != other:
                    beside[other][o] = beside[other].get(o, 0.0) + length
                    beside[o][other] = beside[o].get(other, 0.0) + length
            again.append(other)
        # what has grown, and all beside it, may have become enclosed or enclosing
        touched = {t for k in again if into[k] == k for t in (k, *beside[k])}
        waiting = sorted(touched, key=lambda k: (area[k], k))

    def last(k: int) -> int:
        while into[k] != k:
            k = into[k]
        return k

    return _across_gaps(np.array([last(k) for k in unit.tolist()], np.int32), borders)


def _across_gaps(unit: LabelArray, borders: Borders) -> LabelArray:
    """Join parts that are connected only across gaps in the data: a gap does not separate buildings."""
    part = united(len(unit), borders.first, borders.second)
    return _united_across(part, unit.astype(np.int64), borders.gap_pairs.astype(np.int64))


@kernel
def _united_across(part: IntArray, whole: IntArray, gap_pairs: IntArray) -> LabelArray:
    """The sets `whole`, each as one of its members, after uniting the pairs (g, 2) that unite sets in `part`, too."""
    for g in range(len(gap_pairs)):
        if unite(part, gap_pairs[g, 0], gap_pairs[g, 1]):
            unite(whole, gap_pairs[g, 0], gap_pairs[g, 1])
    roots = np.empty(len(whole), np.int32)
    for k in range(len(whole)):
        roots[k] = root_of(whole, k)
    return roots
