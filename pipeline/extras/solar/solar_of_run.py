"""Solar energy on the roofs of a finished run, tile by tile. The run directory is read and never changed."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import table_batches
from pipeline.export.result_file import SUFFIX, ResultFile
from pipeline.extras.publish.finished_run import FinishedRun, Published, file_outside, new_file
from pipeline.extras.solar.figures import Figures, figures
from pipeline.extras.solar.horizon import obstacles_of
from pipeline.extras.solar.roof_planes import RoofPlanes
from pipeline.extras.solar.solar_settings import SolarSettings
from pipeline.extras.solar.solar_table import TABLE
from pipeline.extras.solar.true_north import convergence_deg, longitude_and_latitude
from pipeline.extras.solar.weather import Site, Weather, YearOfLight, clear_sky, the_pvlib, weather_of, year_of_light
from pipeline.io import SpatialReference
from pipeline.runtime.manifest import RunManifest
from pipeline.runtime.monitoring.progress import Event, Listener, ignore
from pipeline.runtime.run_tiles import TILES_IN_MEMORY, RunTiles

_TABLE = "planes"
_COLUMNS = (
    *("building_id", "plane_id", "geometry", "slope_deg", "aspect_deg", "area_m2"),
    *("origin_x", "origin_y", "origin_z", "coefficients"),
)
_FAR_KM = 100.0
"""A weather file from farther away gets a warning."""


def solar(  # each is an option of the command
    run_dir: str,
    out: str,
    *,
    settings: SolarSettings | None = None,
    weather: str | None = None,
    sky_only: bool = False,
    overwrite: bool = False,
    on_event: Listener = ignore,
) -> Published:
    """Write what each roof plane of a finished run sees of the sky and receives of the sun in a year, as GeoParquet.

    The other parameters and errors are as in `publishing.Form`. Raises RunError if pvlib is missing or the CRS unknown
    and irradiation is wanted, UnreadableInputError for a weather file.

    Parameters
    ----------
    settings : SolarSettings, optional
        Reach, samples, albedo and turbidity.
    weather : str, optional
        A file of a typical year; a clear sky without it.
    sky_only : bool
        Leave the columns of energy empty; neither pvlib nor a CRS is needed.
    """
    settings = settings or SolarSettings()
    target = file_outside(run_dir, out, SUFFIX, overwrite)
    finished = FinishedRun.at(run_dir, {_TABLE})
    run = _Run(run_dir, finished.manifest)
    light, light_facts = (None, {}) if sky_only else _light(run, settings, weather, on_event)
    facts = {**finished.facts, **_assumptions(settings, run.reference), **light_facts}
    with new_file(target, overwrite) as made:
        with ResultFile(TABLE, made, run.reference.projjson, facts) as file:
            for done, tile in enumerate(run.tiles, start=1):
                _write_tile(file, run, tile, settings, light)
                on_event(Event(kind="progress", stage="solar", done=done, total=len(run.tiles)))
        finished.check({})
    return Published(place=str(target), size_bytes=target.stat().st_size, rows={"planes": file.rows})


class _Run(RunTiles):
    """The roof planes of a run by tile, in metres; a bounded number of tiles is in memory."""

    def __init__(self, run_dir: str, manifest: RunManifest) -> None:
        super().__init__(run_dir, manifest, _TABLE)
        self.tile: Callable[[str], tuple[Mapping[str, Any], RoofPlanes]]
        self.tile = functools.lru_cache(TILES_IN_MEMORY)(self._tile)

    def _tile(self, tile: str) -> tuple[Mapping[str, Any], RoofPlanes]:
        """The columns of a tile's planes as they are stored, and the planes in metres."""
        batches = list(self.batches(_COLUMNS, tile))
        columns = {name: [value for batch in batches for value in batch.column(name).to_pylist()] for name in _COLUMNS}
        unit = self.unit_m
        faces = shapely.from_wkb(np.array([*columns["geometry"], None], dtype=object)[:-1])
        columns["faces"] = faces
        coefficients = np.array(columns["coefficients"], float).reshape(-1, 4)
        origin = np.column_stack([columns[f"origin_{axis}"] for axis in "xyz"]).reshape(-1, 3).astype(float)
        origin[:, 2] -= coefficients[:, 3] / coefficients[:, 2]
        ids = np.array(columns["building_id"], dtype=str)
        return columns, RoofPlanes(
            faces=shapely.transform(faces, lambda xyz: xyz * unit, include_z=True),
            building=_numbers(ids),
            slope_deg=np.array(columns["slope_deg"], float),
            aspect_deg=np.array(columns["aspect_deg"], float),
            through=origin * unit,
        )

    def site(self) -> Site | None:
        """The centre of the run at the mean elevation of the ground under its buildings; None without planes."""
        if np.isnan(self.bounds).all():
            return None
        low, high = np.nanmin(self.bounds[:, :2], axis=0), np.nanmax(self.bounds[:, 2:], axis=0)
        x, y = (low + high) / 2.0
        longitude, latitude = longitude_and_latitude(self.reference, x, y)
        total, number = 0.0, 0
        for batch in table_batches(self._place, "buildings", ["ground_z"], self._filesystem):
            known = batch.column("ground_z").drop_null().to_numpy(zero_copy_only=False)
            total, number = total + math.fsum(known), number + len(known)
        altitude = total / number * self.reference.vertical_unit_m if number else 0.0
        return Site(longitude_deg=round(longitude, 6), latitude_deg=round(latitude, 6), altitude_m=round(altitude, 1))


def _numbers(ids: Any) -> Any:
    """(n,) numbers of the runs of equal ids, from 0 on."""
    return np.cumsum(np.append(False, ids[1:] != ids[:-1])[: len(ids)]).astype(np.int64)


def _light(
    run: _Run, settings: SolarSettings, weather: str | None, on_event: Listener
) -> tuple[YearOfLight | None, dict[str, Any]]:
    """The light of a year at the run's centre, and what the file says about it; None if the run has no planes.

    Raises RunError if the CRS is unknown or pvlib is missing.
    """
    if run.reference.wkt is None:
        raise RunError(
            "the CRS of the run is unknown, so the sun's place is, too: run it again with a CRS, such as EPSG:25832"
        )
    pvlib = the_pvlib()
    site = run.site()
    if site is None:
        return None, {}
    year: Weather = clear_sky(site, settings.linke_turbidity) if weather is None else weather_of(weather)
    if weather is not None:
        _warn_if_far(site, year, on_event)
    return year_of_light(site, year), {
        **year.facts,
        "longitude_deg": site.longitude_deg,
        "latitude_deg": site.latitude_deg,
        "altitude_m": site.altitude_m,
        "transposition": "Hay and Davies 1980",
        "albedo": settings.albedo,
        "pvlib_version": pvlib.__version__,
    }


def _warn_if_far(site: Site, year: Weather, on_event: Listener) -> None:
    """Warn of weather from elsewhere."""
    import pyproj

    longitude, latitude = year.facts["file_longitude_deg"], year.facts["file_latitude_deg"]
    _, _, metres = pyproj.Geod(ellps="WGS84").inv(site.longitude_deg, site.latitude_deg, longitude, latitude)
    if metres > _FAR_KM * 1000.0:
        text = f"{year.facts['file']} is of a place {metres / 1000.0:.0f} km away: irradiation is that of its weather"
        on_event(Event(kind="warning", message=text))


def _assumptions(settings: SolarSettings, reference: SpatialReference) -> dict[str, Any]:
    """What the file says about the sky that planes see."""
    return {
        "azimuth_from": "grid north" if reference.wkt is None else "true north",
        "reach_m": settings.reach_m,
        "samples": settings.samples,
        "obstacles": "roofs of the run's models; no terrain, no trees",
    }


def _write_tile(file: ResultFile, run: _Run, tile: str, settings: SolarSettings, light: YearOfLight | None) -> None:
    """Add the rows of a tile, if it has any."""
    columns, planes = run.tile(tile)
    if not len(planes.faces):
        return
    if np.isnan(planes.bounds).any():
        centre, north = np.zeros(3), 0.0
    else:
        x0, y0, x1, y1 = planes.bounds
        centre = np.array([(x0 + x1) / 2.0, (y0 + y1) / 2.0, planes.through[0, 2]])
        north = convergence_deg(run.reference, centre[0], centre[1])
    turned = planes.turned(centre, north)
    edges, numbers = [np.zeros((0, 6))], [np.zeros(0, np.int64)]
    for other in run.near(tile, settings.reach_m):
        found, building = run.tile(other)[1].turned(centre, north).edges()
        edges.append(found)
        numbers.append(building + (numbers[-1].max(initial=-1) + 1))
    obstacles = obstacles_of(np.concatenate(edges), np.concatenate(numbers))
    result = figures(turned, obstacles, settings, light)
    file.write({"tile": [tile] * len(planes.faces), **_rows(columns, turned, result)}, columns["faces"])


def _rows(columns: Mapping[str, Any], planes: RoofPlanes, found: Figures) -> dict[str, Any]:
    """The columns of the table, rounded, except `tile` and `bbox`."""
    area = np.array(columns["area_m2"], float)
    energy = found.light if found.light.shape[1] else np.full((len(area), 4), np.nan)
    total = energy[:, :3].sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):  # no beam at all: no share of it
        loss = np.where(energy[:, 3] > 0.0, 1.0 - energy[:, 0] / energy[:, 3], np.nan)
    azimuth = np.where(planes.slope_deg > 0.0, np.round(planes.aspect_deg, 4) % 360.0, 0.0)
    return {
        "building_id": columns["building_id"],
        "plane_id": columns["plane_id"],
        "geometry": columns["geometry"],
        "azimuth_deg": azimuth,
        "tilt_deg": planes.slope_deg,
        "area_m2": area,
        "samples": found.samples,
        "sky_view": np.round(found.sky_view, 4),
        "horizon_deg": np.round(found.horizon_deg, 1),
        "irradiation_kwh_m2": np.round(total, 1),
        "irradiation_kwh": np.round(total * area, 1),
        "beam_kwh_m2": np.round(energy[:, 0], 1),
        "sky_kwh_m2": np.round(energy[:, 1], 1),
        "ground_kwh_m2": np.round(energy[:, 2], 1),
        "beam_loss": np.round(np.clip(loss, 0.0, 1.0), 4),
    }
