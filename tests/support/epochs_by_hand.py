"""Pairs of runs made by hand: exact houses on level ground, written as a run writes them."""

import dataclasses
import datetime as dt
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import shapely

from pipeline.export.record_rows import RecordContext, RejectedObject
from pipeline.export.tile import write_tile
from pipeline.io.crs import SpatialReference, horizontal_unit_of, vertical_unit_of
from pipeline.model import BuildingResult, ModelQuality, Reason, RoofType, Status
from pipeline.ruler.epochs.diff import DiffRequest, diff
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Terrain, place_building
from pipeline.ruler.simulation.solids import truth_record
from pipeline.runtime.manifest import InputFile, RunManifest, RunStatus, write_manifest

ORIGIN = (565_000.0, 5_934_000.0, 0.0)
"""Origin of all scenes: east and north in metres."""
EXTENT = (-500.0, -500.0, 500.0, 500.0)
"""Where both epochs have data by default, about the origin."""
UTM = "EPSG:25832+7837"
GROUND = Terrain(base_z_m=100.0)


def house(
    name: str,
    x: float = 0.0,
    y: float = 0.0,
    *,
    shape: RoofShape = RoofShape.GABLE,
    length: float = 12.0,
    width: float = 9.0,
    pitch: float = 35.0,
    eave: float = 5.0,
    azimuth: float = 20.0,
    sigma: float = math.nan,
    at_edge: bool = False,
    origin: tuple[float, float, float] = ORIGIN,
) -> BuildingResult:
    """A house with its middle at a place; `sigma` is the uncertainty of its roof in the record."""
    built = place_building(
        name,
        shape,
        RoofDimensions(length_m=length, width_m=width, pitch_deg=0.0 if shape is RoofShape.FLAT else pitch),
        at=(x, y),
        azimuth_deg=azimuth,
        eave_height_m=eave,
        terrain=GROUND,
    )
    record = truth_record(built, origin, touches_data_edge=at_edge)
    return dataclasses.replace(record, source_id=None, quality=ModelQuality(ridge_z_sigma_m=sigma, noise_m=sigma))


def failed(name: str, x: float, y: float, side: float = 10.0) -> BuildingResult:
    """A candidate without a model."""
    whole = house(name, x, y)
    return dataclasses.replace(
        whole,
        status=Status.FAILED,
        reason=Reason.NO_PLANE,
        reason_detail="no plane",
        roof_type=RoofType.NONE,
        lod="",
        footprint=shapely.box(-side / 2, -side / 2, side / 2, side / 2),
        planes=(),
        faces=(),
        solids=(),
    )


def rejected(name: str, x: float, y: float, side: float = 10.0, height: float = 7.0) -> RejectedObject:
    """An object that was rejected as a building."""
    return RejectedObject(
        object_id=name,
        origin=(ORIGIN[0] + x, ORIGIN[1] + y, 100.0),
        reason=Reason.VEGETATION,
        reason_detail="rough",
        outline=shapely.box(-side / 2, -side / 2, side / 2, side / 2),
        area_m2=side * side,
        height_m=height,
        n_points=300,
    )


def reference_of(crs: str | None) -> SpatialReference:
    """The reference system of a code."""
    if crs is None:
        return SpatialReference()
    found = pyproj.CRS.from_user_input(crs)
    horizontal = horizontal_unit_of(found, path="")
    return SpatialReference(
        wkt=found.to_wkt("WKT2_2019"),
        name=found.name,
        epsg=found.to_epsg(),
        horizontal_unit_m=horizontal,
        vertical_unit_m=vertical_unit_of(found) or horizontal,
    )


def write_epoch(
    folder: Path,
    buildings: Mapping[str, Sequence[BuildingResult]] | Sequence[BuildingResult],
    *,
    others: Sequence[RejectedObject] = (),
    crs: str | None = UTM,
    extent: tuple[float, float, float, float] | None = EXTENT,
    **manifest: Any,
) -> Path:
    """Write a run; without names of tiles all buildings are of one."""
    by_tile = buildings if isinstance(buildings, Mapping) else {"x1_y1": buildings}
    reference = reference_of(crs)
    context = RecordContext(reference=reference, settings_hash="ab", engine_version="0")
    for number, (key, owned) in enumerate(by_tile.items()):
        write_tile(folder, key, list(owned), list(others) if number == 0 else [], context, meshes="none")
    bounds = None
    if extent is not None:
        bounds = (extent[0] + ORIGIN[0], extent[1] + ORIGIN[1], extent[2] + ORIGIN[0], extent[3] + ORIGIN[1])
    facts = {
        "status": RunStatus.FINISHED,
        "engine_version": "0",
        "method": "arrangement",
        "settings": {},
        "settings_hash": "ab",
        "started_at": dt.datetime(2026, 1, 1, tzinfo=dt.UTC),
        "crs": dataclasses.asdict(reference),
        "inputs": (InputFile(path="a.laz", sha256="0", size_bytes=1, n_points=9, bounds_m=bounds),),
        **manifest,
    }
    write_manifest(folder, RunManifest(**facts))
    return folder


def compared(old: Path, new: Path, out: Path, settings: DiffSettings | None = None) -> pa.Table:
    """The rows of `changes.parquet`."""
    diff(DiffRequest(old=str(old), new=str(new), out=str(out), settings=settings or DiffSettings(), geojson="none"))
    return pq.read_table(out / "changes.parquet")


def by_name(table: pa.Table) -> dict[str, dict[str, Any]]:
    """The rows by the names of their buildings without the epoch's mark: `a1` of OLD and `a2` of NEW are `a`."""
    found = {}
    for row in table.to_pylist():
        name = "+".join(sorted({one[:-1] for one in (*row["old_ids"], *row["new_ids"])}))
        assert name not in found
        found[name] = row
    return found
