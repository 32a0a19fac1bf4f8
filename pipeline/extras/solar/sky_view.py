"""The sky view factor of inclined planes: the share of an isotropic sky's light that reaches them.

F = 1/pi times the integral of max(0, n . s) over the visible directions s above the horizontal, with the plane's normal
n: the view factor of radiation. In the open, a plane of slope t has (1 + cos t) / 2.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.extras.solar.sectors import SECTOR_RAD, SECTORS
from pipeline.model import FloatArray


@kernel
def lowest_visible(tangent: float, normal: FloatArray, azimuth_rad: float) -> float:
    """Elevation in radians above which a plane sees the sky: of the horizon, or of the plane itself if that is higher.

    `tangent` is of the horizon's elevation in that azimuth, `normal` (3,) the plane's.
    """
    level = normal[0] * math.sin(azimuth_rad) + normal[1] * math.cos(azimuth_rad)
    return max(math.atan(tangent), math.atan2(-level, normal[2]))


@kernel
def sky_views(tangents: FloatArray, normals: FloatArray) -> FloatArray:
    """(n,) sky view factors of points by the tangents of their horizons (n, SECTORS) and their planes' normals (n, 3).

    Within a sector of azimuth, n . s = A cos e + C sin e at elevation e, so the integral over cos e de from the lowest
    visible elevation to the zenith is A/2 (pi/2 - e - sin e cos e) + C/2 cos2 e.
    """
    found = np.zeros(len(tangents))
    for i in range(len(tangents)):
        total = 0.0
        for sector in range(SECTORS):
            azimuth = sector * SECTOR_RAD
            level = normals[i, 0] * math.sin(azimuth) + normals[i, 1] * math.cos(azimuth)
            low = lowest_visible(tangents[i, sector], normals[i], azimuth)
            cos, sin = math.cos(low), math.sin(low)
            total += level * (math.pi / 2.0 - low - sin * cos) + normals[i, 2] * cos * cos
        found[i] = min(1.0, max(0.0, total * SECTOR_RAD / (2.0 * math.pi)))
    return found
