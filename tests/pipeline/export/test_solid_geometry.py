"""Solids as columns of GeoParquet: read back by other programs, they bound the same solids with the same semantics."""

import io
import json
from collections import Counter
from pathlib import Path
from typing import Any

import duckdb
import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
import small_buildings as small
from small_buildings import Builder, Contexts

from pipeline.export.dimensions import volume
from pipeline.export.geoparquet import geo_table, parquet_bytes
from pipeline.export.record_rows import RecordContext, building_row
from pipeline.export.solid_geometry import SOLID_COLUMNS, model_at, solid_columns
from pipeline.model import FaceKind, Solid, SolidFace
from pipeline.quality.validity import check_solid

CRSES = ["compound", "feet and metres", "US feet", "unknown"]
BUILT = (small.gable, small.courtyard, small.two_parts, small.pent)
KINDS = {
    "RoofSurface": FaceKind.ROOF,
    "WallSurface": FaceKind.WALL,
    "GroundSurface": FaceKind.GROUND,
    "OuterCeilingSurface": FaceKind.CEILING,
}


def table_of(context: RecordContext, *builders: Builder) -> bytes:
    """The buildings table of some buildings as a file."""
    rows = [building_row(build(), context) for build in builders]
    return parquet_bytes(geo_table("buildings", rows, context.reference.projjson))


def solids_again(columns: dict[str, Any], units_m: tuple[float, float]) -> list[Solid]:
    """The solids in a row, in metres from the origin of the small buildings."""
    polygons = shapely.get_parts(shapely.from_wkb(columns["solid"]))
    faces: dict[int, list[SolidFace]] = {}
    places: dict[int, dict[tuple[float, ...], int]] = {}
    reported = zip(polygons, columns["solid_parts"], columns["solid_surfaces"], columns["solid_planes"], strict=True)
    for polygon, part, surface, plane in reported:
        numbers = places.setdefault(part, {})
        rings = []
        for ring in (polygon.exterior, *polygon.interiors):
            xyz = shapely.get_coordinates(ring, include_z=True)[:-1] * [units_m[0], units_m[0], units_m[1]]
            corners = np.round(xyz - small.ORIGIN, 3).tolist()
            rings.append(tuple(numbers.setdefault(tuple(corner), len(numbers)) for corner in corners))
        faces.setdefault(part, []).append(SolidFace(rings=tuple(rings), kind=KINDS[surface], plane=plane))
    return [Solid(vertices=np.array(list(places[part])), faces=tuple(faces[part])) for part in sorted(faces)]


@pytest.mark.parametrize("crs", CRSES)
@pytest.mark.parametrize("build", BUILT)
def test_the_faces_bound_the_delivered_solids_again(contexts: Contexts, build: Builder, crs: str) -> None:
    result, reference = build(), contexts[crs].reference
    again = solids_again(solid_columns(result, reference), (reference.horizontal_unit_m, reference.vertical_unit_m))
    assert len(again) == len(result.solids)
    for found, delivered in zip(again, result.solids, strict=True):
        assert check_solid(found) == check_solid(delivered)
        assert volume(found) == pytest.approx(volume(delivered))
        assert Counter((f.kind, f.plane, len(f.rings)) for f in found.faces) == Counter(
            (f.kind, f.plane, len(f.rings)) for f in delivered.faces
        )


def test_the_geometry_is_iso_wkb_of_a_multipolygon_z_with_closed_rings(contexts: Contexts) -> None:
    for build in BUILT:
        wkb = solid_columns(build(), contexts["compound"].reference)["solid"]
        assert wkb[:5] == b"\x01" + (1006).to_bytes(4, "little")
        geometry = shapely.from_wkb(wkb)
        assert shapely.to_wkb(geometry, flavor="iso") == wkb
        assert (geometry.geom_type, geometry.has_z) == ("MultiPolygon", True)


def test_a_candidate_without_a_model_has_no_solid(contexts: Contexts) -> None:
    assert solid_columns(small.failed(), contexts["compound"].reference) == dict.fromkeys(SOLID_COLUMNS)


@pytest.mark.parametrize("crs", CRSES)
def test_the_footprint_stays_the_primary_geometry_and_its_box_covers_the_solid(contexts: Contexts, crs: str) -> None:
    data = table_of(contexts[crs], *BUILT, small.failed)
    table = pq.read_table(io.BytesIO(data))
    geo = json.loads(table.schema.metadata[b"geo"])
    assert (geo["primary_column"], list(geo["columns"])) == ("geometry", ["geometry", "solid"])
    footprint, solid = geo["columns"]["geometry"], geo["columns"]["solid"]
    assert (footprint["geometry_types"], solid["geometry_types"]) == (["Polygon"], ["MultiPolygon Z"])
    assert "orientation" not in solid
    assert (solid["crs"], solid["covering"]) == (footprint["crs"], footprint["covering"])
    assert [*solid["bbox"][:2], *solid["bbox"][3:5]] == footprint["bbox"]
    for row in table.to_pylist():
        if row["solid"] is not None:
            assert tuple(row["bbox"].values()) == shapely.from_wkb(row["solid"]).bounds


def test_tables_without_solids_tell_of_none(contexts: Contexts) -> None:
    for name in ("planes", "rejected"):
        geo = json.loads(geo_table(name, [], contexts["compound"].reference.projjson).schema.metadata[b"geo"])
        assert list(geo["columns"]) == ["geometry"]


def test_geopandas_reads_footprints_and_has_the_solids_at_hand(tmp_path: Path, contexts: Contexts) -> None:
    path = tmp_path / "buildings.parquet"
    path.write_bytes(table_of(contexts["compound"], *BUILT, small.failed))
    frame = geopandas.read_parquet(path).set_index("building_id")
    assert frame.active_geometry_name == "geometry"
    assert not frame.geometry.has_z.any()
    solids = frame.set_geometry("solid")
    assert solids.crs.to_epsg() == 7415
    assert solids.geometry.isna()["failed"]
    assert solids.geometry["gable"].has_z
    assert len(solids.geometry["gable"].geoms) == len(frame["solid_surfaces"]["gable"])


def test_duckdb_reads_the_solids_and_their_semantics(tmp_path: Path, contexts: Contexts) -> None:
    path = tmp_path / "buildings.parquet"
    path.write_bytes(table_of(contexts["compound"], *BUILT, small.failed))
    with duckdb.connect() as base:
        base.execute("SET enable_geoparquet_conversion = false")
        rows = base.execute(
            "SELECT building_id, lod, solid, len(list_filter(solid_surfaces, lambda s: s = 'RoofSurface'))"
            f" FROM '{path}' ORDER BY building_id"
        ).fetchall()
    expected = {"courtyard": ("1.2", 1), "failed": (None, None), "gable": ("2.2", 2), "pent": ("2.2", 1)}
    assert {name: (lod, n) for name, lod, _, n in rows} == expected | {"two_parts": ("2.2", 4)}
    for name, _, wkb, _ in rows:
        wanted = next((b() for b in BUILT if b.__name__ == name), small.failed())
        found = solid_columns(wanted, contexts["compound"].reference)["solid"]
        assert (None if wkb is None else bytes(wkb)) == found


def test_coarser_solids_have_columns_of_their_own(contexts: Contexts) -> None:
    result, reference = small.levelled(), contexts["compound"].reference
    columns = solid_columns(result, reference)
    assert tuple(columns) == SOLID_COLUMNS
    for model in result.coarser:
        name = f"solid_lod{model.lod.replace('.', '')}"
        reported = {end: columns[f"{name}_{end}"] for end in ("parts", "surfaces")}
        planes = [face.plane for solid in model.solids for face in solid.faces]
        again = solids_again(
            {"solid": columns[name], "solid_planes": planes, **{f"solid_{end}": v for end, v in reported.items()}},
            (1.0, 1.0),
        )
        assert [volume(solid) for solid in again] == pytest.approx([volume(solid) for solid in model.solids])
        assert [check_solid(solid) for solid in again] == [(), ()]
    assert solid_columns(small.gable(), reference)["solid_lod13"] is None


def test_solids_with_overhangs_have_columns_of_their_own(contexts: Contexts) -> None:
    result, reference = small.overhung(), contexts["compound"].reference
    assert result.overhangs is not None
    columns = solid_columns(result, reference)
    named = {f"solid{end}": columns[f"solid_lod23{end}"] for end in ("", "_parts", "_surfaces", "_planes")}
    (again,) = solids_again(named, (1.0, 1.0))
    assert check_solid(again) == ()
    assert volume(again) == pytest.approx(volume(result.overhangs.solids[0]))
    assert columns["solid_lod23_surfaces"].count("OuterCeilingSurface") == 2
    assert columns["solid"] == solid_columns(small.gable("overhung"), reference)["solid"]
    assert solid_columns(small.gable(), reference)["solid_lod23"] is None


def test_geopandas_reads_coarser_solids_where_there_are_any(tmp_path: Path, contexts: Contexts) -> None:
    path = tmp_path / "buildings.parquet"
    path.write_bytes(table_of(contexts["compound"], *BUILT, small.levelled))
    geo = json.loads(pq.read_schema(path).metadata[b"geo"])
    assert list(geo["columns"]) == ["geometry", "solid", "solid_lod12", "solid_lod13"]
    assert "covering" not in geo["columns"]["solid_lod12"]
    frame = geopandas.read_parquet(path).set_index("building_id")
    levels = frame.set_geometry("solid_lod13").geometry
    assert levels.isna().sum() == len(BUILT)
    assert levels["levelled"].bounds == frame.geometry["levelled"].bounds
    assert len(levels["levelled"].geoms) == len(frame["solid_lod13_surfaces"]["levelled"])


def test_the_finest_model_up_to_a_level_is_found() -> None:
    levelled, block = small.levelled(), small.courtyard()
    assert [model_at(levelled, lod).lod for lod in (None, "2.2", "1.3", "1.2")] == ["2.2", "2.2", "1.3", "1.2"]
    assert [model_at(block, lod).lod for lod in (None, "1.3", "1.2")] == ["1.2", "1.2", "1.2"]
    overhung = small.overhung()
    assert [model_at(overhung, lod).lod for lod in (None, "2.2", "2.3")] == ["2.2", "2.2", "2.3"]
    assert model_at(small.gable(), "2.3").lod == "2.2"
    assert model_at(small.gable(), "1.3") is None
    assert model_at(small.failed(), None) is None
