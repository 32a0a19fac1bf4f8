"""The figures of the roof planes of a tile: what each sees of the sky and receives of a year's light."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.extras.solar.horizon import Obstacles, horizons
from pipeline.extras.solar.roof_planes import RoofPlanes
from pipeline.extras.solar.sectors import SECTORS
from pipeline.extras.solar.sky_view import sky_views
from pipeline.extras.solar.solar_settings import SolarSettings
from pipeline.extras.solar.sunlight import received
from pipeline.extras.solar.weather import YearOfLight
from pipeline.model import FloatArray, IntArray

_AT_ONCE = 20_000
"""Points whose horizons are in memory together, 12 MB."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """Means over the sampled points of each plane; nan where a plane has no face."""

    samples: IntArray
    """(n,) number of points."""
    horizon_deg: FloatArray
    """(n, SECTORS) elevation of the horizon."""
    sky_view: FloatArray
    """(n,) sky view factor."""
    light: FloatArray
    """(n, 4) kWh/m2 of beam, sky, ground, and of the beam if nothing shaded the plane; (n, 0) without light."""


def figures(planes: RoofPlanes, obstacles: Obstacles, settings: SolarSettings, light: YearOfLight | None) -> Figures:
    """The figures of planes among obstacles, both in metres with y to the north to which azimuths refer."""
    points, owner = planes.samples(settings.samples)
    count = len(planes.slope_deg)
    number = np.bincount(owner, minlength=count)
    sums = np.zeros((count, SECTORS + 1 + (0 if light is None else 4)))
    for first in range(0, len(points), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        of = owner[part]
        tangents = horizons(points[part], planes.building[of], obstacles, settings.reach_m)
        normals = np.ascontiguousarray(planes.normals[of])
        columns = [np.degrees(np.arctan(tangents)), sky_views(tangents, normals)[:, None]]
        if light is not None:
            columns.append(_light(tangents, normals, columns[1][:, 0], settings.albedo, light))
        starts = np.flatnonzero(np.diff(of, prepend=-1))
        sums[of[starts]] += np.add.reduceat(np.hstack(columns), starts)
    with np.errstate(invalid="ignore"):  # no points: no figures
        means = sums / number[:, None]
    return Figures(
        samples=number.astype(np.int64),
        horizon_deg=means[:, :SECTORS],
        sky_view=means[:, SECTORS],
        light=means[:, SECTORS + 1 :],
    )


def _light(
    tangents: FloatArray, normals: FloatArray, sky_view: FloatArray, albedo: float, light: YearOfLight
) -> FloatArray:
    """(n, 4) kWh/m2 that points get, in the order of `Figures.light`.

    The ground fills what an open plane does not see of the sky, (1 - cos t) / 2; obstacles reflect nothing.
    """
    beam = received(tangents, normals, light.beam)
    sky = received(tangents, normals, light.circumsolar) + light.isotropic * sky_view
    ground = albedo * light.ground * (1.0 - normals[:, 2]) / 2.0
    found: FloatArray = np.column_stack([beam, sky, ground, received(np.zeros_like(tangents), normals, light.beam)])
    return found
