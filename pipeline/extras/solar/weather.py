"""A year of sun and sky at one place, by the hour: a clear sky, or a file of a typical year. pvlib computes them.

All times are UTC inside: the sun's place needs the instant, the longitude and the latitude, and no time zone.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import RunError, UnreadableInputError
from pipeline.extras.solar.sunlight import light_above
from pipeline.model import FloatArray

YEAR = 2025
"""The year of clear skies: its sun is that of other years within a few minutes."""
_HOURS = (8760, 8784)
"""Hours of a year."""
_LOWEST_COSINE = 0.01745
"""Bound of the cosine of the sun's zenith angle in Hay and Davies' ratio, as in pvlib."""
_COLUMNS = ("ghi", "dni", "dhi")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Site:
    """A place on the earth."""

    longitude_deg: float
    """East of Greenwich."""
    latitude_deg: float
    """North."""
    altitude_m: float
    """Above sea."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weather:
    """Irradiances of the hours of a year."""

    times: Any
    """Instants in the middles of the hours, a pandas index with a time zone."""
    ghi: FloatArray
    """On level ground, W/m2."""
    dni: FloatArray
    """Of the beam, across it, W/m2."""
    dhi: FloatArray
    """Of the sky, on level ground, W/m2."""
    facts: dict[str, Any]
    """Where they come from, as plain JSON values."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class YearOfLight:
    """The light of a year by direction, in kWh/m2."""

    beam: FloatArray
    """Of the sun, as in `light_above`."""
    circumsolar: FloatArray
    """Of the bright sky around the sun, taken to come from the sun's own direction, as in `light_above`."""
    isotropic: float
    """Of the rest of the sky, on level ground."""
    ground: float
    """On level ground, of sun and sky together."""


def the_pvlib() -> Any:
    """The library; raises RunError if it is not installed."""
    try:
        import pvlib
    except ImportError as fault:
        raise RunError(
            f"irradiation needs pvlib, which is not installed ({fault}): pip install pvlib, or give --sky-only"
        ) from fault
    return pvlib


def clear_sky(site: Site, linke_turbidity: float | None) -> Weather:
    """A year without clouds, by Ineichen and Perez (2002).

    The Linke turbidity is the given one, or for each day that of pvlib's map of monthly means.
    """
    pvlib = the_pvlib()
    import pandas as pd

    times = pd.date_range(f"{YEAR}-01-01 00:30", f"{YEAR}-12-31 23:30", freq="h", tz="UTC")
    location = pvlib.location.Location(site.latitude_deg, site.longitude_deg, altitude=site.altitude_m)
    given = {} if linke_turbidity is None else {"linke_turbidity": linke_turbidity}
    sky = location.get_clearsky(times, model="ineichen", **given)
    return Weather(
        times=times,
        **{name: sky[name].to_numpy(float) for name in _COLUMNS},
        facts={
            "irradiance": "clear sky, Ineichen and Perez 2002",
            "linke_turbidity": "monthly map of pvlib" if linke_turbidity is None else linke_turbidity,
            "years": [YEAR],
        },
    )


def weather_of(path: str) -> Weather:
    """The hours of a file of a typical year: EPW (.epw), or a PVGIS download (.csv).

    Raises UnreadableInputError if the file cannot be read, or does not hold a year of hours.
    """
    pvlib = the_pvlib()
    import pandas as pd

    suffix = Path(path).suffix.lower()
    fix = "Give an EPW file (.epw) or the CSV of a typical meteorological year of PVGIS (.csv)"
    if suffix not in {".epw", ".csv"}:
        raise UnreadableInputError(path, f"ends in {suffix or 'nothing'}", fix)
    try:
        digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
        read = pvlib.iotools.read_epw if suffix == ".epw" else pvlib.iotools.read_pvgis_tmy
        data, metadata = read(path)
        values = {name: data[name].to_numpy(float) for name in _COLUMNS}
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as fault:
        raise UnreadableInputError(path, f"cannot be read ({str(fault)[:160]})", fix) from fault
    if len(data) not in _HOURS:
        raise UnreadableInputError(path, f"has {len(data)} rows, not the 8760 hours of a year", fix)
    if not all(
        np.isfinite(value).all() and (value >= 0.0).all() and (value < 2000.0).all() for value in values.values()
    ):
        raise UnreadableInputError(path, "has irradiances that are missing or not within 0 to 2000 W/m2", fix)
    place = metadata if suffix == ".epw" else metadata["inputs"]
    # an hour of an EPW is an average from its time on; PVGIS states where its instants are
    shift_h = 0.5 if suffix == ".epw" else float(place.get("irradiance time offset", 0.0))
    return Weather(
        times=data.index + pd.Timedelta(hours=shift_h),
        **values,
        facts={
            "irradiance": "file",
            "file": Path(path).name,
            "file_sha256": digest,
            "file_longitude_deg": float(place["longitude"]),
            "file_latitude_deg": float(place["latitude"]),
            "years": sorted({int(year) for year in data.index.year}),
        },
    )


def year_of_light(site: Site, weather: Weather) -> YearOfLight:
    """The year by direction, as Hay and Davies (1980) divide the sky: a part around the sun, and an isotropic rest.

    The part around the sun is the ratio of the beam to that above the air. Where the sun is below the horizontal all
    of the sky is isotropic.
    """
    pvlib = the_pvlib()
    sun = pvlib.solarposition.get_solarposition(
        weather.times, site.latitude_deg, site.longitude_deg, altitude=site.altitude_m
    )
    azimuth, elevation = sun["azimuth"].to_numpy(float), sun["apparent_elevation"].to_numpy(float)
    above_air = np.asarray(pvlib.irradiance.get_extra_radiation(weather.times), float)
    share = np.where(elevation > 0.0, np.minimum(weather.dni / above_air, 1.0), 0.0)
    cosine = np.maximum(np.sin(np.radians(elevation)), _LOWEST_COSINE)
    return YearOfLight(
        beam=light_above(azimuth, elevation, weather.dni / 1000.0),
        circumsolar=light_above(azimuth, elevation, weather.dhi * share / cosine / 1000.0),
        isotropic=float((weather.dhi * (1.0 - share)).sum() / 1000.0),
        ground=float(weather.ghi.sum() / 1000.0),
    )
