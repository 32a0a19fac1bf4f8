"""Points as GLB: what is written is read again, and the points of one building are cut out byte by byte."""

import json
import struct
from typing import Any

import numpy as np
import pytest
from points_glb import read_points_glb

from pipeline.export.glb_arrays import MAX_STEP_MM
from pipeline.extras.octree.building_points import building_points
from pipeline.extras.octree.octree_tileset import TilesetNode, root_tileset
from pipeline.extras.octree.point_glb import NO_BUILDING, NO_PLANE, NO_RESIDUAL, ModelledPoints, points_glb, united

NAMES = ("ash", "birch", "cedar")


def some_points(n: int = 400, extent_mm: int = 60_000, seed: int = 2) -> ModelledPoints:
    rng = np.random.default_rng(seed)
    building = rng.choice(np.array([0, 1, 2, NO_BUILDING], np.uint16), n)
    held = building != NO_BUILDING
    xyz = rng.integers(-extent_mm // 2, extent_mm // 2, (n, 3))
    xyz[0], xyz[1] = -extent_mm // 2, extent_mm // 2
    return ModelledPoints(
        xyz_mm=xyz,
        point_class=rng.choice(np.array([2, 5, 6], np.uint8), n),
        building=building,
        plane=np.where(held, rng.integers(0, 300, n), NO_PLANE).astype(np.uint16),
        residual_mm=np.where(held, rng.integers(-500, 500, n), NO_RESIDUAL).astype(np.int16),
        buildings=NAMES,
    )


def rows(points: ModelledPoints, shift: tuple[int, int, int] = (0, 0, 0)) -> set[tuple[Any, ...]]:
    names = [None if k == NO_BUILDING else points.buildings[k] for k in points.building.tolist()]
    places = (points.xyz_mm + np.array(shift)).tolist()
    values = points.point_class.tolist(), points.plane.tolist(), points.residual_mm.tolist()
    return set(zip(map(tuple, places), names, *values, strict=True))


def document_of(content: bytes) -> tuple[dict[str, Any], int]:
    """The JSON of a GLB file, and where its binary data start."""
    magic, version, length, size, kind = struct.unpack_from("<IIIII", content)
    assert (magic, version, length, kind) == (0x46546C67, 2, len(content), 0x4E4F534A)
    return json.loads(content[20 : 20 + size]), 28 + size


def test_points_are_read_again_as_they_were_written() -> None:
    points = some_points()
    found, extras = read_points_glb(points_glb(points, "a node", {"origin_m": [1, 2, 3]}))
    assert rows(found) == rows(points)
    assert found.buildings == NAMES
    assert extras["origin_m"] == [1, 2, 3]
    assert extras["points"] == len(points)


@pytest.mark.parametrize(("extent_mm", "error_mm"), [(65_000, 0), (130_000, 1), (600_000, 5), (2_000_000, 1)])
def test_positions_keep_half_a_centimetre(extent_mm: int, error_mm: int) -> None:
    points = some_points(3_000, extent_mm)
    content = points_glb(points, "a node", {})
    found, _ = read_points_glb(content)
    assert np.abs(found.xyz_mm - points.by_building().xyz_mm).max() <= error_mm
    position = document_of(content)[0]["accessors"][0]
    assert position["componentType"] == (5126 if extent_mm > 65_535 * MAX_STEP_MM else 5123)


def test_every_attribute_starts_at_a_multiple_of_four_bytes_and_states_its_bounds() -> None:
    document, start = document_of(points_glb(some_points(), "a node", {}))
    assert start % 4 == 0
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteStride"] % 4 == 0
    (primitive,) = document["meshes"][0]["primitives"]
    assert set(primitive["attributes"]) == {"POSITION", "_CLASS", "_BUILDING", "_PLANE", "_RESIDUAL"}
    assert primitive["mode"] == 0
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == [0, 0, 0]
    assert max(position["max"]) == 60_000
    assert document["extensionsRequired"] == ["KHR_mesh_quantization"]


def test_the_points_of_a_building_follow_each_other() -> None:
    found, extras = read_points_glb(points_glb(some_points(), "a node", {}))
    for k, (first, last) in enumerate(zip(extras["starts"], extras["starts"][1:], strict=False)):
        assert (found.building[first:last] == k).all()
    assert (found.building[extras["starts"][-1] :] == NO_BUILDING).all()
    assert len(extras["starts"]) == len(NAMES) + 1


def test_a_node_names_only_the_buildings_that_it_holds() -> None:
    points = some_points()
    part = points.take(np.flatnonzero(points.building != 1))
    assert part.buildings == ("ash", "cedar")
    assert rows(part) == {row for row in rows(points) if row[1] != "birch"}


def test_parts_with_other_buildings_become_one() -> None:
    points = some_points()
    halves = [points.take(np.flatnonzero(points.building == 2)), points.take(np.flatnonzero(points.building != 2))]
    whole = united([halves[0].moved((10, 0, -5)).moved((-10, 0, 5)), halves[1]])
    assert rows(whole) == rows(points)
    assert whole.buildings == NAMES
    assert len(united([])) == 0


def test_a_file_of_no_points_is_refused() -> None:
    with pytest.raises(ValueError, match="no points"):
        points_glb(some_points().take(np.empty(0, np.int64)), "a node", {})


def test_another_file_is_not_read_as_points() -> None:
    with pytest.raises(ValueError, match="not a GLB file"):
        read_points_glb(b"<html>" + bytes(40))


def node(origin_mm: tuple[int, int, int], uri: str, *children: TilesetNode) -> TilesetNode:
    high = origin_mm[0] + 9_000, origin_mm[1] + 9_000, origin_mm[2] + 9_000
    return TilesetNode(
        origin_mm=origin_mm, low_mm=origin_mm, high_mm=high, error_m=1.0, uri=uri, points=1, children=children
    )


def test_a_building_is_put_together_from_its_tiles_and_the_nodes_above_them() -> None:
    origins = {"x0_y0": (1_000, 5_000, 2_000), "x1_y0": (251_000, 5_000, -3_000), "upper": (1_000, 5_000, -3_000)}
    parts = {name: some_points(seed=seed) for seed, name in enumerate(origins)}
    files = {}
    for name, path in (("x0_y0", "x0_y0/r3.glb"), ("x1_y0", "x1_y0/r.glb"), ("upper", "upper/1_0_0.glb")):
        files[path] = points_glb(parts[name], path, {"origin_m": [value // 1000 for value in origins[name]]})
    for key, path in (("x0_y0", "r3"), ("x1_y0", "r")):
        entry = {"nodes": [path], "tiles": ["x0_y0", "x1_y0"]}
        files[f"{key}/buildings.json"] = json.dumps({"birch": entry}).encode()
    tiles = [node(origins[key], f"{key}/tileset.json") for key in ("x0_y0", "x1_y0")]
    other = node((0, 900_000, 0), "x0_y3/tileset.json")
    beside = node((0, 900_000, 0), "upper/1_0_1.glb", other)  # holds no tile of the building: it must not be read
    root = node(origins["upper"], "upper/1_0_0.glb", *tiles, beside)
    place = {"horizontal_unit_m": 1.0, "vertical_unit_m": 1.0, "crs": None}
    files["tileset.json"] = root_tileset(root, place) or b""
    content = building_points(files.__getitem__, "x0_y0", "birch")
    assert content is not None
    document, start = document_of(content)
    found = set()
    for one, mesh in zip(document["nodes"], document["meshes"], strict=True):
        single = {**document, "nodes": [one], "meshes": [{**mesh, "extras": {"buildings": ["birch"]}}]}
        text = json.dumps(single).encode()
        text += b" " * (-len(text) % 4)
        alone = struct.pack("<IIIII", 0x46546C67, 2, 0, len(text), 0x4E4F534A) + text + bytes(8) + content[start:]
        found |= rows(read_points_glb(alone)[0])
    first = np.array(origins["x0_y0"])
    expected = [rows(part, tuple(np.array(origins[name]) - first)) for name, part in parts.items()]
    assert found == {row for part in expected for row in part if row[1] == "birch"}
    assert document["asset"]["extras"]["origin_m"] == [1, 5, 2]
    assert building_points(files.__getitem__, "x0_y0", "cedar") is None
    for number, accessor in enumerate(document["accessors"]):
        assert accessor["bufferView"] == number
        if "min" in accessor:
            view = document["bufferViews"][number]
            at = start + view["byteOffset"]
            stored = np.frombuffer(content[at : at + view["byteLength"]], "<u2").reshape(-1, 4)[:, :3]
            assert stored.min(axis=0).tolist() == accessor["min"]
            assert stored.max(axis=0).tolist() == accessor["max"]
