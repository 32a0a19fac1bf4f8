"""The terrain of a tile as CityJSONSeq and OBJ."""

import json

import numpy as np
import pytest
import small_buildings as small
from cityjson_rules import faults
from surface_rules import surface_faults

from pipeline.extras.terrain_tin import terrain_files as terrain
from pipeline.extras.terrain_tin.terrain_files import in_crs, read_terrain, surfaces_of, terrain_lines, terrain_obj
from pipeline.model import LabelArray

NAMES = ("compound", "feet and metres", "US feet", "unknown")
ORIGIN = (84_750.0, 447_500.0, 0.0)
LOCAL = np.array([[0.0, 0.0, -1.234], [100.001, 0.0, 2.0], [100.001, 99.999, 2.345], [0.0, 99.999, -3.217]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


@pytest.mark.parametrize("name", NAMES)
def test_a_tile_is_one_relief_by_the_rules_of_cityjson(references: dict[str, small.Reference], name: str) -> None:
    reference = references[name]
    terrain = in_crs(LOCAL, ORIGIN, TRIANGLES, reference)
    lines = list(terrain_lines(terrain, "x339_y1790", {"tolerance_m": 0.1}, reference))
    first, feature = (json.loads(line) for line in lines)
    assert faults([first, feature]) == []
    assert list(feature["CityObjects"]) == [feature["id"]] == ["terrain-x339_y1790"]
    relief = feature["CityObjects"]["terrain-x339_y1790"]
    assert relief["type"] == "TINRelief"
    assert relief["attributes"] == {"tolerance_m": 0.1}
    assert relief["geometry"][0]["boundaries"] == [[[0, 1, 2]], [[0, 2, 3]]]
    assert ("referenceSystem" in first["metadata"]) == (reference.epsg is not None)
    extent = first["metadata"]["geographicalExtent"]
    assert extent == [*terrain.vertices.min(axis=0), *terrain.vertices.max(axis=0)]


@pytest.mark.parametrize("name", NAMES)
def test_triangles_come_back_to_the_millimetre(references: dict[str, small.Reference], name: str) -> None:
    reference = references[name]
    terrain = in_crs(LOCAL, ORIGIN, TRIANGLES, reference)
    found = read_terrain(terrain_lines(terrain, "x339_y1790", {}, reference))
    assert np.array_equal(found.triangles, TRIANGLES)
    assert np.allclose(found.vertices, terrain.vertices, rtol=0.0, atol=1e-9)
    units = np.array([reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m])
    assert np.abs(found.vertices * units - (LOCAL + ORIGIN)).max() < 0.0005


def test_obj_has_full_coordinates_and_counts_vertices_from_one(references: dict[str, small.Reference]) -> None:
    reference = references["compound"]
    text = terrain_obj(in_crs(LOCAL, ORIGIN, TRIANGLES, reference), "x339_y1790", reference)
    assert text.splitlines() == [
        "# coordinates are easting, northing, elevation; one unit is 1 m horizontally, 1 m vertically",
        "o terrain-x339_y1790",
        "v 84750.000 447500.000 -1.234",
        "v 84850.001 447500.000 2.000",
        "v 84850.001 447599.999 2.345",
        "v 84750.000 447599.999 -3.217",
        "g terrain",
        "usemtl terrain",
        "f 1 2 3",
        "f 1 3 4",
    ]


def test_a_file_of_buildings_holds_no_terrain() -> None:
    first = {"type": "CityJSON", "transform": {"scale": [0.001] * 3, "translate": [0.0] * 3}}
    building = {"CityObjects": {"a": {"type": "Building"}}, "vertices": []}
    with pytest.raises(ValueError, match="the lines hold no TINRelief"):
        read_terrain([json.dumps(first), json.dumps(building)])


RING = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6], [5, 7, 6], [6, 7, 8], [7, 9, 8]]
"""A strip."""


@pytest.mark.parametrize(
    ("triangles", "sizes"),
    [
        ([*RING, [8, 9, 0]], [8, 1]),
        ([*RING, [8, 9, 0], [9, 1, 0]], [10]),
        ([[0, 1, 2], [0, 3, 4]], [1, 1]),
        ([[0, 1, 2], [1, 0, 3], [0, 1, 4], [1, 0, 5]], [1, 1, 1, 1]),
        ([[0, 1, 2], [0, 1, 3]], [1, 1]),
        ([[0, 1, 2], [1, 0, 3], [0, 2, 4], [4, 2, 3], [0, 1, 5]], [3, 1, 1]),
    ],
    ids=[
        "a ring closed at a vertex",
        "a ring",
        "a vertex",
        "four at an edge",
        "against each other",
        "a third at an edge",
    ],
)
def test_surfaces_touch_themselves_nowhere(triangles: list[list[int]], sizes: list[int]) -> None:
    found = surfaces_of(np.array(triangles, np.int32))
    assert sorted(map(len, found), reverse=True) == sizes
    assert [fault for surface in found for fault in surface_faults(surface.tolist())] == []
    assert sorted(face for surface in found for face in surface.tolist()) == sorted(triangles)


def test_there_is_no_surface_without_triangles() -> None:
    assert surfaces_of(np.empty((0, 3), np.int32)) == []


def test_many_vertices_where_a_surface_meets_itself_are_cut_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plain with 64 groups of three square holes, of which two touch the third at a corner."""
    side = 50
    corner = np.arange(side * side).reshape(side, side)[:-1, :-1]
    triangles = np.stack(
        (corner, corner + 1, corner + side + 1, corner, corner + side + 1, corner + side), axis=-1
    ).reshape(side - 1, side - 1, 2, 3)
    is_hole = np.zeros((side - 1, side - 1), np.bool_)
    for row in range(2, 48, 6):
        for column in range(2, 48, 6):
            is_hole[[row, row + 1, row], [column, column + 1, column + 2]] = True
    given = triangles[~is_hole].reshape(-1, 3).astype(np.int32)
    passes = []
    plain = terrain._surfaces_and_fans

    def counted(part: LabelArray) -> tuple[LabelArray, LabelArray]:
        passes.append(len(part))
        return plain(part)

    monkeypatch.setattr(terrain, "_surfaces_and_fans", counted)
    found = surfaces_of(given)
    assert [fault for one in found for fault in surface_faults(one.tolist())] == []
    assert sorted(np.concatenate(found).tolist()) == sorted(given.tolist())
    assert surface_faults(given.tolist())
    assert len(passes) < 10
