"""Simulated data sets on disk: a raw LAZ tile, and the truth beside it.

```
<suite>.laz                     points without classes, as a survey delivers them
truth/scene.json                suite, seed, scanner, counts
truth/labels.parquet            one row a point, in the order of the LAZ: class, building_id, face, mixed
truth/buildings, planes, meshes, cityjson      the exact models, laid out and named as in a run directory
```
"""

from __future__ import annotations

import bisect
import dataclasses
import datetime as dt
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely
from laspy.vlrs.known import WktCoordinateSystemVlr

import pipeline
from pipeline.errors import InputError, SettingsError
from pipeline.export.records import RecordContext
from pipeline.export.tile import write_tile
from pipeline.io.crs import UNKNOWN_REFERENCE, SpatialReference
from pipeline.model import BoolArray, ByteArray, LabelArray
from pipeline.synthetic.als import ScanBlock, ScannerSettings, scan, strip_count
from pipeline.synthetic.scene import Scene
from pipeline.synthetic.solids import truth_record
from pipeline.synthetic.suites import suite_named

_BUILDINGS_A_PART = 500
_DATE = dt.date(2025, 4, 1)
"""Of the simulated survey; goes into the header, so that the same scene gives the same bytes on any day."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScenePaths:
    """What `simulate` wrote."""

    laz: Path
    """The tile."""
    truth: Path
    """The folder of the truth: a run directory of the exact models, plus labels and scene.json."""
    labels: Path
    """Per-point truth."""
    points: int
    """Returns in the tile."""
    buildings: int
    """Buildings in the scene."""


def simulate(
    suite: str,
    out_dir: str | Path,
    seed: int | None = None,
    *,
    size_m: tuple[float, float] | None = None,
    density_per_m2: float | None = None,
    noise_m: float | None = None,
    scanner: ScannerSettings | None = None,
    with_classes: bool = False,
    chunk_points: int = 1_000_000,
    on_points: Callable[[int], None] | None = None,
) -> ScenePaths:
    """Make a suite's scene, scan it, write the tile and the truth.

    Parameters
    ----------
    suite : str
        Name of a suite.
    out_dir : str or Path
        Folder, made where it does not exist; files of an earlier call are replaced.
    seed : int, optional
        Of layout and scanner; the suite's own by default. The same call gives the same bytes.
    size_m : tuple of float, optional
        Extent east and north; the suite's own by default.
    density_per_m2, noise_m : float, optional
        Pulse density and range noise in place of the suite's.
    scanner : ScannerSettings, optional
        A whole survey in place of the suite's.
    with_classes : bool
        Write the true classes into the LAZ too; by default all points are class 1 (unclassified).
    chunk_points : int
        Points held in memory at a time, about; the content does not depend on it.
    on_points : callable, optional
        Told the number of points written so far.

    Returns
    -------
    ScenePaths
        What was written, and where.

    Raises
    ------
    SettingsError
        Unknown suite, negative seed, or a size or survey out of range.
    InputError
        The survey hits nothing.
    """
    plan = suite_named(suite)
    seed = plan.seed if seed is None else seed
    size_m = plan.size_m if size_m is None else size_m
    faults = [f"size is {size:g} m: use 20 to 50000 m" for size in size_m if not 20.0 <= size <= 50_000.0]
    if not 0 <= seed < 2**32:
        faults.append(f"seed is {seed}: use 0 to {2**32 - 1}")
    if faults:
        raise SettingsError(faults)
    settings = scanner or plan.scanner
    if density_per_m2 is not None:
        settings = dataclasses.replace(settings, pulse_density_per_m2=float(density_per_m2))
    if noise_m is not None:
        settings = dataclasses.replace(settings, range_noise_m=float(noise_m))
    scene = plan.make(seed, size_m)
    out = Path(out_dir)
    truth = out / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    laz, labels = out / f"{suite}.laz", truth / "labels.parquet"
    count = write_points(
        scan(scene, settings, seed, chunk_points=chunk_points), scene, laz, labels, with_classes, on_points
    )
    if count == 0:
        raise InputError(str(laz), "the survey hit nothing", "Use a larger scene or a higher density")
    write_truth(scene, truth)
    _write_manifest(scene, settings, seed, count, truth / "scene.json")
    return ScenePaths(laz=laz, truth=truth, labels=labels, points=count, buildings=len(scene.buildings))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneTruth:
    """The truth of a simulated tile, without its models: those are read as any run directory's."""

    folder: Path
    """The folder of the truth; `pipeline.report.roof_models.read_roof_models` reads its models."""
    suite: str
    """Name of the suite."""
    seed: int
    """Seed of layout and scanner."""
    crs: str | None
    """As in `Scene.crs`."""
    extent: tuple[float, float, float, float]
    """CRS coordinates: smallest x, smallest y, largest x, largest y."""
    building_ids: tuple[str, ...]
    """All true buildings, sorted."""
    classification: ByteArray
    """(n,) uint8, true ASPRS class of every point in the order of the LAZ; 1 for small things."""
    building: LabelArray
    """(n,) int32, index into building_ids; -1 for none."""
    face: LabelArray
    """(n,) int32, roof plane of the building; -1 for walls and for what is no building."""
    mixed: BoolArray
    """(n,) bool, True where echoes of different surfaces melted into the return."""

    @property
    def wall(self) -> BoolArray:
        """(n,) bool, True where a wall was hit."""
        return (self.building >= 0) & (self.face < 0)


def read_truth(truth_dir: str | Path) -> SceneTruth:
    """Read the truth that `simulate` wrote, all labels in memory: 10 bytes a point.

    Raises
    ------
    InputError
        If scene.json or the labels are missing or not readable.
    """
    folder = Path(truth_dir)
    try:
        manifest = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
        labels = pq.read_table(folder / "labels.parquet")
    except (OSError, ValueError) as error:
        raise InputError(
            str(folder), f"no readable truth ({error})", "Give the folder `truth` that `gablework simulate` wrote"
        ) from error
    names = labels["building_id"].combine_chunks()
    ids = sorted(str(name) for name in names.dictionary.to_pylist())
    place = np.array([bisect.bisect_left(ids, name) for name in names.dictionary.to_pylist()], np.int32)
    building = np.full(len(labels), -1, np.int32)
    known = names.indices.is_valid().to_numpy(zero_copy_only=False)
    building[known] = place[names.indices.drop_null().to_numpy()]
    return SceneTruth(
        folder=folder,
        suite=manifest["suite"],
        seed=manifest["seed"],
        crs=manifest["crs"],
        extent=tuple(manifest["extent"]),
        building_ids=tuple(ids),
        classification=labels["class"].to_numpy(),
        building=building,
        face=labels["face"].to_numpy().astype(np.int32),
        mixed=labels["mixed"].to_numpy(),
    )


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
) -> int:
    """Stream blocks into a LAZ file and a table of labels; both appear under their names only when whole.

    Returns
    -------
    int
        Number of points.
    """
    names = pa.array([building.building_id for building in scene.buildings], pa.string())
    part_laz, part_labels = laz.with_name(f".{laz.name}"), labels.with_name(f".{labels.name}")
    header, count = las_header(scene), 0
    schema = pa.schema(
        [
            pa.field("class", pa.uint8(), nullable=False),
            pa.field("building_id", pa.dictionary(pa.int32(), pa.string())),
            pa.field("face", pa.int16(), nullable=False),
            pa.field("mixed", pa.bool_(), nullable=False),
        ]
    )
    with (
        laspy.open(part_laz, mode="w", header=header, do_compress=True) as tile,
        pq.ParquetWriter(part_labels, schema, compression="zstd") as table,
    ):
        for block in blocks:
            tile.write_points(_las_points(block, header, with_classes))
            building = pa.DictionaryArray.from_arrays(pa.array(block.building, mask=block.building < 0), names)
            columns = [block.points.classification, building, block.face.astype(np.int16), block.mixed]
            table.write_table(pa.table(columns, schema=schema))
            count += len(block)
            if on_points is not None:
                on_points(count)
    part_laz.replace(laz)
    part_labels.replace(labels)
    return count


def _las_points(block: ScanBlock, header: laspy.LasHeader, with_classes: bool) -> laspy.ScaleAwarePointRecord:
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


def write_truth(scene: Scene, truth: Path) -> None:
    """Write the exact models as a run directory, some hundred buildings a part."""
    context = RecordContext(
        reference=spatial_reference(scene), settings_hash="truth", engine_version=pipeline.__version__
    )
    extent = shapely.box(*scene.extent)
    for first in range(0, len(scene.buildings), _BUILDINGS_A_PART):
        records = [
            truth_record(building, scene.origin, touches_data_edge=not extent.contains(building.footprint))
            for building in scene.buildings[first : first + _BUILDINGS_A_PART]
        ]
        write_tile(truth, f"part{first // _BUILDINGS_A_PART:05d}", records, [], context, meshes="tile")


def _write_manifest(scene: Scene, settings: ScannerSettings, seed: int, points: int, path: Path) -> None:
    x, y, _ = scene.origin
    extent = [scene.extent[0] + x, scene.extent[1] + y, scene.extent[2] + x, scene.extent[3] + y]
    manifest: dict[str, Any] = {
        "suite": scene.name,
        "seed": seed,
        "engine_version": pipeline.__version__,
        "crs": scene.crs,
        "extent": extent,
        "points": points,
        "strips": strip_count(scene, settings),
        "buildings": len(scene.buildings),
        "trees": len(scene.trees),
        "cars": len(scene.boxes),
        "scanner": dataclasses.asdict(settings),
    }
    path.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
