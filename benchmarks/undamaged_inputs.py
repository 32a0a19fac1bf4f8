"""Small whole inputs of every kind, to be damaged by `damaged_inputs.py`: two houses on 40 by 30 m, 2,120 points."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio.raw
import pyproj
import shapely
import shapely.affinity

from pipeline.model import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from las_files import copc_of, write_las

CRS = "EPSG:25832"
ORIGIN = (400_000.0, 5_650_000.0)
HOUSES = ((5.0, 6.0, 17.0, 14.0), (22.0, 10.0, 34.0, 22.0))
"""A gable and a flat roof: west, south, east, north about the origin, metres."""
STEP_M = 0.75

OVERRIDES = """\
[[building]]
point = [400011.0, 5650010.0]
footprint = "POLYGON ((400005 5650006, 400017 5650006, 400017 5650014, 400005 5650014, 400005 5650006))"
method = "kmeans"
preset = "robust"
note = "a gable, seen in the field"

[[building]]
point = [400028.0, 5650016.0]
footprint = { file = "footprints.geojson", id = "flat" }
settings = { roof = { min_part_area_m2 = 4.0 }, plan = { min_face_width_m = 0.6 } }

[[building]]
point = [400002.0, 5650026.0]
action = "reject"
"""
BATCH = """\
[inputs]
paths = ["tile.laz"]
crs = "EPSG:25832"
footprints = "footprints.geojson"
guides = "guides.geojson"
bbox = [399990.0, 5649990.0, 400050.0, 5650050.0]
licence = "CC0"

[settings]
method = "arrangement"
lods = "2.2"

[settings.candidates]
min_area_m2 = 10.0

[output]
path = "run"
meshes = "tile"
report = false

[work]
path = "work"

[cluster]
workers = 0
isolate = false
building_timeout_s = 60.0
building_memory_gib = 2.0

[schedule]
cron = "30 2 * * *"
time_zone = "Europe/Berlin"
missed = "run-latest"
grace_s = 300.0
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of input."""

    name: str
    """Its name in the table."""
    files: tuple[str, ...]
    """The files of which one is damaged."""
    arguments: tuple[str, ...]
    """The command that reads it; `{file}` is the damaged file, `{out}` the run directory."""


def _run(points: str, *more: str) -> tuple[str, ...]:
    """A run of one process."""
    return ("reconstruct", points, "--out", "{out}", "--workers", "0", "--quiet", "--json", "--meshes", "tile", *more)


KINDS: tuple[Kind, ...] = (
    Kind(name="las", files=("tile.las",), arguments=_run("tile.las")),
    Kind(name="laz", files=("tile.laz", "old.laz"), arguments=_run("{file}")),
    Kind(
        name="copc",
        files=("tile.copc.laz",),
        arguments=_run("tile.copc.laz", "--bbox", "400000", "5650000", "400039", "5650029"),
    ),
    Kind(name="ply", files=("tile.ply", "text.ply"), arguments=_run("{file}", "--crs", CRS)),
    Kind(
        name="geojson", files=("footprints.geojson",), arguments=_run("tile.laz", "--footprints", "footprints.geojson")
    ),
    Kind(name="geopackage", files=("footprints.gpkg",), arguments=_run("tile.laz", "--footprints", "footprints.gpkg")),
    Kind(
        name="shapefile",
        files=tuple(f"footprints.{ending}" for ending in ("shp", "shp", "dbf", "shx", "prj", "cpg")),
        arguments=_run("tile.laz", "--footprints", "footprints.shp"),
    ),
    Kind(
        name="geoparquet",
        files=("footprints.parquet",),
        arguments=_run("tile.laz", "--footprints", "footprints.parquet"),
    ),
    Kind(name="overrides", files=("overrides.toml",), arguments=_run("tile.laz", "--overrides", "overrides.toml")),
    Kind(name="guides", files=("guides.geojson", "guides.gpkg"), arguments=_run("tile.laz", "--guides", "{file}")),
    Kind(name="batch", files=("batch.toml",), arguments=("batch", "run", "batch.toml", "--quiet", "--json")),
)
"""All kinds, in the order of the table."""


def kind_named(name: str) -> Kind:
    """The kind of a name; raises ValueError that lists all."""
    found = next((kind for kind in KINDS if kind.name == name), None)
    if found is None:
        raise ValueError(f"kind {name!r} is not known: use {', '.join(kind.name for kind in KINDS)}")
    return found


def points_of_scene() -> FloatArray:
    """(n, 3) points of the scene, metres in the CRS: a lattice of pulses with 2 cm of noise."""
    draw = np.random.default_rng(44)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.5, 40.0, STEP_M), np.arange(0.5, 30.0, STEP_M)))
    x, y = x + draw.uniform(-0.2, 0.2, len(x)), y + draw.uniform(-0.2, 0.2, len(y))
    z = 100.0 + 0.01 * x
    gable, flat = ((x >= w) & (x <= e) & (y >= s) & (y <= n) for w, s, e, n in HOUSES)
    z[gable] = 108.0 - 0.75 * np.abs(y[gable] - 10.0)
    z[flat] = 106.0
    return np.column_stack([ORIGIN[0] + x, ORIGIN[1] + y, z + draw.normal(0.0, 0.02, len(x))])


def write_inputs(folder: Path) -> None:
    """Write whole inputs of all kinds into a folder."""
    xyz = points_of_scene()
    las = laspy.read(write_las(folder / "tile.las", xyz, CRS, classification=1))
    las.write(str(folder / "tile.laz"))
    write_las(folder / "old.laz", xyz, CRS, point_format=1)
    copc_of(folder / "tile.copc.laz", las, CRS)
    _write_ply(folder, xyz)
    outlines = [shapely.affinity.translate(shapely.box(*house), *ORIGIN) for house in HOUSES]
    for name, driver in (
        ("footprints.gpkg", "GPKG"),
        ("footprints.shp", "ESRI Shapefile"),
        ("footprints.geojson", "GeoJSON"),
    ):
        _write_vector(
            folder / name, driver, outlines, "Polygon", id=["gable", "flat"], street=["Aalstraße 5", "Dorfplatz"]
        )
    lines = [
        shapely.affinity.translate(shapely.LineString(line), *ORIGIN)
        for line in (((5.0, 10.0), (17.0, 10.0)), ((22.0, 10.0), (34.0, 10.0)), ((22.0, 10.0), (22.0, 22.0)))
    ]
    for name, driver in (("guides.gpkg", "GPKG"), ("guides.geojson", "GeoJSON")):
        _write_vector(folder / name, driver, lines, "LineString", kind=["ridge", "eave", "eave"])
    _write_parquet(folder / "footprints.parquet", outlines)
    (folder / "overrides.toml").write_text(OVERRIDES, encoding="utf-8")
    (folder / "batch.toml").write_text(BATCH, encoding="utf-8")


def _write_ply(folder: Path, xyz: FloatArray) -> None:
    """The points as PLY, binary and as text."""
    head = "ply\nformat {}\ncomment two houses\nelement vertex {}\n"
    head += "property double x\nproperty double y\nproperty double z\nproperty uchar classification\nend_header\n"
    table = np.zeros(len(xyz), [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("classification", "u1")])
    for axis, name in enumerate("xyz"):
        table[name] = xyz[:, axis]
    binary = head.format("binary_little_endian 1.0", len(xyz)).encode() + table.tobytes()
    (folder / "tile.ply").write_bytes(binary)
    rows = "".join(f"{x:.3f} {y:.3f} {z:.3f} 1\n" for x, y, z in xyz.tolist())
    (folder / "text.ply").write_text(head.format("ascii 1.0", len(xyz)) + rows, encoding="ascii")


def _write_vector(
    path: Path, driver: str, shapes: Sequence[shapely.Geometry], geometry: str, **columns: Sequence[str]
) -> None:
    """A vector file by GDAL."""
    pyogrio.raw.write(
        path,
        shapely.to_wkb(np.array(shapes)),
        [np.array(values, dtype=object) for values in columns.values()],
        list(columns),
        geometry_type=geometry,
        driver=driver,
        crs=CRS,
    )


def _write_parquet(path: Path, shapes: Sequence[shapely.Geometry]) -> None:
    """GeoParquet 1.1 by pyarrow."""
    crs = pyproj.CRS.from_user_input(CRS).to_json_dict()
    about = {"encoding": "WKB", "geometry_types": ["Polygon"], "crs": crs}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": about}}
    columns = {
        "id": pa.array(["gable", "flat"]),
        "street": pa.array(["Aalstraße 5", "Dorfplatz"]),
        "geometry": pa.array([shapely.to_wkb(shape) for shape in shapes], pa.binary()),
    }
    pq.write_table(pa.table(columns).replace_schema_metadata({"geo": json.dumps(geo)}), path)
