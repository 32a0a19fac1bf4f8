"""Teeth of a saw-tooth hall, which look like the slopes of two houses at a gutter."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pipeline.terrain.roof_patches import Patches

_STEEPER = 2.5
"""The back of a tooth rises by this factor more than its slope; the two sides of a gable differ by less."""
_ALIKE = 0.2
"""Largest difference of alike slopes, rise over run, as a share of the steeper slope at the valley."""


def are_teeth(patches: Patches, p: int, q: int, across: Mapping[int, set[int]]) -> bool:
    """Whether two patches that fall to one valley are of two alike teeth; `across` are those over ridges of each."""
    steep = np.hypot(*patches.slopes[[p, q]].T)
    if steep.max() < _STEEPER * steep.min():
        return False
    far = _ALIKE * float(steep.max())
    ends = ((p, q), (q, p))
    return all(
        any(math.dist(patches.slopes[other], patches.slopes[end]) <= far for other in across[start])
        for start, end in ends
    )
