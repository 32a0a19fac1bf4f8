"""Building footprints from GeoPackage, GeoJSON, Shapefile or GeoParquet, in metres of the run's CRS."""

from __future__ import annotations

import dataclasses
import datetime as dt
import decimal
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import EmptyInputError, InconsistentInputError, UnreadableInputError
from pipeline.extras.footprints.placed_features import boxes_around, in_metres, left_out, usable, within
from pipeline.extras.footprints.repairs import EDGES_LIMIT, LOOKS_OF_FILE, Repairs, crossings
from pipeline.extras.vector_files.nearby import AREAS, POLYGONS, Elsewhere, Shape
from pipeline.extras.vector_files.vector_layer import read_layer
from pipeline.io.crs import LARGEST_COORDINATE, SpatialReference
from pipeline.io.locations import shown

ID_COLUMNS = (
    "building_id",
    "source_id",
    "identificatie",
    "gml_id",
    "bgt_id",
    "bag_id",
    "osm_id",
    "cleabs",
    "id",
    "globalid",
    "uuid",
    "fid",
    "ogc_fid",
    "objectid",
)
"""Columns that hold a building's own id. The first one without gaps and repeats counts, else the one with fewest."""

LARGEST_OUTLINE_M = 20_000.0
"""Longest side of an outline. Not a setting: the longest buildings have 3 km, and a wrong coordinate makes an outline
that reaches over thousands of tiles."""
_LEAST_DISTINCT = 0.5
"""Smallest share of rows that a column of ids must distinguish: some programs add one of zeros."""
AREA_CROSSINGS = 1_000_000
"""Maximum number of crossings between the edges of an area of interest; uniting more takes a minute and gigabytes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FootprintIssue:
    """What was wrong with one feature, and what was done."""

    feature: int
    """The file's own number of the feature."""
    source_id: str
    """Its own id."""
    problem: str
    """One of `PROBLEMS`."""
    detail: str
    """The fault in words, with its place in metres of the run's CRS."""
    action: str
    """`left out`, or to what it was repaired."""
    bounds_m: tuple[float, ...] | None = None
    """xmin, ymin, xmax, ymax in metres of the run's CRS; None where it has no such place."""

    def __str__(self) -> str:
        """The issue as a sentence."""
        return f"footprint {self.source_id}: {self.detail}: {self.action}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footprints:
    """Given outlines of buildings. All tuples have one length."""

    ids: tuple[str, ...]
    """The buildings' own ids; several have one where the file says so."""
    polygons: tuple[Polygon | MultiPolygon, ...]
    """2D, valid, in metres of the run's CRS."""
    attributes: tuple[dict[str, Any], ...]
    """All columns by name, as JSON knows values, dates as ISO 8601; None where empty."""
    features: tuple[int, ...] = ()
    """The file's own numbers of the features; empty if they were not read from a file."""
    columns: tuple[str, ...] = ()
    """Names of the file's columns, also if no footprint is kept."""
    warnings: tuple[str, ...] = ()
    """What was repaired, left out or assumed, one sentence each."""
    issues: tuple[FootprintIssue, ...] = ()
    """Every feature that was repaired or left out, in the file's order."""
    elsewhere: Elsewhere = dataclasses.field(default_factory=Elsewhere)
    """Polygons of the file that were passed over."""

    def __len__(self) -> int:
        """Number of footprints."""
        return len(self.ids)


def read_footprints(
    path: str | Path,
    reference: SpatialReference,
    *,
    layer: str | None = None,
    id_column: str | None = None,
    crs: str | None = None,
    area: shapely.Geometry | None = None,
    largest_m: float = LARGEST_OUTLINE_M,
    shape: Shape = POLYGONS,
) -> Footprints:
    """Footprints of a vector file, reprojected where its CRS is not the run's.

    A feature that cannot be used stops nothing: it is left out or repaired, and listed among the issues.

    Parameters
    ----------
    path : str or Path
        Path or URL of a GeoPackage, GeoJSON (WGS 84 unless it says otherwise), Shapefile or GeoParquet.
    layer : str, optional
        The layer; needed where a file has several with polygons. Of GeoParquet the geometry column.
    id_column : str, optional
        The column of ids; None to look for the common names, then for the file's own feature id.
    crs : str, optional
        Overrides the file's CRS.
    largest_m : float
        Size in metres above which a polygon is left out.
    shape : Shape
        What the polygons are to the reader of a message.
    area : Geometry, optional
        Where footprints are wanted, in metres of the run's CRS. Of a file that covers a country all others are passed
        over unread, but for features whose place is not known. The boxes around its parts decide, 100 m wider: who
        needs its very border cuts there. Whether an id column is usable is decided by the features that were read.

    Raises
    ------
    UnreadableInputError
        If the file cannot be read as vector data, or the layer or column is not there.
    InconsistentInputError
        If the ids of a named column are empty or not unique.
    EmptyInputError
        If it has no polygons that can be used, wherever they lie.
    CrsError
        If its coordinates are degrees and the run's CRS is unknown, or a CRS is not understood.
    """
    name = shown(str(path))
    warnings: list[str] = []

    def boxes(own: str | None) -> npt.NDArray[np.float64] | None:
        return None if area is None else boxes_around(area, own if crs is None else crs, reference, name)

    found = read_layer(path, layer, None if area is None else boxes, shape)
    warnings += found.warnings
    problems: dict[int, tuple[str, str]] = {}
    actions: dict[int, str] = {}
    geometries = usable(found, POLYGONS, problems)
    kept = np.flatnonzero(~shapely.is_missing(geometries))
    if len(kept) == 0 and not found.elsewhere.count:
        lost = f"none of the {len(found.geometries)} features is a polygon"
        raise EmptyInputError(name, lost, "Give polygons of buildings")
    polygons = shapely.force_2d(geometries[kept])
    polygons = in_metres(name, shape.named, polygons, found.crs if crs is None else crs, reference, warnings)
    whole = within(polygons, LARGEST_COORDINATE)
    for row in kept[~whole].tolist():
        problems[row] = ("outside_crs", "it cannot be reprojected to the run's CRS")
    polygons, kept = polygons[whole], kept[whole]
    small = _small_enough(polygons, kept, problems, largest_m)
    polygons, kept = polygons[small], kept[small]
    places = {int(row): tuple(bounds) for row, bounds in zip(kept, shapely.bounds(polygons).tolist(), strict=True)}
    polygons = _repaired(polygons, kept, problems, actions)
    solid = ~shapely.is_empty(polygons)
    polygons, kept = polygons[solid], kept[solid]
    if len(kept) == 0 and not found.elsewhere.count:
        size = f" of at most {largest_m:g} m" if len(small) > small.sum() else ""
        raise EmptyInputError(name, f"no polygon{size} has an area", "Give polygons of buildings")
    table = {field: [_plain(value) for value in column] for field, column in found.columns.items()}
    ids_of_all = _ids(name, table, found.feature_ids, kept, id_column, warnings)
    issues = tuple(
        FootprintIssue(
            feature=int(found.feature_ids[row]),
            source_id=ids_of_all[row],
            problem=problem,
            detail=detail,
            action=actions.get(row, "left out"),
            bounds_m=places.get(row),
        )
        for row, (problem, detail) in sorted(problems.items())
    )
    return Footprints(
        ids=tuple(ids_of_all[row] for row in kept),
        polygons=tuple(polygons.tolist()),
        attributes=tuple({field: table[field][row] for field in table} for row in kept.tolist()),
        features=tuple(found.feature_ids[kept].tolist()),
        columns=tuple(found.columns),
        warnings=(*warnings, *_summary(issues)),
        issues=issues,
        elsewhere=found.elsewhere if crs is None else dataclasses.replace(found.elsewhere, crs=crs),
    )


def _small_enough(
    polygons: npt.NDArray[np.object_],
    rows: npt.NDArray[np.int64],
    problems: dict[int, tuple[str, str]],
    largest_m: float,
) -> npt.NDArray[np.bool_]:
    """(n,) bool, whether polygons are of a possible size; the others are entered as problems."""
    bounds = shapely.bounds(polygons).reshape(-1, 4)
    sides = (bounds[:, 2:] - bounds[:, :2]).max(axis=1, initial=0.0)
    wide = sides > largest_m
    for row, side in zip(rows[wide].tolist(), sides[wide].tolist(), strict=True):
        problems[row] = ("too_large", f"it is {side:.6g} m wide or long, more than {largest_m:g} m")
    small: npt.NDArray[np.bool_] = ~wide
    return small


def _summary(issues: Sequence[FootprintIssue]) -> list[str]:
    """What was left out and repaired, in one sentence each."""
    lost = [issue.problem for issue in issues if issue.action == "left out"]
    n_repaired = len(issues) - len(lost)
    repaired = [f"{n_repaired} footprints are invalid and were repaired"] if n_repaired else []
    return [*left_out(lost, "features"), *repaired]


def _repaired(
    polygons: npt.NDArray[np.object_],
    rows: npt.NDArray[np.int64],
    problems: dict[int, tuple[str, str]],
    actions: dict[int, str],
) -> npt.NDArray[np.object_]:
    """Valid polygons; what a repair leaves of lines and points is left out, and what cannot be repaired is empty."""
    repaired = polygons.copy()
    repairs = Repairs()
    for at in np.flatnonzero(~shapely.is_valid(polygons)).tolist():
        areas = repairs.of(polygons[at])
        repaired[at] = areas[0] if areas and len(areas) == 1 else MultiPolygon(areas or [])
        row = int(rows[at])
        fault = str(shapely.is_valid_reason(polygons[at]))
        if areas is None:
            corners = int(shapely.get_num_coordinates(polygons[at]))
            problems[row] = (
                "tangled",
                f"{fault}; the edges between its {corners} corners cross too often to repair it",
            )
        elif areas:
            problems[row] = ("invalid", fault)
            shape = "one polygon" if len(areas) == 1 else f"{len(areas)} polygons"
            actions[row] = f"repaired to {shape} of {repaired[at].area:.1f} m2"
        else:
            problems[row] = ("no_area", f"{fault}; no area is left of it")
    return repaired


def _ids(
    name: str,
    table: dict[str, list[Any]],
    feature_ids: npt.NDArray[np.int64],
    kept: npt.NDArray[np.int64],
    id_column: str | None,
    warnings: list[str],
) -> tuple[str, ...]:
    """The ids of all rows: of a column, with the file's own number of the feature where it is empty, else that number.

    A column that distinguishes most of the rows that are kept is taken as it is, with a warning.
    """
    by_lower = {field.lower(): field for field in reversed(list(table))}
    if id_column is not None and id_column not in table:
        raise UnreadableInputError(
            name, f"column {id_column!r} is not there", f"Name one of the columns {', '.join(table) or '(none)'}"
        )
    common = [by_lower[one] for one in ID_COLUMNS if one in by_lower]
    single = {
        field: _single([table[field][row] for row in kept]) for field in (common if not id_column else [id_column])
    }
    if id_column is not None and single[id_column] < len(kept):
        raise InconsistentInputError(
            name, f"the ids in column {id_column!r} are empty or not unique", "Name another column, or none"
        )
    # the first of those that distinguish most
    chosen = max(single, key=lambda field: single[field], default=None)
    if chosen is not None and single[chosen] < _LEAST_DISTINCT * len(kept):
        chosen = None
    if chosen is not None and single[chosen] < len(kept):
        warnings.append(_repeated(chosen, [table[chosen][row] for row in kept]))
    own = [None] * len(feature_ids) if chosen is None else table[chosen]
    return tuple(
        str(int(number)) if value in (None, "") else str(value) for value, number in zip(own, feature_ids, strict=True)
    )


def _single(values: list[Any]) -> int:
    """How many of some values are whole numbers or text that no other one repeats; 0 where there are other values."""
    if not all(value is None or isinstance(value, int | str) for value in values):
        return 0
    return sum(count == 1 for value, count in Counter(map(str, values)).items() if value not in ("None", ""))


def _repeated(column: str, values: list[Any]) -> str:
    """The warning about ids that are empty or repeated."""
    counts = Counter("" if value is None else str(value) for value in values)
    empty = counts.pop("", 0)
    repeated = [f"{value!r} {count} times" for value, count in counts.items() if count > 1]
    found = [f"is empty {empty} times"] if empty else []
    if repeated:
        more = f" and {len(repeated) - 3} more" if len(repeated) > 3 else ""
        found.append(f"holds {', '.join(repeated[:3])}{more}")
    return f"column {column!r} {' and '.join(found)}: source_id is what it says, or else the number of the feature"


def _plain(value: Any) -> Any:
    """A value as JSON knows it: None for what is empty or no value there, ISO 8601 for dates."""
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else str(value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, dt.date | dt.time):
        return value.isoformat()
    if isinstance(value, decimal.Decimal):
        return float(value) if value.is_finite() else None
    return value if value is None or isinstance(value, bool | int | str) else None


def read_area(path: str | Path, reference: SpatialReference) -> Polygon | MultiPolygon:
    """The area of interest that the polygons of a vector file cover together, in the units of the run's CRS."""
    found = read_footprints(path, reference, largest_m=math.inf, shape=AREAS)
    for issue in found.issues:
        # an area without one of its parts is another area
        if issue.problem == "tangled":
            raise InconsistentInputError(shown(str(path)), f"feature {issue.feature}: {issue.detail}", "Draw it anew")
    polygons = list(found.polygons)
    count = crossings(shapely.get_rings(shapely.get_parts(polygons)), LOOKS_OF_FILE, only_proper=True)
    if count is None:
        raise InconsistentInputError(
            shown(str(path)),
            f"its {len(polygons)} polygons have more than {EDGES_LIMIT} edges, or too many that lie over each other",
            "Dissolve them into one area first, or draw it with fewer corners",
        )
    if count.crossings > AREA_CROSSINGS:
        raise InconsistentInputError(
            shown(str(path)),
            f"its {len(polygons)} polygons cross each other in more than {AREA_CROSSINGS} places",
            "Dissolve them into one area first",
        )
    united = shapely.union_all(polygons)
    if reference.horizontal_unit_m != 1.0:
        united = shapely.transform(united, lambda xy: xy / reference.horizontal_unit_m)
    assert isinstance(united, Polygon | MultiPolygon)
    return united
