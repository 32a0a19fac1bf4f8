"""The terrain of a run in what is published: a tileset of its own, CityJSON files, and a catalogue."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import small_buildings as small
from cityjson_rules import faults
from glb_rules import chunks, values_of
from small_runs import content, moved, restated, street, tiled_run

from pipeline.errors import RunError
from pipeline.extras.publish.cityjson_file import publish_cityjson
from pipeline.extras.publish_3dtiles.globe_terrain import PlacedTerrain, terrain_glb
from pipeline.extras.publish_3dtiles.publishing_3dtiles import publish_3dtiles
from pipeline.extras.publish_stac.stac import publish_stac
from pipeline.extras.terrain_tin.terrain_files import TerrainTriangles, read_terrain, terrain_lines, terrain_path
from pipeline.io import storage_at

GEOID_M = 43.2
BORDER_X = 85_250.0
"""Easting of the border between two tiles with terrain."""
ALONE = "x87_y447"
"""A tile with terrain and no candidate."""


def terrain_at(x0: float) -> TerrainTriangles:
    """Five vertices on a slope of 500 m, one in the middle; those on the border are the neighbour's, too."""
    places = np.array([[x0, 447_000.0], [x0 + 250, 447_000.0], [x0 + 250, 447_333.333], [x0, 447_333.333]])
    middle = places.mean(axis=0).round(3)
    xy = np.vstack((places, middle))
    z = np.round((xy[:, 0] - 85_000.0) * 0.0123 + (xy[:, 1] - 447_000.0) * 0.01, 3)
    triangles = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 4], [2, 3, 4]], np.int32)
    return TerrainTriangles(vertices=np.column_stack((xy, z)), triangles=triangles)


TERRAIN = {"x85_y447": terrain_at(BORDER_X - 250), "x86_y447": terrain_at(BORDER_X), ALONE: terrain_at(BORDER_X + 250)}


@pytest.fixture
def run_dir(tmp_path: Path, contexts: small.Contexts) -> Path:
    """A run of the street with the terrain of three tiles, one of them without buildings."""
    fallback, court, *others = street()
    run = tiled_run(tmp_path / "run", {"x85_y447": [fallback, moved(court, 50.0)], "x86_y447": others}, contexts)
    for key, terrain in TERRAIN.items():
        lines = terrain_lines(terrain, key, {"tolerance_m": 0.1}, contexts["compound"].reference)
        storage_at(run).put(terrain_path(key, "city.jsonl"), "".join(f"{line}\n" for line in lines).encode())
    lattice = {"tile_size_m": 1000.0, "origin_x_m": 0.0, "origin_y_m": 0.0}
    restated(run, lattice=lattice, tiles=("x85_y447", "x86_y447", ALONE))
    return run


def triangles_at(path: Path, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices in EPSG:4978, their normals there, and the triangles of a file about the axes of a matrix."""
    document, binary = chunks(path.read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]

    def turned(xyz: np.ndarray) -> np.ndarray:
        found: np.ndarray = np.column_stack((xyz[:, 0], -xyz[:, 2], xyz[:, 1])) @ matrix[:3, :3].T
        return found

    positions, normals = (values_of(document, binary, primitive["attributes"][name]) for name in ("POSITION", "NORMAL"))
    triangles = values_of(document, binary, primitive["indices"]).reshape(-1, 3)
    return turned(positions.astype(float)) + matrix[:3, 3], turned(normals / 127.0), triangles


def placed(out: Path) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What the tileset of the terrain shows, by tile."""
    tileset = json.loads((out / "terrain.json").read_text())
    found = {}
    for node in tileset["root"]["children"]:
        assert "content" not in node
        (leaf,) = node["children"]
        assert leaf["geometricError"] == 0.0 < node["geometricError"] < tileset["geometricError"]
        uri = leaf["content"]["uri"]
        matrix = np.array(leaf["transform"]).reshape(4, 4).T
        found[Path(uri).stem] = triangles_at(out / uri, matrix)
    return found


def test_terrain_lies_where_proj_says_as_the_buildings_do(run_dir: Path, tmp_path: Path) -> None:
    published = publish_3dtiles(str(run_dir), str(tmp_path / "out"), geoid_height_m=GEOID_M)
    plan = pyproj.Transformer.from_crs(28992, 4979, always_xy=True)
    globe = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    found = placed(tmp_path / "out")
    assert set(found) == set(TERRAIN)
    for key, terrain in TERRAIN.items():
        vertices, _, triangles = found[key]
        x, y, z = terrain.vertices.T
        wanted = np.column_stack(globe.transform(*plan.transform(x, y), z + GEOID_M))
        assert np.abs(vertices - wanted).max() < 0.0002
        assert np.array_equal(triangles, terrain.triangles)
    extras = json.loads((tmp_path / "out" / "tileset.json").read_text())["asset"]["extras"]
    assert extras.pop("terrain") == "terrain.json"
    assert json.loads((tmp_path / "out" / "terrain.json").read_text())["asset"]["extras"] == extras
    assert dict(published.georeference).items() <= extras.items()


def test_neighbours_meet_at_their_border(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    found = placed(tmp_path / "out")
    west, east = found["x85_y447"][0][[1, 2]], found["x86_y447"][0][[0, 3]]
    assert np.abs(west - east).max() < 0.0002


def test_normals_are_between_those_of_the_triangles_and_look_up(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    for vertices, normals, triangles in placed(tmp_path / "out").values():
        a, b, c = (vertices[triangles[:, k]] for k in range(3))
        drawn = np.cross(b - a, c - a)
        drawn /= np.linalg.norm(drawn, axis=1)[:, None]
        assert (drawn @ (vertices[0] / np.linalg.norm(vertices[0]))).min() > 0.9
        # the slope is the same everywhere
        assert (normals @ drawn[0]).min() > 0.999


def test_the_buildings_are_as_without_terrain_and_nothing_is_left_of_it(run_dir: Path, tmp_path: Path) -> None:
    publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    first = content(tmp_path / "out")
    publish_3dtiles(str(run_dir), str(tmp_path / "again"))
    assert content(tmp_path / "again") == first
    for key in TERRAIN:
        (run_dir / terrain_path(key, "city.jsonl")).unlink()
    publish_3dtiles(str(run_dir), str(tmp_path / "out"), overwrite=True)
    bare = content(tmp_path / "out")
    assert set(first) - set(bare) == {"terrain.json", *(f"terrain/{key}.glb" for key in TERRAIN)}
    assert all(bare[name] == first[name] for name in bare if name != "tileset.json")
    assert b"terrain" not in bare["tileset.json"]


def test_each_cityjson_file_holds_the_terrain_of_its_tile(run_dir: Path, tmp_path: Path) -> None:
    published = publish_cityjson(str(run_dir), str(tmp_path / "out"))
    assert published.rows == {"buildings": 4}
    for key, terrain in TERRAIN.items():
        city = json.loads((tmp_path / "out" / f"{key}.city.json").read_text())
        relief = city["CityObjects"].pop(f"terrain-{key}")
        assert {thing["type"] for thing in city["CityObjects"].values()} == (
            set() if key == ALONE else {"Building", "BuildingPart"}
        )
        vertices = np.array(city["vertices"]) * city["transform"]["scale"] + city["transform"]["translate"]
        faces = np.array([face for surface in relief["geometry"] for face in surface["boundaries"]]).reshape(-1, 3)
        assert np.allclose(vertices[faces], terrain.vertices[terrain.triangles], rtol=0.0, atol=1e-6)
        low, high = np.array(city["metadata"]["geographicalExtent"]).reshape(2, 3)
        assert np.allclose([low, high], [vertices.min(axis=0), vertices.max(axis=0)], rtol=0.0, atol=1e-6)


def test_a_catalogue_lists_terrain_also_of_a_tile_without_buildings(run_dir: Path, tmp_path: Path) -> None:
    publish_stac(str(run_dir), str(tmp_path / "out"))
    for key in TERRAIN:
        item: dict[str, Any] = json.loads((tmp_path / "out" / key / f"{key}.json").read_text())
        asset = item["assets"]["terrain"]
        file = (tmp_path / "out" / key / asset["href"]).resolve()
        assert asset["type"] == "application/city+json-seq"
        assert asset["file:checksum"] == f"1220{hashlib.sha256(file.read_bytes()).hexdigest()}"
        assert ("buildings" in item["assets"]) == (key != ALONE)
    assert item["properties"]["proj:bbox"] == [87_000.0, 447_000.0, 88_000.0, 448_000.0]


@pytest.mark.parametrize(("count", "component", "kind"), [(65_535, 5123, "<u2"), (65_536, 5125, "<u4")])
def test_triangles_name_every_vertex_of_a_large_tile(count: int, component: int, kind: str) -> None:
    triangles = np.array([[0, 1, count - 1]], np.int32)
    terrain = PlacedTerrain(
        geocentric=np.random.default_rng(1).random((count, 3)), triangles=triangles, region=np.eye(3)
    )
    document, binary = chunks(terrain_glb(terrain, np.eye(4)))
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["indices"]]
    start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    assert accessor["componentType"] == component
    assert np.frombuffer(binary, kind, 3, start).tolist() == triangles[0].tolist()


def test_damaged_terrain_is_named(run_dir: Path, tmp_path: Path) -> None:
    path = run_dir / terrain_path("x86_y447", "city.jsonl")
    path.write_text(path.read_text().replace("TINRelief", "Road"))
    with pytest.raises(RunError, match=r"terrain/tile=x86_y447.*no TINRelief.*run it again"):
        publish_3dtiles(str(run_dir), str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_closed_courtyard_is_a_surface_of_its_own(contexts: small.Contexts) -> None:
    away = TERRAIN["x86_y447"]
    both = TerrainTriangles(
        vertices=np.vstack((away.vertices, away.vertices + np.array([0.0, 0.0, 9.0]))),
        triangles=np.concatenate([np.stack((t, t + 5)) for t in away.triangles]).astype(np.int32),
    )
    both = TerrainTriangles(vertices=both.vertices, triangles=both.triangles[np.lexsort(both.triangles.T[::-1])])
    lines = list(terrain_lines(both, "x1_y1", {}, contexts["compound"].reference))
    first, feature = map(json.loads, lines)
    assert faults([first, feature]) == []
    surfaces = feature["CityObjects"]["terrain-x1_y1"]["geometry"]
    assert [{corner < 5 for (face,) in surface["boundaries"] for corner in face} for surface in surfaces] == [
        {True},
        {False},
    ]
    assert np.array_equal(read_terrain(lines).triangles, both.triangles)
