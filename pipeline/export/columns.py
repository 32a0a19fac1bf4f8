"""Every column of the tables of a run: name, type, unit and meaning, in one place.

The schemas of the tables, the reference page, the comments in a GeoPackage and the fields of other formats are made
from these lists. A column has the same name in every format; `docs/reference/columns.md` says what its type becomes.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import pyarrow as pa

TEXT, BOOL, INT32, INT64, FLOAT64, TIME, WKB = "string", "bool", "int32", "int64", "double", "timestamp", "binary"
INT32S, TEXTS, FLOAT32S, FLOAT64S = f"list {INT32}", f"list {TEXT}", "list float", f"list {FLOAT64}"
"""Types of columns, as Arrow's in `arrow_type`: the names alone need not load it."""

NONE = ""
"""Unit of what has none."""
SHARE, COUNT = "share", "count"
"""Units of a number from 0 to 1 (a `footprint_share` may be more), and of a number of things."""
HORIZONTAL, VERTICAL = "CRS", "CRS, vertical"
"""Units of coordinates: the horizontal and the vertical unit of the run's CRS."""


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of a table."""

    name: str
    """Its name, the same in every format."""
    word: str
    """Its type in the run's own tables, in a word."""
    unit: str
    """Its unit; empty if it has none."""
    meaning: str
    """What it holds and when it is null, for people; without links."""
    page: str = ""
    """The page that says more, relative to docs/reference; empty if there is none."""
    required: bool = dataclasses.field(default=False, kw_only=True)
    """Whether every row has a value."""

    @property
    def kind(self) -> pa.DataType:
        """Its type in the run's own tables."""
        return arrow_type(self.word)

    @property
    def comment(self) -> str:
        """Meaning and unit in one sentence, for formats that hold a comment per column.

        >>> Column("height_m", FLOAT64, "m", "ridge above floor").comment
        'ridge above floor [m]'
        """
        return f"{self.meaning} [{self.unit}]" if self.unit else self.meaning

    def comment_in(self, units: Mapping[str, str]) -> str:
        """The comment with the units of a run's CRS, by `HORIZONTAL` and `VERTICAL`.

        >>> Column("ridge_z", FLOAT64, VERTICAL, "highest roof point").comment_in({VERTICAL: "US survey foot"})
        'highest roof point [US survey foot]'
        """
        return dataclasses.replace(self, unit=units.get(self.unit, self.unit)).comment


BUILDINGS = (
    Column(
        "building_id",
        TEXT,
        NONE,
        "base32 of a sha256 over the CRS and the candidate's smallest point: the same for every method, "
        "tiling and number of workers",
        required=True,
    ),
    Column("source_id", TEXT, NONE, "id of the given footprint; null without footprints"),
    Column("source_attributes", TEXT, NONE, "the given footprint's columns as a JSON object; null without footprints"),
    Column("status", TEXT, NONE, "`ok`, `doubtful`, `fallback` or `failed`", page="records.md#status", required=True),
    Column(
        "reason", TEXT, NONE, "why the status is not `ok`, from a closed list; null if it is", page="records.md#reasons"
    ),
    Column("reason_detail", TEXT, NONE, "measured figure and threshold, as a sentence", required=True),
    Column(
        "overridden",
        TEXT,
        NONE,
        "what the overrides changed: `accept`, `footprint`, `method`, several with commas; null if nothing",
        page="../how_to/overrides.md",
    ),
    Column("method", TEXT, NONE, "name of the method, such as `fuzzy-sart`", required=True),
    Column(
        "roof_type",
        TEXT,
        NONE,
        "`flat`, `pent`, `gable`, `half-hip`, `hip`, `pyramid`, `gambrel`, `mansard`, `butterfly`, `sawtooth`, "
        "`l-shape`, `t-shape`, `cross`, `barrel`, `cone`, `dome`, `combination`, `unknown`, or `none` without a model: "
        "the main roof decides",
        required=True,
    ),
    Column(
        "geometry",
        WKB,
        HORIZONTAL,
        "footprint: the outline of the delivered solids, 2D; null if the points span no area",
    ),
    Column(
        "lod",
        TEXT,
        NONE,
        "level of detail of the model: the finest requested (`2.2` by default), `1.2` for a fallback block, "
        "null without a model",
    ),
    Column(
        "solid",
        WKB,
        HORIZONTAL,
        "the solids: a MultiPolygon Z with one polygon per face, oriented outward; null without a model",
        page="../how_to/solids_and_meshes.md#solids-in-geoparquet",
    ),
    Column("solid_parts", INT32S, NONE, "number of the solid that each polygon of `solid` belongs to, from 0"),
    Column("solid_surfaces", TEXTS, NONE, "kind of each polygon: `RoofSurface`, `WallSurface` or `GroundSurface`"),
    Column("solid_planes", INT32S, NONE, "`plane_id` of each polygon; -1 on walls and ground"),
    Column(
        "solid_lod12",
        WKB,
        HORIZONTAL,
        "the solids in LoD1.2 beside a finer model, like `solid`; null if not requested, and if `solid` "
        "itself has this level",
        page="../how_to/solids_and_meshes.md#levels-of-detail",
    ),
    Column("solid_lod12_parts", INT32S, NONE, "like `solid_parts`, for LoD1.2"),
    Column("solid_lod12_surfaces", TEXTS, NONE, "like `solid_surfaces`, for LoD1.2"),
    Column("solid_lod13", WKB, HORIZONTAL, "the solids in LoD1.3, like `solid_lod12`"),
    Column("solid_lod13_parts", INT32S, NONE, "like `solid_parts`, for LoD1.3"),
    Column("solid_lod13_surfaces", TEXTS, NONE, "like `solid_surfaces`, for LoD1.3"),
    Column("solid_lod20", WKB, HORIZONTAL, "the solids in LoD2.0, like `solid_lod12`"),
    Column("solid_lod20_parts", INT32S, NONE, "like `solid_parts`, for LoD2.0"),
    Column("solid_lod20_surfaces", TEXTS, NONE, "like `solid_surfaces`, for LoD2.0"),
    Column(
        "solid_lod23",
        WKB,
        HORIZONTAL,
        "the solids with overhangs (LoD2.3), like `solid`; null if not requested, and where `lod23_reason` says why "
        "there are none",
        page="../methods/overhangs.md",
    ),
    Column("solid_lod23_parts", INT32S, NONE, "like `solid_parts`, for LoD2.3"),
    Column(
        "solid_lod23_surfaces",
        TEXTS,
        NONE,
        "like `solid_surfaces`, for LoD2.3, and `OuterCeilingSurface` for the undersides of overhangs",
    ),
    Column("solid_lod23_planes", INT32S, NONE, "like `solid_planes`, for LoD2.3; -1 on undersides too"),
    Column("boxes", WKB, HORIZONTAL, "boxes of chimneys and roof units, like `solid`; null without any"),
    Column("ground_z", FLOAT64, VERTICAL, "elevation of the floor: the lowest terrain at the outline"),
    Column(
        "ground_source",
        TEXT,
        NONE,
        "where `ground_z` comes from: `terrain`, `attribute` (of the given footprint), or `assumed` (2.5 m below the "
        "lowest point, without terrain); null if it is unknown",
        page="../how_to/footprints.md#heights-from-attributes",
    ),
    Column("eave_z", FLOAT64, VERTICAL, "median elevation of the eave edges, weighted by roof area"),
    Column("ridge_z", FLOAT64, VERTICAL, "highest roof point"),
    Column("h_min", FLOAT64, VERTICAL, "elevation of the lowest roof point"),
    Column("h_50p", FLOAT64, VERTICAL, "median elevation of the roof over plan area"),
    Column("h_70p", FLOAT64, VERTICAL, "70th percentile of the roof's elevation over plan area"),
    Column("h_max", FLOAT64, VERTICAL, "elevation of the highest roof point"),
    Column("height_m", FLOAT64, "m", "ridge above floor"),
    Column(
        "height_source",
        TEXT,
        NONE,
        "where the height comes from: `points`, or an attribute of the given footprint (`height`, `roof_elevation`, "
        "`storeys`); null without a model",
        page="../how_to/footprints.md#heights-from-attributes",
    ),
    Column("footprint_area_m2", FLOAT64, "m2", "plan area"),
    Column(
        "footprint_share",
        FLOAT64,
        SHARE,
        "plan area over the area of the given footprint: 1 if the model fills it, less if a part without points "
        "was left out, more only if a block uses its convex hull; null without a given footprint or without a"
        " model",
        page="../methods/solids.md#parts-without-points",
    ),
    Column("roof_area_m2", FLOAT64, "m2", "true (slanted) area of all roof faces"),
    Column("volume_m3", FLOAT64, "m3", "volume of the solids"),
    Column("n_points", INT64, COUNT, "points of the candidate", required=True),
    Column("density_per_m2", FLOAT64, "1/m2", "points per square metre of footprint"),
    Column(
        "through_share",
        FLOAT64,
        SHARE,
        "share of the points whose pulse went on to a later return: pulses go through leaves and not through "
        "roofs; null without points",
    ),
    Column(
        "detection_confidence",
        FLOAT64,
        SHARE,
        "probability, from 0 to 1, that this object is a building; for a block the confidence of the doubtful model "
        "that it replaced; null for other blocks, without a model, and if a given "
        "footprint or an override (`accept`, `footprint`) says that it is one",
        page="records.md#confidence-of-a-detection",
    ),
    Column("n_planes", INT32, COUNT, "delivered roof planes", required=True),
    Column(
        "rmse_m",
        FLOAT64,
        "m",
        "root mean square vertical distance of the roof returns to the model's top surface; no distance counts "
        "more than 1 m, or than the 90th percentile if that is larger, so a chimney does not decide",
        page="records.md#figures-of-fit",
    ),
    Column("p95_m", FLOAT64, "m", "95th percentile of the absolute distances of the roof returns"),
    Column(
        "coverage",
        FLOAT64,
        SHARE,
        "share of the roof returns that have a roof above or below them; null if the height is an attribute",
    ),
    Column("point_spacing_m", FLOAT64, "m", "typical distance of neighbouring roof points in plan"),
    Column(
        "noise_m",
        FLOAT64,
        "m",
        "robust standard deviation of the roof returns about the roof (1.4826 times the median absolute residual); "
        "null for a block",
    ),
    Column(
        "share_within_0_2m",
        FLOAT64,
        SHARE,
        "share of the roof returns that have a roof within 0.2 m above or below them",
        page="records.md#figures-of-fit",
    ),
    Column(
        "share_below_roof",
        FLOAT64,
        SHARE,
        "share of all points that are not roof returns: on facades, below the roof; null in older runs, whose "
        "figures of fit are of all points",
        page="records.md#figures-of-fit",
    ),
    Column(
        "unexplained_m2",
        FLOAT64,
        "m2",
        "plan area of roof that is farther than 1.5 point spacings from every point within 0.2 m of the roof",
    ),
    Column(
        "extrapolated_share",
        FLOAT64,
        SHARE,
        "share of the roof's plan area that is farther than two point spacings from every point over or under it: it "
        "continues what lies beside it",
        page="../methods/solids.md#sides-that-were-not-seen",
    ),
    Column(
        "largest_hole_m",
        FLOAT64,
        "m",
        "diameter of the largest circle about a place on the roof that holds no point in plan",
    ),
    Column(
        "ridge_z_sigma_m",
        FLOAT64,
        "m",
        "standard deviation of `ridge_z` in metres; null for a block",
        page="records.md#uncertainty-of-the-ridge",
    ),
    Column(
        "outline_sigma_m",
        FLOAT64,
        "m",
        "standard deviation of the place of the outline's edges, across their direction; null if the outline was given",
        page="records.md#uncertainty-of-the-outline",
    ),
    Column(
        "bic_margin",
        FLOAT64,
        NONE,
        "information criterion of the other form (templates or arrangement) minus the chosen form's; "
        "negative if the better one made no valid solid; null if none competed or a third form was delivered",
    ),
    Column(
        "is_curved",
        BOOL,
        NONE,
        "`roof_type` is `barrel`, `cone` or `dome`, or at least half of the roof is one surface that bends steadily "
        "outwards, modelled as planes: at least five directions, each next one turned by 3 to 26 deg",
        required=True,
    ),
    Column(
        "valid", BOOL, NONE, "a model was delivered, so it passed the ISO 19107 rules after rounding", required=True
    ),
    Column(
        "validity_codes",
        INT32S,
        NONE,
        "codes of the faults that prevented delivery of the method's own solid; empty if there were none",
        page="validity.md",
        required=True,
    ),
    Column("touches_data_edge", BOOL, NONE, "the data end at this building, so it may be cut", required=True),
    Column(
        "strip_offset_m",
        FLOAT64,
        "m",
        "largest offset between two flight strips that was taken out of the points before modelling; null if "
        "the strips fit or do not show an offset",
        page="../methods/strips.md",
    ),
    Column(
        "ground_noise_m",
        FLOAT64,
        "m",
        "robust standard deviation of single points of open, level ground nearby about the terrain: the noise of the "
        "survey and of low plants; null where there is little such ground",
        page="records.md#support",
    ),
    Column(
        "wall_outline",
        WKB,
        HORIZONTAL,
        "outline of the walls beneath a footprint at the eaves, ISO WKB (MultiPolygon); with `wall_outline = "
        "true`, null if no wall was seen",
        page="../methods/footprints.md",
    ),
    Column("overhang_m", FLOAT64, "m", "mean overhang of the eaves along the walls that were seen, weighted by length"),
    Column(
        "overhang_sigma_m",
        FLOAT64,
        "m",
        "standard error of `overhang_m`, from the thickness of the walls' points and the differences between walls",
    ),
    Column(
        "overhang_source",
        TEXT,
        NONE,
        "where the overhangs of `solid_lod23` come from: `seen` if points show a wall of the building; `usual` and "
        "`given` if they are `usual_overhang_m` and `beyond_footprint_m` of the settings; null without such solids",
        page="../methods/overhangs.md#where-overhangs-come-from",
    ),
    Column(
        "lod23_reason",
        TEXT,
        NONE,
        "why a model has no solids in LoD2.3, from a closed list; null if it has, and if they are not requested",
        page="../methods/overhangs.md#buildings-without-lod23",
    ),
    Column("n_boxes", INT32, COUNT, "number of `boxes`; null if they are not requested, and without a model in LoD2.2"),
    Column(
        "guides_followed",
        INT32,
        COUNT,
        "given guides that edges of the roof faces follow over at least half of their length here; null without a "
        "model, without any guide near, or where they failed and were left out",
        page="../how_to/guides.md",
    ),
    Column(
        "guides_not_followed",
        INT32,
        COUNT,
        "other given guides that run over the roof or beside it",
        page="../how_to/guides.md",
    ),
    Column("acquired_from", TIME, NONE, "earliest acquisition; null if the file has no absolute time"),
    Column("acquired_to", TIME, NONE, "latest acquisition"),
    Column("mesh_path", TEXT, NONE, "the OBJ or GLB file, relative to the run directory; null without one"),
    Column("input_hash", TEXT, NONE, "sha256 of the candidate's ordered points and ground"),
    Column(
        "settings_hash",
        TEXT,
        NONE,
        "sha256 of the settings that can change geometry; of this building's own settings if an override set some",
        required=True,
    ),
    Column("engine_version", TEXT, NONE, "version of gablework", required=True),
)
"""One row per candidate."""

SHOWN: Mapping[str, Mapping[str, tuple[str, int]]] = {
    "Height": {
        "height_m": ("Ridge above floor", 2),
        "ground_z": ("Ground", 2),
        "eave_z": ("Eaves", 2),
        "ridge_z": ("Ridge", 2),
        "h_50p": ("Median of the roof", 2),
    },
    "Size": {
        "footprint_area_m2": ("Footprint", 1),
        "roof_area_m2": ("Roof, slanted", 1),
        "volume_m3": ("Volume", 0),
        "n_planes": ("Roof planes", 0),
    },
    "Fit to the points": {
        "share_within_0_2m": ("Within 0.2 m of the roof", 1),
        "rmse_m": ("RMSE", 3),
        "p95_m": ("95th percentile", 3),
        "coverage": ("Points covered", 1),
        "share_below_roof": ("Points on facades and below", 1),
        "footprint_share": ("Given footprint covered", 1),
        "noise_m": ("Noise of the points", 3),
        "ridge_z_sigma_m": ("Ridge uncertainty (one sigma)", 3),
        "outline_sigma_m": ("Outline uncertainty (one sigma)", 3),
        "unexplained_m2": ("Roof unexplained by points", 1),
        "extrapolated_share": ("Roof that was not seen", 1),
        "largest_hole_m": ("Largest hole in the points", 1),
        "detection_confidence": ("Confidence that it is a building", 1),
        "n_points": ("Points", 0),
        "density_per_m2": ("Density", 1),
    },
}
"""The columns of a building that the page shows, by section: label and digits; a share is shown in percent."""


PLANES = (
    Column("building_id", TEXT, NONE, "the building", required=True),
    Column(
        "plane_id",
        INT32,
        NONE,
        "number of the plane within its building, from 0; also its material in the OBJ",
        required=True,
    ),
    Column("geometry", WKB, HORIZONTAL, "the roof face in 3D; a MultiPolygon if the plane has several"),
    Column(
        "slope_deg",
        FLOAT64,
        "deg",
        "0 is horizontal; a true angle, even if horizontal and vertical units differ",
        required=True,
    ),
    Column(
        "aspect_deg",
        FLOAT64,
        "deg",
        "direction of steepest descent, clockwise from grid north; 0 for a horizontal plane",
        required=True,
    ),
    Column("o_distance_m", FLOAT64, "m", "signed distance of the plane above the point `origin_*`", required=True),
    Column("origin_x", FLOAT64, HORIZONTAL, "easting of the local origin", required=True),
    Column("origin_y", FLOAT64, HORIZONTAL, "northing of the local origin", required=True),
    Column("origin_z", FLOAT64, VERTICAL, "elevation of the local origin", required=True),
    Column(
        "coefficients",
        FLOAT64S,
        NONE,
        "a, b, c, d of a (X - origin_x) + b (Y - origin_y) + c (Z - origin_z) + d = 0, unit normal with c > 0",
        required=True,
    ),
    Column("area_m2", FLOAT64, "m2", "true (slanted) area", required=True),
    Column("n_points", INT64, COUNT, "points that support the plane", required=True),
    Column("rmse_m", FLOAT64, "m", "root mean square of the vertical residuals of these points"),
    Column(
        "extrapolated",
        BOOL,
        NONE,
        "no point lies on the plane: it continues what lies beside it, ends a slope beyond its points, or has a height "
        "by an attribute; null in runs of versions without this column",
        page="../methods/solids.md#sides-that-were-not-seen",
    ),
)
"""One row per roof plane."""

REJECTED = (
    Column("object_id", TEXT, NONE, "made like a `building_id`", required=True),
    Column(
        "reason", TEXT, NONE, "why it is not a building, from a closed list", page="records.md#reasons", required=True
    ),
    Column("reason_detail", TEXT, NONE, "the measured figure and the threshold", required=True),
    Column("geometry", WKB, HORIZONTAL, "the box around it"),
    Column("area_m2", FLOAT64, "m2", "plan area; null if not measured"),
    Column("height_m", FLOAT64, "m", "height above ground; null if not measured"),
    Column("n_points", INT64, COUNT, "points of the object", required=True),
    Column(
        "detection_confidence",
        FLOAT64,
        SHARE,
        "probability, from 0 to 1, that this object is a building after all; null where this cannot be judged",
        page="records.md#confidence-of-a-detection",
    ),
    Column("settings_hash", TEXT, NONE, "sha256 of the settings that can change geometry", required=True),
    Column("engine_version", TEXT, NONE, "version of gablework", required=True),
)
"""One row per object that was judged not to be a building: its id is made as a building's."""

DECISIONS = (
    Column("building_id", TEXT, NONE, "the building", required=True),
    Column("step", INT32, NONE, "order of the attempts, from 0", required=True),
    Column(
        "kind",
        TEXT,
        NONE,
        "`check` (a figure and its limit), `form` (of the roof) or `level` (of detail)",
        required=True,
    ),
    Column(
        "name", TEXT, NONE, "the figure, the form or the level", page="../run_directory.md#decisions", required=True
    ),
    Column(
        "outcome",
        TEXT,
        NONE,
        "a check is `met` or `missed`; a form is `chosen`, `outdone` (another was better), `invalid` (its "
        "solids have faults), `undrawable`, or `withdrawn` (sound, but not delivered: too few points explain "
        "it, or a level of detail failed); a level is `chosen` or `undrawable`",
        required=True,
    ),
    Column("detail", TEXT, NONE, "how the form was drawn and cleaned up, or why it was refused", required=True),
    Column("value", FLOAT64, NONE, "the figure of a check"),
    Column("limit", FLOAT64, NONE, "the limit of a check, from which on it is `met`"),
    Column("n_faces", INT32, COUNT, "roof faces of a form or level that was drawn"),
    Column("n_planes", INT32, COUNT, "roof planes of a form or level that was drawn"),
    Column(
        "levelled_share",
        FLOAT64,
        SHARE,
        "share of the plan whose faces were made level, since their planes left the points",
    ),
    Column(
        "explained_share",
        FLOAT64,
        SHARE,
        "share of the roof points near the faces; only where forms were compared by it",
    ),
    Column(
        "bic_margin",
        FLOAT64,
        NONE,
        "information criterion of the form it competed with minus its own; negative where its own is higher",
    ),
    Column("validity_codes", INT32S, NONE, "codes of the faults of an `invalid` form", required=True),
)
"""One row per check, form and level of detail of each building."""


COLUMNS: Mapping[str, tuple[Column, ...]] = {
    "buildings": BUILDINGS,
    "planes": PLANES,
    "rejected": REJECTED,
    "decisions": DECISIONS,
}
"""The columns of each table, in the order of its files, without `bbox`, which only covers the geometry."""

ELEVATIONS: Mapping[str, frozenset[str]] = {
    table: frozenset(column.name for column in columns if column.unit == VERTICAL) for table, columns in COLUMNS.items()
}
"""The columns of each table that are elevations, in the vertical unit of the run's CRS."""

TILE_COLUMN = Column("tile", TEXT, NONE, "key of the tile on the lattice, such as `x85_y447`", required=True)
"""The column that the names of a run's folders hold; other formats have it as a column of its own."""


class OtherTypes(NamedTuple):
    """What a type of the tables becomes in other formats: a word for it, and what is in it."""

    geopackage: str
    """The type of SQL."""
    tiles: str
    """Type, and component or content, in a property table of 3D Tiles. Whole numbers of 64 bits become floating-point
    numbers, exact to 2^53, since JavaScript would have them as BigInt, which does not mix with numbers."""
    pmtiles: str
    """The type of a value in vector tiles; a null is a property that is not there."""
    cityjson: str
    """The type of JSON of an attribute; geometries are none."""


KINDS: Mapping[str, OtherTypes] = {
    "string": OtherTypes("TEXT", "STRING", "string", "string"),
    "bool": OtherTypes("BOOLEAN", "BOOLEAN", "bool", "boolean"),
    "int32": OtherTypes("MEDIUMINT", "SCALAR, INT32", "int", "number"),
    "int64": OtherTypes("INTEGER", "SCALAR, FLOAT64", "int", "number"),
    "double": OtherTypes("REAL", "SCALAR, FLOAT64", "double", "number"),
    "timestamp": OtherTypes("DATETIME", "STRING, ISO 8601", "string, ISO 8601", "string, ISO 8601"),
    "binary": OtherTypes("BLOB", "none", "none", "none"),
    "list": OtherTypes("TEXT", "STRING, a JSON array", "string, a JSON array", "array"),
}
"""The types of all columns by their names (`kind_of`)."""


def text_of(value: Any) -> str | None:
    """A text, a time (ISO 8601) or a list (JSON) for formats that have no type for the latter; None stays None."""
    if value is None or isinstance(value, str):
        return value
    return value.isoformat() if isinstance(value, dt.datetime) else json.dumps(value, separators=(",", ":"))


def arrow_type(word: str) -> pa.DataType:
    """The Arrow type of a word.

    >>> arrow_type(INT32S)
    ListType(list<item: int32>)
    """
    import pyarrow as pa

    if word.startswith("list "):
        return pa.list_(arrow_type(word.removeprefix("list ")))
    return pa.timestamp("us", tz="UTC") if word == TIME else pa.type_for_alias(word)


def schema_of(columns: Iterable[Column]) -> pa.Schema:
    """The Arrow schema of some columns, in their order."""
    import pyarrow as pa

    return pa.schema([pa.field(one.name, one.kind, nullable=not one.required) for one in columns])


def kind_of(kind: pa.DataType) -> str:
    """The name of a column's type in the reference and in the mappings of the formats.

    >>> [kind_of(arrow_type(word)) for word in (INT32S, TIME, FLOAT64)]
    ['list', 'timestamp', 'double']
    """
    import pyarrow as pa

    if pa.types.is_timestamp(kind):
        return "timestamp"
    return "list" if pa.types.is_list(kind) else str(kind)
