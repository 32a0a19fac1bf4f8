"""Averages the normals of facets over their surroundings in the TIN: small facets of a noisy cloud point anywhere.

The area vectors of connected facets add up to the vector of the whole patch, which depends on its border alone. So the
sum over a patch is its own mean normal, the more certain the wider the patch is, and not a mean of noisy angles.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, LabelArray

_NORMAL_NOISE = 1.5
"""Standard deviation of the slope of a Delaunay facet, in vertical noise over point spacing (measured: 1.3 to 1.8)."""


def passes_for_noise(sigma_m: float, spacing_m: float, wanted_deg: float, max_passes: int) -> int:
    """How often the normals are averaged until the noise turns them by at most a given angle, `max_passes` at most.

    0 where the facets are large enough as they are, or the noise is not known. The standard deviation of the vertical
    noise and the mean point spacing in plan, above 0, are nan if unknown; `wanted_deg`, above 0, is the standard
    deviation of the slope that is good enough.
    """
    if not (math.isfinite(sigma_m) and math.isfinite(spacing_m)):
        return 0
    # a patch is wider by about one spacing a pass
    widths = _NORMAL_NOISE * sigma_m / (spacing_m * math.tan(math.radians(wanted_deg)))
    return min(max(0, math.ceil(widths - 1.0)), max_passes)


@kernel
def smoothed_normals(
    normals: FloatArray, areas_m2: FloatArray, neighbours: LabelArray, usable: BoolArray, passes: int
) -> FloatArray:
    """Average upward unit normals (m, 3) over edges, as area vectors, to new unit normals.

    Parameters
    ----------
    areas_m2 : (m,) float64
        Surface areas.
    neighbours : (m, 3) int32
        The facets across the edges, -1 at the hull.
    usable : (m,) bool
        Others neither give nor take.
    passes : int
        How often every facet adds its neighbours' vectors to its own; 0 leaves the normals as they are.
    """
    vectors = np.empty_like(normals)
    for t in range(normals.shape[0]):
        for c in range(3):
            vectors[t, c] = normals[t, c] * areas_m2[t]
    for _ in range(passes):
        sums = vectors.copy()
        for t in range(normals.shape[0]):
            if not usable[t]:
                continue
            for k in range(3):
                other = neighbours[t, k]
                if other >= 0 and usable[other]:
                    for c in range(3):
                        sums[t, c] += vectors[other, c]
        vectors = sums
    smooth = normals.copy()
    if passes > 0:
        for t in range(normals.shape[0]):
            length = math.sqrt(vectors[t, 0] ** 2 + vectors[t, 1] ** 2 + vectors[t, 2] ** 2)
            if usable[t] and length > 0.0:
                for c in range(3):
                    smooth[t, c] = vectors[t, c] / length
    return smooth
