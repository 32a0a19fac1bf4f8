"""Filters in CQL2 (OGC 21-065): from the tree of a filter to a mask over rows.

The library `cql2` parses the text. A tree is checked against the columns of a table before anything is read, and
evaluated with three values: a comparison with null is neither true nor false, and selects nothing.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cql2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from service.errors import RequestError
from service.features.coordinates import Geometries, NamedCrs, in_easting_order
from service.features.row_index import Box
from service.features.tables import GEOMETRY

MAX_LENGTH = 4000
"""Longest filter, in characters."""
MAX_DEPTH = 7
"""Parentheses within parentheses of a text: the parser of the library takes a time that grows by 2.5 with each."""
MAX_NODES = 500
"""Largest number of operations in a filter."""

_COMPARISONS = {
    "=": pc.equal,
    "<>": pc.not_equal,
    "<": pc.less,
    "<=": pc.less_equal,
    ">": pc.greater,
    ">=": pc.greater_equal,
}
_SPATIAL = {
    "s_intersects": shapely.intersects,
    "s_disjoint": shapely.disjoint,
    "s_within": shapely.within,
    "s_contains": shapely.contains,
    "s_overlaps": shapely.overlaps,
    "s_touches": shapely.touches,
    "s_crosses": shapely.crosses,
    "s_equals": shapely.equals,
}
_MIRRORED = {"s_within": "s_contains", "s_contains": "s_within"}
_TYPES = {"text": pa.string(), "number": pa.float64(), "boolean": pa.bool_(), "time": pa.timestamp("us", tz="UTC")}


@dataclasses.dataclass(frozen=True)
class Rows:
    """Rows that a filter looks at."""

    columns: Mapping[str, pa.Array]
    """The columns that it names."""
    geometries: Geometries | None
    """Their geometries in the CRS of the filter; None if it does not need them."""
    n: int
    """Number of rows."""


Mask = Callable[[Rows], pa.Array]
"""Gets rows; one value per row: true, false or null."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Filter:
    """A filter that fits a table."""

    mask: Mask
    """Evaluates it."""
    columns: frozenset[str]
    """The properties that it names."""
    is_spatial: bool
    """Whether it needs geometries."""
    window: Box | None
    """Only rows with a geometry here can be selected, in its CRS, easting first; None for no such bound."""


def parsed(text: str, language: str) -> Any:
    """The tree of a filter, as CQL2 JSON.

    Raises
    ------
    RequestError
        It is not a filter, or is too long or too deep.

    Examples
    --------
    >>> parsed("status = 'ok'", "cql2-text")
    {'op': '=', 'args': [{'property': 'status'}, 'ok']}
    """
    if len(text) > MAX_LENGTH:
        raise RequestError([f"query filter has {len(text)} characters: use {MAX_LENGTH} at most"])
    if language == "cql2-json":
        try:
            return json.loads(text)
        except (json.JSONDecodeError, RecursionError) as error:
            raise RequestError([f"query filter is not JSON ({error}): send CQL2 as JSON or use cql2-text"]) from error
    _check_depth(text)
    try:
        return cql2.parse_text(text).to_json()
    except Exception as error:  # the library raises Exception itself
        raise RequestError([f"query filter is not CQL2 text: {' '.join(str(error).split())[:300]}"]) from error


def _check_depth(text: str) -> None:
    """Refuse what the library's parser would not survive: it is not written for hostile texts."""
    depth, quote = 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character in "([":
            depth += 1
            if depth > MAX_DEPTH:
                raise RequestError([f"query filter has more than {MAX_DEPTH} parentheses within one another"])
        elif character in ")]":
            depth -= 1
    words = text.lower().replace("(", " ( ").split()
    if words.count("not") > MAX_NODES // 10 or "-" * 10 in text.replace(" ", ""):
        raise RequestError([f"query filter has too many negations: use {MAX_NODES // 10} at most"])
    if depth or quote:
        raise RequestError(["query filter has a parenthesis or quote that is not closed"])


def equality(name: str, text: str, queryables: Mapping[str, str]) -> dict[str, Any]:
    """The tree of a query parameter that names a property, as in `?status=ok`.

    Raises
    ------
    RequestError
        The value is not of the property's kind.
    """
    kind = queryables[name]
    if kind == "text":
        return {"op": "=", "args": [{"property": name}, text]}
    read, example = _LITERALS[kind]
    try:
        return {"op": "=", "args": [{"property": name}, read(text)]}
    except ValueError:
        raise RequestError([f"query {name} is {text[:80]!r}: give a {kind} such as {example}"]) from None


def _number(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ValueError(text)
    return float(text)


def _boolean(text: str) -> bool:
    if text not in {"true", "false"}:
        raise ValueError(text)
    return text == "true"


def _stamp(text: str) -> dict[str, str]:
    _time(text)
    return {"timestamp": text}


_LITERALS: Mapping[str, tuple[Callable[[str], Any], str]] = {
    "number": (_number, "12.5"),
    "boolean": (_boolean, "true"),
    "time": (_stamp, "2024-03-01T09:30:00Z"),
}


def compiled(tree: Any, queryables: Mapping[str, str], crs: NamedCrs) -> Filter:
    """A filter for a table.

    Parameters
    ----------
    tree : object
        The filter as CQL2 JSON.
    queryables : mapping
        Kinds of the properties by their names.
    crs : NamedCrs
        The CRS of coordinates in the filter.

    Raises
    ------
    RequestError
        It names something unknown, or compares what cannot be compared.
    """
    compiler = _Compiler(queryables, crs)
    mask = compiler.condition(tree)
    return Filter(
        mask=mask,
        columns=frozenset(compiler.columns),
        is_spatial=compiler.is_spatial,
        window=compiler.window(tree),
    )


def _fault(problem: str) -> RequestError:
    return RequestError([f"query filter: {problem}"])


def _shown(node: Any) -> str:
    return json.dumps(node, ensure_ascii=True)[:80]


class _Compiler:
    """Turns a tree into a mask, and notes what it needs."""

    def __init__(self, queryables: Mapping[str, str], crs: NamedCrs) -> None:
        self._queryables = queryables
        self._crs = crs
        self._nodes = 0
        self.columns: set[str] = set()
        self.is_spatial = False

    def condition(self, node: Any, depth: int = 0) -> Mask:
        """An expression that is true, false or null for each row."""
        self._nodes += 1
        if self._nodes > MAX_NODES or depth > MAX_NODES // 5:
            raise _fault(f"it has more than {MAX_NODES} operations, or too many within one another")
        if isinstance(node, bool):
            return lambda rows: pa.repeat(pa.scalar(node), rows.n)
        if isinstance(node, Mapping) and "property" in node:
            kind, value = self._operand(node)
            if kind != "boolean":
                raise _fault(f"{_shown(node)} is a {kind}, not a condition: compare it")
            return value
        operation, args = self._operation(node)
        if operation in {"and", "or"} and len(args) >= 2:
            parts = [self.condition(arg, depth + 1) for arg in args]
            join = pc.and_kleene if operation == "and" else pc.or_kleene

            def joined(rows: Rows) -> pa.Array:
                found = parts[0](rows)
                for part in parts[1:]:
                    found = join(found, part(rows))
                return found

            return joined
        if operation == "not" and len(args) == 1:
            inner = self.condition(args[0], depth + 1)
            return lambda rows: pc.invert(inner(rows))
        return self._test(operation, args)

    def _operation(self, node: Any) -> tuple[str, list[Any]]:
        if not (isinstance(node, Mapping) and isinstance(node.get("op"), str) and isinstance(node.get("args"), list)):
            raise _fault(f"{_shown(node)} is not a condition: use a comparison such as status = 'ok'")
        return node["op"].lower() if node["op"] != "isNull" else "isNull", node["args"]

    def _test(self, operation: str, args: Sequence[Any]) -> Mask:
        """A condition without conditions in it."""
        if operation in _COMPARISONS and len(args) == 2:
            compare = _COMPARISONS[operation]
            left, right = self._alike(args)
            return lambda rows: compare(left(rows), right(rows))
        if operation == "between" and len(args) == 3:
            value, low, high = self._alike(args)
            return lambda rows: pc.and_kleene(
                pc.greater_equal(value(rows), low(rows)), pc.less_equal(value(rows), high(rows))
            )
        if operation == "in" and len(args) == 2 and isinstance(args[1], list) and args[1]:
            value, *listed = self._alike([args[0], *args[1]])

            def among(rows: Rows) -> pa.Array:
                one = value(rows)
                found = pc.equal(one, listed[0](rows))
                for other in listed[1:]:
                    found = pc.or_kleene(found, pc.equal(one, other(rows)))
                return found

            return among
        if operation == "like" and len(args) == 2 and isinstance(args[1], str):
            kind, value = self._operand(args[0])
            if kind != "text":
                raise _fault(f"{_shown(args[0])} is a {kind}: LIKE compares texts")
            pattern = args[1]
            return lambda rows: pc.match_like(value(rows), pattern)
        if operation == "isNull" and len(args) == 1:
            if args[0] == {"property": GEOMETRY}:
                self.is_spatial = True
                return lambda rows: pa.array(shapely.is_missing(_geometries(rows)))
            _, value = self._operand(args[0])
            return lambda rows: pc.is_null(value(rows))
        if operation in _SPATIAL and len(args) == 2:
            return self._spatial(operation, args)
        known = ", ".join(["and", "or", "not", *_COMPARISONS, "between", "in", "like", "isNull", *_SPATIAL])
        raise _fault(f"{operation[:40]!r} with {len(args)} arguments is not supported: use {known}")

    def _alike(self, args: Sequence[Any]) -> list[Mask]:
        """Operands that can be compared."""
        operands = [self._operand(arg) for arg in args]
        kinds = {kind for kind, _ in operands}
        if len(kinds) > 1:
            shown = " and ".join(f"{_shown(arg)} (a {kind})" for arg, (kind, _) in zip(args, operands, strict=True))
            raise _fault(f"{shown[:300]} cannot be compared: give values of one kind")
        return [value for _, value in operands]

    def _operand(self, node: Any) -> tuple[str, Mask]:
        """Kind and values of a property or a literal."""
        if isinstance(node, Mapping) and isinstance(node.get("property"), str):
            name = node["property"]
            if name not in self._queryables:
                known = ", ".join([*self._queryables, GEOMETRY])
                raise _fault(f"{name[:80]!r} is not a property that can be used here: use one of {known}")
            self.columns.add(name)
            kind = self._queryables[name]
            return kind, lambda rows: pc.cast(rows.columns[name], _TYPES[kind])
        kind, value = self._literal(node)
        constant = pa.scalar(value, _TYPES[kind])
        return kind, lambda rows: pa.repeat(constant, rows.n)

    @staticmethod
    def _literal(node: Any) -> tuple[str, Any]:
        if isinstance(node, bool):
            return "boolean", node
        if isinstance(node, int | float) and math.isfinite(node):
            return "number", float(node)
        if isinstance(node, str):
            return "text", node
        if isinstance(node, Mapping) and len(node) == 1:
            ((word, text),) = node.items()
            if word in {"timestamp", "date"} and isinstance(text, str):
                try:
                    return "time", _time(text)
                except ValueError:
                    raise _fault(f"{text[:80]!r} is not a time: use one such as 2024-03-01T09:30:00Z") from None
        raise _fault(f"{_shown(node)} is not supported here: use a property, a text, a number, true, false or a time")

    def _spatial(self, operation: str, args: Sequence[Any]) -> Mask:
        if args[0] != {"property": GEOMETRY}:
            args, operation = [args[1], args[0]], _MIRRORED.get(operation, operation)
        if args[0] != {"property": GEOMETRY}:
            raise _fault(
                f"{operation} compares the property {GEOMETRY} with a geometry, and {_shown(args[0])} is not it"
            )
        geometry = self._geometry(args[1])
        shapely.prepare(geometry)
        self.is_spatial = True
        test = _SPATIAL[operation]

        def related(rows: Rows) -> pa.Array:
            found = _geometries(rows)
            return pa.array(test(found, geometry), mask=shapely.is_missing(found))

        return related

    def _geometry(self, node: Any) -> shapely.Geometry:
        """A geometry of the filter, easting first."""
        try:
            if isinstance(node, Mapping) and "bbox" in node:
                low, high = node["bbox"][:2], node["bbox"][len(node["bbox"]) // 2 :][:2]
                geometry = shapely.box(*low, *high)
            else:
                geometry = shapely.from_geojson(json.dumps(node))
        except (shapely.GEOSException, TypeError, ValueError):
            raise _fault(f"{_shown(node)} is not a geometry: use WKT such as POINT(4.35 52.01), or BBOX") from None
        if geometry.is_empty or not np.isfinite(shapely.bounds(geometry)).all() or not geometry.is_valid:
            raise _fault(f"{_shown(node)} is not a valid geometry: {shapely.is_valid_reason(geometry)[:120]}")
        return in_easting_order(shapely.force_2d(geometry), self._crs)

    def window(self, node: Any) -> Box | None:
        """Bounds within which all selected geometries reach, from spatial conditions that must hold."""
        if not (isinstance(node, Mapping) and isinstance(node.get("args"), list)):
            return None
        if node.get("op") == "and":
            found = [box for box in map(self.window, node["args"]) if box is not None]
            return found[0] if found else None
        if node.get("op") in _SPATIAL and node["op"] != "s_disjoint":
            literal = next(arg for arg in node["args"] if arg != {"property": GEOMETRY})
            west, south, east, north = shapely.bounds(self._geometry(literal))
            return float(west), float(south), float(east), float(north)
        return None


def _geometries(rows: Rows) -> Geometries:
    assert rows.geometries is not None
    return rows.geometries


def _time(text: str) -> dt.datetime:
    at = dt.datetime.fromisoformat(text)
    return at if at.tzinfo is not None else at.replace(tzinfo=dt.UTC)
