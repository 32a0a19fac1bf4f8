"""The terrain of a tile as CityJSONSeq 2.0 (one TINRelief) and OBJ, and its triangles read back."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from pipeline.export.cityjson import decimals_of, heading, json_line, whole_units
from pipeline.export.coordinates import SpatialReference, crs_coordinates
from pipeline.export.obj import vertex_lines
from pipeline.kernels.union_find import numbered_sets, united
from pipeline.model import FloatArray, LabelArray

FOLDER = "terrain"
"""The folder of the run directory with the terrain of all tiles."""


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
    return f"{FOLDER}/tile={tile_key}/part-0.{ending}"


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
        for part in connected_parts(terrain.triangles)
    ]
    yield json_line(
        {
            "type": "CityJSONFeature",
            "id": name,
            "CityObjects": {name: {"type": "TINRelief", "attributes": dict(attributes), "geometry": surfaces}},
            "vertices": integers.tolist(),
        }
    )


def connected_parts(triangles: LabelArray) -> list[LabelArray]:
    """The triangles (t, 3) in parts that are connected over edges, each in their order.

    >>> [part.tolist() for part in connected_parts(np.array([[0, 1, 2], [3, 4, 5], [0, 2, 6]], np.int32))]
    [[[0, 1, 2], [0, 2, 6]], [[3, 4, 5]]]
    """
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    keys = edges[:, 0] << 32 | edges[:, 1]
    order = np.argsort(keys, kind="stable")
    shared = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    part, count = numbered_sets(united(len(triangles), order[shared] // 3, order[shared + 1] // 3))
    return [triangles[part == number] for number in range(count)]


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
