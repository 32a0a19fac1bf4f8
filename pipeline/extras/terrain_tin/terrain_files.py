"""The terrain of a tile as CityJSONSeq 2.0 (one TINRelief) and OBJ, and its triangles read back."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from pipeline.export.cityjson import decimals_of, heading, json_line, whole_units
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.export.obj import vertex_lines
from pipeline.export.stored_coordinates import SpatialReference, crs_coordinates
from pipeline.kernels.union_find import numbered_sets, united
from pipeline.model import BoolArray, FloatArray, LabelArray


@dataclasses.dataclass(frozen=True, kw_only=True)
class TerrainTriangles:
    """The terrain of a tile in the coordinates of the outputs."""

    vertices: FloatArray
    """(v, 3) float64 easting, northing, elevation in the units of the CRS."""
    triangles: LabelArray
    """(t, 3) int32, counter-clockwise seen from above."""


def terrain_path(tile_key: str, ending: str) -> str:
    """Where the terrain of a tile lies in the run directory; `ending` is `city.jsonl` or `obj`.

    >>> terrain_path("x85_y447", "obj")
    'terrain/tile=x85_y447/part-0.obj'
    """
    return f"{TERRAIN_FOLDER}/tile={tile_key}/part-0.{ending}"


def in_crs(
    vertices_m: FloatArray,
    origin: tuple[float, float, float],
    triangles: LabelArray,
    reference: SpatialReference,
) -> TerrainTriangles:
    """Triangles over local metres in the units of the CRS, rounded as those of buildings are."""
    return TerrainTriangles(vertices=crs_coordinates(vertices_m, origin, reference), triangles=triangles)


def terrain_lines(
    terrain: TerrainTriangles, tile_key: str, attributes: Mapping[str, float], reference: SpatialReference
) -> Iterator[str]:
    """The two lines of a CityJSONSeq file: the metadata, and a TINRelief with all triangles of a tile.

    A composite surface is connected (ISO 19107), so terrain in a closed courtyard is a surface of its own.
    """
    low, high = terrain.vertices.min(axis=0), terrain.vertices.max(axis=0)
    translate = whole_units(low)
    yield json_line(heading(f"terrain of tile {tile_key}", reference, translate, (low, high)))
    factor = np.array([10**digits for digits in decimals_of(reference)], dtype=np.int64)
    integers = np.round(terrain.vertices * factor).astype(np.int64) - np.array(translate, dtype=np.int64) * factor
    name = f"terrain-{tile_key}"
    surfaces = [
        {"type": "CompositeSurface", "lod": "2", "boundaries": [[face] for face in part.tolist()]}
        for part in surfaces_of(terrain.triangles)
    ]
    yield json_line(
        {
            "type": "CityJSONFeature",
            "id": name,
            "CityObjects": {name: {"type": "TINRelief", "attributes": dict(attributes), "geometry": surfaces}},
            "vertices": integers.tolist(),
        }
    )


def surfaces_of(triangles: LabelArray) -> list[LabelArray]:
    """The triangles (t, 3) as surfaces, each in their order: connected over edges, and touching itself nowhere.

    Where a surface would meet itself at a vertex, the triangles of one side of it become a surface of their own.

    >>> [part.tolist() for part in surfaces_of(np.array([[0, 1, 2], [3, 4, 5], [0, 2, 6]], np.int32))]
    [[[0, 1, 2], [0, 2, 6]], [[3, 4, 5]]]
    """
    found: list[LabelArray] = []
    waiting = [triangles]
    while waiting:
        part = waiting.pop()
        surface, fan = _surfaces_and_fans(part)
        for number in range(int(surface.max(initial=-1)) + 1):
            own = surface == number
            cut = _smaller_fans(part[own], fan[own])
            if cut.any():
                waiting += [part[own][cut], part[own][~cut]]
            else:
                found.append(part[own])
    return sorted(found, key=lambda surface: surface[0].tolist())


def _smaller_fans(triangles: LabelArray, fan: LabelArray) -> BoolArray:
    """The triangles (t,) of a surface in all fans but the largest around vertices where it meets itself.

    If these were all its triangles, those of one fan alone.
    """
    fans, corner, sizes = np.unique(fan.ravel(), return_index=True, return_counts=True)
    vertex = triangles.ravel()[corner]
    order = np.lexsort((-fans, -sizes, vertex))
    again = order[1:][vertex[order[1:]] == vertex[order[:-1]]]
    smaller = np.zeros(int(fans.max(initial=-1)) + 1, np.bool_)
    smaller[fans[again]] = True
    cut: BoolArray = np.logical_or.reduce(smaller[fan], axis=1)
    if len(again) and cut.all():
        smaller[fans[again[1:]]] = False
        cut = np.logical_or.reduce(smaller[fan], axis=1)
    return cut


def _surfaces_and_fans(triangles: LabelArray) -> tuple[LabelArray, LabelArray]:
    """The number of the surface of each triangle, (t,), and of the fan around each of its corners, (t, 3).

    Neighbours share an edge that no third has, and run along it in opposite directions. A fan is the neighbours around
    a vertex.
    """
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel()
    keys = np.minimum(start, end) << 32 | np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    same = np.pad(keys[order[1:]] == keys[order[:-1]], 1)
    first = np.flatnonzero(same[1:-1] & ~same[:-2] & ~same[2:])
    one, other = order[first], order[first + 1]
    opposite = start[one] == end[other]
    one, other = one[opposite], other[opposite]
    surface, _ = numbered_sets(united(len(triangles), one // 3, other // 3))
    # an edge starts at the corner of its number and ends at the next one of its triangle
    after_one, after_other = (edge - edge % 3 + (edge + 1) % 3 for edge in (one, other))
    corners = np.concatenate((one, other)), np.concatenate((after_other, after_one))
    fan, _ = numbered_sets(united(triangles.size, *corners))
    return surface, fan.reshape(-1, 3)


def terrain_obj(terrain: TerrainTriangles, tile_key: str, reference: SpatialReference) -> str:
    """One OBJ file with full coordinates: one object, one group `terrain`."""
    unit = f"{reference.horizontal_unit_m:.12g} m horizontally, {reference.vertical_unit_m:.12g} m vertically"
    lines = [f"# coordinates are easting, northing, elevation; one unit is {unit}", f"o terrain-{tile_key}"]
    lines.extend(vertex_lines(terrain.vertices, reference))
    lines.extend(("g terrain", "usemtl terrain"))
    lines.extend(f"f {a} {b} {c}" for a, b, c in (terrain.triangles + 1).tolist())
    return "\n".join(lines) + "\n"


def read_terrain(lines: Iterable[str]) -> TerrainTriangles:
    """The triangles in the lines of a file by `terrain_lines`; ValueError if they hold no TINRelief."""
    first, *features = (json.loads(line) for line in lines)
    for feature in features:
        for thing in feature["CityObjects"].values():
            if thing["type"] == "TINRelief":
                transform = first["transform"]
                steps = np.array([round(1.0 / scale) for scale in transform["scale"]], dtype=np.int64)
                whole = np.array(feature["vertices"], np.int64) + np.array(transform["translate"], np.int64) * steps
                faces = [face for surface in thing["geometry"] for face in surface["boundaries"]]
                triangles = np.array(faces, dtype=np.int32).reshape(-1, 3)
                return TerrainTriangles(vertices=whole / steps, triangles=triangles[np.lexsort(triangles.T[::-1])])
    raise ValueError("the lines hold no TINRelief")
