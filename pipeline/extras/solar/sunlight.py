"""The light of the sun's places in a year, summed by direction once, and what planes get of it."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.extras.solar.sectors import SECTOR_RAD, SECTORS
from pipeline.extras.solar.sky_view import lowest_visible
from pipeline.model import FloatArray

BANDS = 90
"""Number of bands of elevation up to the zenith, 1 degree each."""


def light_above(azimuth_deg: FloatArray, elevation_deg: FloatArray, energy: FloatArray) -> FloatArray:
    """The light from above each elevation, by sector of azimuth, as vectors: (SECTORS, BANDS + 1, 3).

    The entry of a sector and an elevation of b degrees is the sum of energy times direction over all suns of the
    sector that are at least so high. A plane that sees all of them gets exactly the product of that sum with its
    normal, so nothing is lost by binning except where a horizon cuts a bin.

    Parameters
    ----------
    azimuth_deg, elevation_deg : FloatArray
        (m,) places of the sun; suns below the horizontal give nothing.
    energy : FloatArray
        (m,) energy per area across the beam.
    """
    up = elevation_deg > 0.0
    azimuth, elevation = np.radians(azimuth_deg[up]), np.radians(elevation_deg[up])
    level = np.cos(elevation)
    light = energy[up, None] * np.column_stack([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)])
    sector = np.round(azimuth / SECTOR_RAD).astype(int) % SECTORS
    band = np.minimum(elevation_deg[up].astype(int), BANDS - 1)
    found = np.zeros((SECTORS, BANDS + 1, 3))
    np.add.at(found, (sector, band), light)
    above: FloatArray = np.ascontiguousarray(np.cumsum(found[:, ::-1], axis=1)[:, ::-1])
    return above


@kernel
def received(tangents: FloatArray, normals: FloatArray, above: FloatArray) -> FloatArray:
    """(n,) energy per area that points get, shaded by their horizons.

    `tangents` (n, SECTORS) are of the horizons' elevations, `normals` (n, 3) of the planes, `above` is the light of
    `light_above`. A band that a horizon cuts gives its part above the horizon.
    """
    found = np.zeros(len(tangents))
    for i in range(len(tangents)):
        for sector in range(SECTORS):
            low = math.degrees(lowest_visible(tangents[i, sector], normals[i], sector * SECTOR_RAD))
            band = min(int(low), BANDS - 1)
            part = low - band
            energy = 0.0
            for axis in range(3):
                light = (1.0 - part) * above[sector, band, axis] + part * above[sector, band + 1, axis]
                energy += normals[i, axis] * light
            found[i] += max(0.0, energy)
    return found
