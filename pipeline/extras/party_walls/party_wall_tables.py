"""The tables of party walls: GeoParquet, one row per pair of walls that touch, and one row per building."""

from __future__ import annotations

from pipeline.export.columns import COUNT, FLOAT64, HORIZONTAL, INT32, NONE, TEXT, WKB, Column
from pipeline.export.result_file import ResultTable

FACTS = "gablework_party_walls"
"""The key of the files' metadata that holds the tolerances, as JSON."""

WALLS = (
    Column("tile", TEXT, NONE, "tile of building a in the run", required=True),
    Column("building_a", TEXT, NONE, "one building, that with the smaller id", required=True),
    Column("face_a", INT32, NONE, "its wall: number of the polygon in its `solid`, from 0", required=True),
    Column("building_b", TEXT, NONE, "the other building", required=True),
    Column("face_b", INT32, NONE, "its wall, numbered likewise", required=True),
    Column(
        "geometry",
        WKB,
        HORIZONTAL,
        "the part that both walls share, in 3D: a Polygon Z or MultiPolygon Z half-way between both, counter-clockwise "
        "seen from outside building a",
    ),
    Column("area_m2", FLOAT64, "m2", "area of that part", required=True),
    Column(
        "distance_m", FLOAT64, "m", "its mean distance from a to b; negative where the buildings overlap", required=True
    ),
    Column("angle_deg", FLOAT64, "deg", "angle between the planes of both walls", required=True),
)
"""The columns of the pairs, in the order of the file; `bbox` follows."""

BUILDINGS = (
    Column("tile", TEXT, NONE, "tile of the run", required=True),
    Column("building_id", TEXT, NONE, "as in the run", required=True),
    Column("geometry", WKB, HORIZONTAL, "footprint, as in the run"),
    Column("wall_area_m2", FLOAT64, "m2", "area of all walls of the model", required=True),
    Column(
        "shared_wall_area_m2",
        FLOAT64,
        "m2",
        "the part of it that touches other buildings; what touches two of them counts once",
        required=True,
    ),
    Column(
        "inner_wall_area_m2",
        FLOAT64,
        "m2",
        "the part that touches other solids of the same building: inside, and no party wall",
        required=True,
    ),
    Column("exposed_wall_area_m2", FLOAT64, "m2", "the rest, to the open air or below ground", required=True),
    Column("neighbours", INT32, COUNT, "other buildings that it touches", required=True),
)
"""The columns of the buildings with a model, in the order of the file; `bbox` follows."""


TABLES = (ResultTable(WALLS, FACTS), ResultTable(BUILDINGS, FACTS))
"""The tables of the pairs and of the buildings."""
