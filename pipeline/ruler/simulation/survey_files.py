"""A scan on disk: the returns as LAZ, and one row of truth per return in the same order."""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from laspy.vlrs.known import WktCoordinateSystemVlr

import pipeline
from pipeline.io.crs import UNKNOWN_REFERENCE, SpatialReference
from pipeline.ruler.simulation.als import ScanBlock
from pipeline.ruler.simulation.beam import MAX_RETURNS
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.strips import Returns

_DATE = dt.date(2025, 4, 1)
"""Date of the simulated survey in the header: the same scene gives the same bytes on any day."""

LABELS = pa.schema(
    [
        pa.field("class", pa.uint8(), nullable=False),
        pa.field("building_id", pa.dictionary(pa.int32(), pa.string())),
        pa.field("face", pa.int16(), nullable=False),
        pa.field("mixed", pa.bool_(), nullable=False),
    ]
)
"""One row per point: true ASPRS class, building, roof plane (-1 for walls and other objects), melted echoes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileFiles:
    """One LAZ file and its labels."""

    laz: Path
    labels: Path
    points: int
    bounds: tuple[float, float, float, float]
    """Bounds of the points, CRS coordinates: smallest x, smallest y, largest x, largest y; nan without points."""


def spatial_reference(scene: Scene) -> SpatialReference:
    """The scene's coordinate reference system, in metres."""
    if scene.crs is None:
        return UNKNOWN_REFERENCE
    import pyproj

    crs = pyproj.CRS.from_user_input(scene.crs)
    return SpatialReference(wkt=crs.to_wkt(), name=crs.name, epsg=crs.to_epsg())


def las_header(scene: Scene) -> laspy.LasHeader:
    """LAS 1.4, point format 6, millimetres, standard GPS time; the CRS as OGC WKT 1, which the format asks for."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.offsets = np.array(scene.origin)
    header.creation_date = _DATE
    header.generating_software = f"gablework {pipeline.__version__}"
    header.system_identifier = "simulated"
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    if scene.crs is not None:
        import pyproj

        header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS.from_user_input(scene.crs).to_wkt("WKT1_GDAL")))
    return header


def write_points(
    blocks: Iterator[ScanBlock],
    scene: Scene,
    laz: Path,
    labels: Path,
    with_classes: bool = False,
    on_points: Callable[[int], None] | None = None,
) -> TileFiles:
    """Stream blocks into a LAZ file and a table of labels; both appear under their names only when complete.

    The folders exist. `on_points` is called with the number of points written so far.
    """
    names = pa.array([building.building_id for building in scene.buildings], pa.string())
    part_laz, part_labels = laz.with_name(f".{laz.name}"), labels.with_name(f".{labels.name}")
    header, count = las_header(scene), 0
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    with (
        laspy.open(part_laz, mode="w", header=header, do_compress=True) as tile,
        pq.ParquetWriter(part_labels, LABELS, compression="zstd") as table,
    ):
        for block in blocks:
            tile.write_points(las_points(block, header, with_classes))
            building = pa.DictionaryArray.from_arrays(pa.array(block.building, mask=block.building < 0), names)
            columns = [block.points.classification, building, block.face.astype(np.int16), block.mixed]
            table.write_table(pa.table(columns, schema=LABELS))
            plan = block.points.xyz[:, :2]
            low, high = np.minimum(low, plan.min(axis=0)), np.maximum(high, plan.max(axis=0))
            count += len(block)
            if on_points is not None:
                on_points(count)
    part_laz.replace(laz)
    part_labels.replace(labels)
    x0, y0, x1, y1 = (float(value) if count else float("nan") for value in (*low, *high))
    return TileFiles(laz=laz, labels=labels, points=count, bounds=(x0, y0, x1, y1))


def las_points(block: ScanBlock, header: laspy.LasHeader, with_classes: bool) -> laspy.ScaleAwarePointRecord:
    """A block as LAS points."""
    cloud = block.points
    record = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
    record.x, record.y, record.z = cloud.xyz[:, 0], cloud.xyz[:, 1], cloud.xyz[:, 2]
    record["intensity"] = block.intensity
    record["return_number"] = cloud.return_number
    record["number_of_returns"] = cloud.return_count
    record["classification"] = cloud.classification if with_classes else np.ones(len(block), np.uint8)
    record["scan_angle"] = np.round(block.scan_angle_deg / 0.006).astype(np.int16)
    record["point_source_id"] = cloud.source_id
    record["gps_time"] = cloud.gps_time
    return record


_RECORDED = {
    Returns.ALL: (MAX_RETURNS, False),
    Returns.FIVE: (5, False),
    Returns.FIRST_AND_LAST: (1, True),
    Returns.FIRST: (1, False),
    Returns.LAST: (0, True),
}
"""How many of the first returns, and whether the last one."""


def recorded(blocks: Iterator[ScanBlock], returns: Returns) -> Iterator[ScanBlock]:
    """The blocks as an instrument delivers them that records these returns; they are numbered anew."""
    firsts, with_last = _RECORDED[returns]
    most = firsts + with_last
    for block in blocks:
        number, count = block.points.return_number, block.points.return_count
        kept = (number <= firsts) | (with_last & (number == count))
        cloud = block.points.take(kept)
        number, count = (np.minimum(column, np.uint8(most)) for column in (cloud.return_number, cloud.return_count))
        others = [field.name for field in dataclasses.fields(ScanBlock) if field.name != "points"]
        yield ScanBlock(
            points=dataclasses.replace(cloud, return_number=number, return_count=count),
            **{name: getattr(block, name)[kept] for name in others},
        )
