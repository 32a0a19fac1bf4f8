"""3D Tiles of a run: every model at its place on the globe with its record, and a folder that is whole."""

import dataclasses
import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj
import pytest
import small_buildings as small
from checkout import ROOT
from command_line import invoke
from glb_rules import chunks, values_of
from small_runs import moved, reference_of, street, tiled_run

from pipeline.errors import RunError
from pipeline.export.columns import KINDS
from pipeline.export.dimensions import volume
from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import SCHEMAS
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.extras.publish_3dtiles import globe_tileset
from pipeline.extras.publish_3dtiles.globe import geodesy, to_globe
from pipeline.extras.publish_3dtiles.property_table import BLOCK_COLUMNS, COLUMNS, StoredColumn, stored_column
from pipeline.extras.publish_3dtiles.publishing_3dtiles import publish_3dtiles
from pipeline.io.crs import SpatialReference
from pipeline.model import BuildingResult
from pipeline.runtime.manifest import write_manifest
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.tiling import Tile

GEOID_M = 43.2
PAGE = ROOT / "docs" / "how_to" / "3d_tiles.md"


@pytest.fixture
def run_dir(tmp_path: Path, contexts: small.Contexts) -> Path:
    """The buildings of `spread` on two tiles."""
    return tiled_run(tmp_path / "run", {"x85_y447": spread()[:2], "x86_y447": spread()[2:]}, contexts)


def spread() -> list[BuildingResult]:
    """Four buildings, one of them without a model; two are so far apart that positions of both have steps of 8 mm."""
    fallback, court, *others = street()
    return [fallback, moved(court, 500.0), *others]


@dataclasses.dataclass(frozen=True)
class Feature:
    """A building of a content."""

    properties: dict[str, Any]
    triangles: dict[str, np.ndarray]
    """(t, 3, 3) in EPSG:4978, of each material."""
    normals: dict[str, np.ndarray]
    """(t, 3)."""
    planes: dict[str, set[int]]
    """Feature ids of roof planes, of each material."""


def tileset(out: Path) -> dict[str, Any]:
    return json.loads((out / "tileset.json").read_text())


def nodes_of(entry: dict[str, Any], above: np.ndarray | None = None) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """All nodes with their matrices to EPSG:4978, those above first."""
    own = np.array(entry.get("transform", np.eye(4).reshape(-1))).reshape(4, 4).T
    matrix = own if above is None else above @ own
    yield entry, matrix
    for child in entry.get("children", ()):
        yield from nodes_of(child, matrix)


def property_values(document: dict[str, Any], binary: bytes) -> list[dict[str, Any]]:
    """The rows of the property table, by the text of EXT_structural_metadata."""
    metadata = document["extensions"]["EXT_structural_metadata"]
    (table,) = metadata["propertyTables"]
    properties = metadata["schema"]["classes"][table["class"]]["properties"]

    def view(index: int) -> bytes:
        found = document["bufferViews"][index]
        assert found["byteOffset"] % 8 == 0
        return binary[found["byteOffset"] : found["byteOffset"] + found["byteLength"]]

    rows: list[dict[str, Any]] = [{} for _ in range(table["count"])]
    for name, definition in properties.items():
        stored = table["properties"].get(name)
        assert stored is not None or not definition.get("required")
        values: list[Any] = [None] * len(rows)
        if stored is not None and definition["type"] == "BOOLEAN":
            bits = view(stored["values"])
            values = [bool(bits[k // 8] >> (k % 8) & 1) for k in range(len(rows))]
        elif stored is not None and definition["type"] == "SCALAR":
            kind = {"INT32": "<i4", "FLOAT64": "<f8"}[definition["componentType"]]
            values = np.frombuffer(view(stored["values"]), kind).tolist()
        elif stored is not None:
            offsets = np.frombuffer(view(stored["stringOffsets"]), "<u4")
            texts = view(stored["values"])
            values = [texts[offsets[k] : offsets[k + 1]].decode() for k in range(len(rows))]
        assert len(values) == len(rows)
        for row, value in zip(rows, values, strict=True):
            row[name] = None if "noData" in definition and value == definition["noData"] else value
    return rows


def features_of(path: Path, matrix: np.ndarray) -> dict[str, Feature]:
    """The buildings of a content by their ids."""
    data = path.read_bytes()
    document, binary = chunks(data)
    assert (len(data) - len(binary)) % 8 == 0
    (node,) = document["nodes"]
    (mesh,) = document["meshes"]

    rows = property_values(document, binary)
    assert len(rows) == len({row["building_id"] for row in rows})
    features = [Feature(row, {}, {}, {}) for row in rows]
    for primitive in mesh["primitives"]:
        material = document["materials"][primitive["material"]]["name"]
        sets = primitive["extensions"]["EXT_mesh_features"]["featureIds"]
        assert (sets[0]["label"], sets[0]["featureCount"], sets[0]["propertyTable"]) == ("building", len(rows), 0)
        local = (
            values_of(document, binary, primitive["attributes"]["POSITION"]) * node["scale"][0] + node["translation"]
        )
        up = np.column_stack((local[:, 0], -local[:, 2], local[:, 1]))
        places = up @ matrix[:3, :3].T + matrix[:3, 3]
        shades = values_of(document, binary, primitive["attributes"]["NORMAL"]) / 127.0
        shades = np.column_stack((shades[:, 0], -shades[:, 2], shades[:, 1])) @ matrix[:3, :3].T
        numbers = values_of(document, binary, primitive["attributes"][f"_FEATURE_ID_{sets[0]['attribute']}"])[:, 0]
        triangles = values_of(document, binary, primitive["indices"]).reshape(-1, 3)
        assert (numbers[triangles] == numbers[triangles[:, :1]]).all()
        for number, feature in enumerate(features):
            own = triangles[numbers[triangles[:, 0]] == number]
            if len(own):
                feature.triangles[material] = places[own]
                feature.normals[material] = shades[own[:, 0]]
            if len(own) and len(sets) > 1:
                held = values_of(document, binary, primitive["attributes"][f"_FEATURE_ID_{sets[1]['attribute']}"])[:, 0]
                feature.planes[material] = set(held[own].ravel().tolist())
    return {feature.properties["building_id"]: feature for feature in features}


def volume_of(feature: Feature) -> float:
    """Volume inside of closed triangles, seen from one of their corners."""
    triangles = np.concatenate(list(feature.triangles.values()))
    a, b, c = np.moveaxis(triangles - triangles[0, 0], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def contents(out: Path) -> dict[str, dict[str, Feature]]:
    """The buildings of all contents, by their paths."""
    nodes = list(nodes_of(tileset(out)["root"]))
    return {
        node["content"]["uri"]: features_of(out / node["content"]["uri"], matrix)
        for node, matrix in nodes
        if "content" in node
    }


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_every_model_lies_where_proj_says_and_encloses_its_volume(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"), geoid_height_m=GEOID_M)
    plan = pyproj.Transformer.from_crs(28992, 4979, always_xy=True)
    globe = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    found = contents(tmp_path / "out")
    shown = {
        name: feature for path, held in found.items() if path.startswith("models/") for name, feature in held.items()
    }
    results = {result.building_id: result for result in spread() if result.solids}
    assert set(shown) == set(results)
    for name, result in results.items():
        feature = shown[name]
        corners = np.unique(np.concatenate([solid.vertices for solid in result.solids]) + result.origin, axis=0)
        lon, lat = plan.transform(corners[:, 0], corners[:, 1])
        wanted = np.column_stack(globe.transform(lon, lat, corners[:, 2] + GEOID_M))
        drawn = np.concatenate([triangles.reshape(-1, 3) for triangles in feature.triangles.values()])
        away = np.linalg.norm(drawn[:, None] - wanted, axis=2)
        assert away.min(axis=1).max() < 0.01
        assert away.min(axis=0).max() < 0.01
        # the projection has a scale of 0.9999
        assert volume_of(feature) == pytest.approx(sum(volume(solid) for solid in result.solids), rel=2e-3)


def test_normals_are_those_of_the_triangles_and_roofs_look_up(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    for held in contents(tmp_path / "out").values():
        for feature in held.values():
            for material, triangles in feature.triangles.items():
                sides = triangles[:, 1:] - triangles[:, :1]
                drawn = np.cross(sides[:, 0], sides[:, 1])
                drawn /= np.linalg.norm(drawn, axis=1)[:, None]
                assert np.einsum("ij,ij->i", drawn, feature.normals[material]).min() > 0.999
                up = triangles[0, 0] / np.linalg.norm(triangles[0, 0])
                steep = drawn @ up
                assert {
                    "RoofSurface": steep.min() > 0.1,
                    "WallSurface": np.abs(steep).max() < 0.01,
                    "GroundSurface": steep.max() < -0.99,
                }[material]


def test_roof_planes_are_features_of_roofs_alone(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    found = contents(tmp_path / "out")
    assert found["models/x86_y447.glb"]["two_parts"].planes == {"RoofSurface": {0, 1, 2, 3}}
    assert all(not f.planes for path, held in found.items() if "blocks" in path for f in held.values())


def test_the_property_table_holds_every_column_of_the_record(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    rows = {row["building_id"]: row for row in read_table(str(run_dir), "buildings").to_pylist()}
    shapes = {"geometry", "bbox", *SHAPE_COLUMNS}
    checked = 0
    for path, held in contents(tmp_path / "out").items():
        for name, feature in held.items():
            wanted = {column: value for column, value in rows[name].items() if column not in shapes}
            if path.startswith("models/"):
                assert set(feature.properties) == set(wanted)
                checked += 1
            for column, value in feature.properties.items():
                expected = wanted[column]
                if isinstance(expected, list):
                    assert json.loads(value) == expected, column
                elif hasattr(expected, "isoformat"):
                    assert value == expected.isoformat(), column
                else:
                    assert value == expected, column
    assert checked == 3


def test_every_type_of_the_records_has_one_and_an_unknown_type_is_an_error() -> None:
    assert [c.name for c in COLUMNS] == [
        n for n in SCHEMAS["buildings"].names if n not in {"geometry", *SHAPE_COLUMNS}
    ] + ["tile"]
    for field in (pa.field("x", pa.uint64()), pa.field("x", pa.bool_())):
        with pytest.raises(RunError, match="column x has type"):
            stored_column(field)
    numbers = stored_column(pa.field("x", pa.int32()))
    assert np.frombuffer(numbers.stored([1, None])[0], "<i4").tolist() == [1, numbers.definition["noData"]]


def test_the_page_says_what_each_type_becomes_and_what_null_is() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([A-Z][^`]*)` \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    assert {kind: stored for kind, stored, _ in rows} == {
        kind: types.tiles for kind, types in KINDS.items() if types.tiles != "none"
    }
    for kind, _, null in rows:
        stored = StoredColumn(name="x", kind=kind, nullable=True).no_data
        assert (str(stored) or "empty text") in null or kind == "bool"
    for column in BLOCK_COLUMNS:
        assert f"`{column.name}`" in PAGE.read_text()


def test_blocks_are_replaced_by_models_and_every_node_holds_what_is_below(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    document, found = tileset(tmp_path / "out"), contents(tmp_path / "out")
    assert document["root"]["refine"] == "REPLACE"
    assert document["geometricError"] == document["root"]["geometricError"] > 50.0  # of showing nothing
    back = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    for node, matrix in nodes_of(document["root"]):
        west, south, east, north, low, high = node["boundingVolume"]["region"]
        for child in node.get("children", ()):
            w, s, e, n, bottom, top = child["boundingVolume"]["region"]
            assert west <= w < e <= east
            assert south <= s < n <= north
            assert low <= bottom < top <= high
            assert node["geometricError"] >= child["geometricError"]
        if "content" not in node:
            continue
        corners = np.concatenate(
            [t.reshape(-1, 3) for f in found[node["content"]["uri"]].values() for t in f.triangles.values()]
        )
        lon, lat, height = back.transform(*corners.T, radians=True)
        assert west <= lon.min() <= lon.max() <= east
        assert south <= lat.min() <= lat.max() <= north
        assert low <= height.min() <= height.max() <= high
        origin = back.transform(*matrix[:3, 3], radians=True)
        assert origin[:2] == pytest.approx([(west + east) / 2.0, (south + north) / 2.0], abs=1e-9)
        assert origin[2] == pytest.approx(low, abs=0.03)
        assert (node["geometricError"] == 0.0) == node["content"]["uri"].startswith("models/")
    for tile in ("x85_y447", "x86_y447"):
        assert set(found[f"blocks/{tile}.glb"]) == set(found[f"models/{tile}.glb"])


def test_a_block_is_the_ground_raised_to_the_height_of_lod_1_2(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"), geoid_height_m=0.0)
    blocks, models = (contents(tmp_path / "out")[f"{kind}/x85_y447.glb"] for kind in ("blocks", "models"))
    back = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    for name, block in blocks.items():
        row = models[name].properties
        tops = [back.transform(*t.reshape(-1, 3).T)[2] for t in block.triangles.values()]
        assert max(map(np.max, tops)) == pytest.approx(row["h_70p"], abs=0.01)
        assert min(map(np.min, tops)) == pytest.approx(row["ground_z"], abs=0.01)
        assert set(block.triangles) == {"RoofSurface", "WallSurface"}
        roof, floor = block.triangles["RoofSurface"], models[name].triangles["GroundSurface"]
        assert area(roof) == pytest.approx(area(floor), rel=2e-3)
        whole = dataclasses.replace(block, triangles={**block.triangles, "GroundSurface": floor})
        assert volume_of(whole) == pytest.approx(area(floor) * (row["h_70p"] - row["ground_z"]), rel=5e-3)


def area(triangles: np.ndarray) -> float:
    sides = triangles[:, 1:] - triangles[:, :1]
    return float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2.0)


def test_a_city_opens_with_its_largest_buildings(
    tmp_path: Path, contexts: small.Contexts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(globe_tileset, "MOST_BLOCKS", 3)
    monkeypatch.setattr(globe_tileset, "SKYLINE_FROM", 4)
    tiles = {}
    for column in range(3):
        for row in range(3):
            number = 3 * column + row
            tiles[f"x{column}_y{row}"] = [
                moved(small.gable(f"house{number}"), 1000.0 * column, 1000.0 * row),
                moved(small.courtyard(f"court{number}"), 1000.0 * column, 1000.0 * row),
            ][: 1 + (number in {0, 4, 8})]
    run_dir = tiled_run(tmp_path / "run", tiles, contexts)
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    document, found = tileset(tmp_path / "out"), contents(tmp_path / "out")
    skylines = {path: set(held) for path, held in found.items() if path.startswith("skylines/")}
    root = document["root"]["content"]["uri"]
    assert skylines[root] == {"court0", "court4", "court8"}
    size_m = math.hypot(10.0, 8.0, 6.0)  # of a house, the largest that is not shown
    assert size_m - 1.0 < document["root"]["geometricError"] < math.sqrt(3.0) * size_m
    assert len(skylines) == 2  # of the whole, and of the first two by two tiles
    # a node without content would be a hole where it is not refined
    assert all("content" in node for node, _ in nodes_of(document["root"]))
    counted = Counter(name for path, held in found.items() if path.startswith("models/") for name in held)
    assert counted == Counter(result.building_id for held in tiles.values() for result in held)
    for path, held in found.items():
        for name, feature in held.items():
            if path.startswith("skylines/"):
                near = found[f"blocks/{feature.properties['tile']}.glb"][name]
                assert (
                    np.abs(
                        np.ptp(near.triangles["RoofSurface"], axis=(0, 1))
                        - np.ptp(feature.triangles["RoofSurface"], axis=(0, 1))
                    ).max()
                    < 0.03
                )


def test_files_say_which_correction_heights_got(run_dir: Path, tmp_path: Path) -> None:
    given = publish_3dtiles(str(run_dir), str(tmp_path / "a"), geoid_height_m=GEOID_M)
    none = publish_3dtiles(str(run_dir), str(tmp_path / "b"))
    assert tileset(tmp_path / "a")["asset"]["extras"]["geoid_height_m"] == GEOID_M
    assert given.georeference["heights"] == "elevations plus the given geoid height"
    extras = tileset(tmp_path / "b")["asset"]["extras"]
    assert extras["heights"] == none.georeference["heights"]
    assert "taken as ellipsoidal heights" in extras["heights"]
    regions = [tileset(tmp_path / name)["root"]["boundingVolume"]["region"] for name in "ab"]
    assert regions[0][4] - regions[1][4] == pytest.approx(GEOID_M, abs=1e-3)


def test_a_missing_grid_of_heights_does_not_drop_the_shift_of_the_datum() -> None:
    place = np.array([[85_000.0, 447_000.0, 10.0]])
    geodetic, _ = geodesy(reference_of(7415), 43.2)(place)
    assert geodetic[0] == pytest.approx([4.36768, 52.00695, 53.2], abs=1e-4)
    found = to_globe(reference_of(7415))
    assert found is not None
    globe = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    lon, lat = pyproj.Transformer.from_crs(28992, 4326, always_xy=True).transform(85_000.0, 447_000.0)
    assert found(place)[0] == pytest.approx(globe.transform(lon, lat, 10.0), abs=1e-3)


def test_ellipsoidal_heights_and_feet_are_converted_by_proj() -> None:
    metres = np.array([[2_000_000.0, 600_000.0, 30.0]])
    feet = reference_of(2225, horizontal_unit_m=1200.0 / 3937.0, vertical_unit_m=1200.0 / 3937.0)
    geodetic, _ = geodesy(feet)(metres)
    plain = pyproj.Transformer.from_crs(2225, 4326, always_xy=True)
    lon, lat = plain.transform(*(metres[0, :2] * 3937.0 / 1200.0))
    assert geodetic[0] == pytest.approx([lon, lat, 30.0], abs=1e-6)
    whole = pyproj.CRS.from_epsg(25832).to_3d()
    way = geodesy(SpatialReference(wkt=whole.to_wkt(), name="3D"))
    assert way.facts["heights"] == "converted by PROJ"
    assert way(np.array([[500_000.0, 5_900_000.0, 30.0]]))[0][0, 2] == pytest.approx(30.0, abs=1e-6)


def test_an_unknown_crs_is_an_error_that_names_the_fix(run_dir: Path, tmp_path: Path) -> None:
    write_manifest(run_dir, dataclasses.replace(read_manifest(run_dir), crs={"horizontal_unit_m": 1.0}))
    with pytest.raises(RunError, match=r"unknown.*--crs EPSG:n"):
        publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    site = SpatialReference(wkt=pyproj.CRS.from_user_input('LOCAL_CS["site",UNIT["metre",1]]').to_wkt(), name="site")
    with pytest.raises(RunError, match="PROJ knows no way from site to WGS 84: reproject"):
        geodesy(site)
    assert to_globe(SpatialReference()) is to_globe(site) is None


def test_a_run_that_cannot_be_published_leaves_nothing(run_dir: Path, tmp_path: Path, contexts: small.Contexts) -> None:
    out = tmp_path / "out"
    path = run_dir / "cityjson" / "tile=x86_y447" / "part-0.city.jsonl"
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    with pytest.raises(RunError, match="cannot be placed on the globe"):
        publish_3dtiles(str(run_dir), str(out))
    bare = tiled_run(tmp_path / "bare", {"x0_y0": [small.failed()]}, contexts)
    with pytest.raises(RunError, match=r"no building of the run .* has a model"):
        publish_3dtiles(str(bare), str(out))
    assert {path.name for path in tmp_path.iterdir()} == {"run", "bare"}


def test_only_an_earlier_tileset_is_replaced_and_as_a_whole(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    publish_3dtiles(str(run_dir), str(out))
    fresh = files(out)
    (out / "models" / "of_before.glb").write_bytes(b"x")
    with pytest.raises(RunError, match=r"holds blocks already.*--overwrite"):
        publish_3dtiles(str(run_dir), str(out))
    publish_3dtiles(str(run_dir), str(out), overwrite=True)
    assert files(out) == fresh
    (out / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match=r"holds notes\.txt, which is not of a tileset"):
        publish_3dtiles(str(run_dir), str(out), overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"run", "out"}


def test_the_tree_is_walked_depth_first_and_holds_few_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def leaf(tile: Tile) -> None:
        asked.append((tile.column, tile.row))

    tiles = [Tile(column, row) for column in range(-2, 2) for row in range(4)]
    assert globe_tileset.grown(tiles, leaf, lambda *_: pytest.fail("nothing to store")) is None
    assert sorted(asked) == sorted((tile.column, tile.row) for tile in tiles)
    assert asked[:4] == [(-2, 0), (-2, 1), (-1, 0), (-1, 1)]


def test_the_command_says_how_heights_were_placed(run_dir: Path, tmp_path: Path) -> None:
    words = ("publish", str(run_dir), "--as", "3dtiles", "--out")
    code, said, heard = invoke(*words, str(tmp_path / "a"), "--geoid-height", "43.2")
    assert code == 0
    assert "heights: elevations plus the given geoid height (+43.2 m)" in said + heard
    code, said, _ = invoke(*words, str(tmp_path / "b"), "--json")
    document = json.loads(said)
    assert (code, document["as"], document["rows"]) == (0, "3dtiles", {"buildings": 4, "models": 3})
    assert "taken as ellipsoidal heights" in document["georeference"]["heights"]
    wrong = ("publish", str(run_dir), "--as", "cityjson", "--out", str(tmp_path / "c"), "--geoid-height", "1")
    assert invoke(*wrong)[0] == 2
