"""Filters in CQL2 (OGC 21-065): from the tree of a filter to a condition in SQL.

The library `cql2` parses the text. The SQL that it writes is PostgreSQL's: SQLite knows neither `SOME(ARRAY[..])` nor
`E'..'` nor its times and spatial functions, and a comparison of a number with a text would pass. So a tree is checked
against the columns of a table here, and becomes SQL with placeholders for all values.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cql2
import numpy as np
import shapely

from service.errors import RequestError
from service.features.feature_crs import NamedCrs, in_easting_order
from service.features.index import Box, stamp
from service.features.pages import GEOMETRY, Condition, ShapeTest

MAX_LENGTH = 4000
"""Longest filter, in characters."""
MAX_DEPTH = 7
"""Parentheses within parentheses of a text: the parser of the library takes a time that grows by 2.5 with each."""
MAX_NODES = 500
"""Largest number of operations in a filter."""
MAX_NESTED = 25
"""Conditions within conditions: SQLite's parser has a stack of 100 symbols."""

_COMPARISONS = frozenset({"=", "<>", "<", "<=", ">", ">="})
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
_GEOMETRY = {"property": GEOMETRY}
_MIRRORED = {"s_within": "s_contains", "s_contains": "s_within"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Filter(Condition):
    """A filter that fits a table."""

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


def compiled(tree: Any, queryables: Mapping[str, str], crs: NamedCrs, shapes: list[ShapeTest]) -> Filter:
    """A filter for a table.

    Parameters
    ----------
    tree : object
        The filter as CQL2 JSON.
    queryables : mapping
        Kinds of the properties by their names.
    crs : NamedCrs
        The CRS of coordinates in the filter.
    shapes : list of ShapeTest
        Gets the tests of geometries, which the condition names by their numbers.

    Raises
    ------
    RequestError
        It names something unknown, or compares what cannot be compared.
    """
    compiler = _Compiler(queryables, crs, shapes)
    sql = compiler.condition(tree)
    return Filter(sql=sql, values=tuple(compiler.values), window=compiler.window(tree))


def _fault(problem: str) -> RequestError:
    return RequestError([f"query filter: {problem}"])


def _shown(node: Any) -> str:
    return json.dumps(node, ensure_ascii=True)[:80]


class _Compiler:
    """Turns a tree into SQL, with its values in the order of their places."""

    def __init__(self, queryables: Mapping[str, str], crs: NamedCrs, shapes: list[ShapeTest]) -> None:
        self._queryables = queryables
        self._crs = crs
        self._shapes = shapes
        self._nodes = 0
        self.values: list[Any] = []

    def condition(self, node: Any, depth: int = 0) -> str:
        """An expression that is true, false or null for each row."""
        self._nodes += 1
        if self._nodes > MAX_NODES or depth > MAX_NESTED:
            raise _fault(f"it has more than {MAX_NODES} operations, or too many within one another")
        if isinstance(node, bool) or (isinstance(node, Mapping) and "property" in node):
            kind, value = self._operand(node)
            if kind != "boolean":
                raise _fault(f"{_shown(node)} is a {kind}, not a condition: compare it")
            return value
        if not (isinstance(node, Mapping) and isinstance(node.get("op"), str) and isinstance(node.get("args"), list)):
            raise _fault(f"{_shown(node)} is not a condition: use a comparison such as status = 'ok'")
        operation, args = node["op"].lower(), node["args"]
        if operation in {"and", "or"} and len(args) >= 2:
            return f"({f' {operation} '.join(self.condition(arg, depth + 1) for arg in args)})"
        if operation == "not" and len(args) == 1:
            return f"(not {self.condition(args[0], depth + 1)})"
        return f"({self._test(operation, args)})"

    def _test(self, operation: str, args: Sequence[Any]) -> str:
        """A condition without conditions in it."""
        if operation in _COMPARISONS and len(args) == 2:
            left, right = self._alike(args)
            return f"{left} {operation} {right}"
        if operation == "between" and len(args) == 3:
            value, low, high = self._alike(args)
            return f"{value} between {low} and {high}"
        if operation == "in" and len(args) == 2 and isinstance(args[1], list) and args[1]:
            value, *listed = self._alike([args[0], *args[1]])
            return f"{value} in ({', '.join(listed)})"
        if operation == "like" and len(args) == 2 and isinstance(args[1], str):
            kind, value = self._operand(args[0])
            if kind != "text":
                raise _fault(f"{_shown(args[0])} is a {kind}: LIKE compares texts")
            return f"{value} like {self._literal(args[1])[1]} escape '\\'"
        if operation == "isnull" and len(args) == 1:
            return f"{GEOMETRY if args[0] == _GEOMETRY else self._operand(args[0])[1]} is null"
        if operation in _SPATIAL and len(args) == 2:
            return self._spatial(operation, args)
        known = ", ".join(["and", "or", "not", *sorted(_COMPARISONS), "between", "in", "like", "isNull", *_SPATIAL])
        raise _fault(f"{operation[:40]!r} with {len(args)} arguments is not supported: use {known}")

    def _alike(self, args: Sequence[Any]) -> list[str]:
        """Operands that can be compared."""
        operands = [self._operand(arg) for arg in args]
        kinds = {kind for kind, _ in operands}
        if len(kinds) > 1:
            shown = " and ".join(f"{_shown(arg)} (a {kind})" for arg, (kind, _) in zip(args, operands, strict=True))
            raise _fault(f"{shown[:300]} cannot be compared: give values of one kind")
        return [value for _, value in operands]

    def _operand(self, node: Any) -> tuple[str, str]:
        """Kind and SQL of a property or a literal."""
        if isinstance(node, Mapping) and isinstance(node.get("property"), str):
            name = node["property"]
            if name not in self._queryables:
                known = ", ".join([*self._queryables, GEOMETRY])
                raise _fault(f"{name[:80]!r} is not a property that can be used here: use one of {known}")
            return self._queryables[name], f'"{name}"'
        return self._literal(node)

    def _literal(self, node: Any) -> tuple[str, str]:
        kind, value = self._value(node)
        self.values.append(value)
        return kind, "?"

    @staticmethod
    def _value(node: Any) -> tuple[str, Any]:
        """Kind and value of a literal."""
        if isinstance(node, bool):
            return "boolean", node
        if isinstance(node, int | float) and abs(node) <= sys.float_info.max:
            return "number", float(node)
        if isinstance(node, str) and node.encode(errors="ignore").decode() == node:  # no half of a pair
            return "text", node
        if isinstance(node, Mapping) and len(node) == 1:
            ((word, text),) = node.items()
            if word in {"timestamp", "date"} and isinstance(text, str):
                try:
                    return "time", _time(text)
                except ValueError:
                    raise _fault(f"{text[:80]!r} is not a time: use one such as 2024-03-01T09:30:00Z") from None
        raise _fault(f"{_shown(node)} is not supported here: use a property, a text, a number, true, false or a time")

    def _spatial(self, operation: str, args: Sequence[Any]) -> str:
        if args[0] != _GEOMETRY:
            args, operation = [args[1], args[0]], _MIRRORED.get(operation, operation)
        if args[0] != _GEOMETRY:
            raise _fault(
                f"{operation} compares the property {GEOMETRY} with a geometry, and {_shown(args[0])} is not it"
            )
        geometry = self._geometry(args[1])
        shapely.prepare(geometry)
        test = _SPATIAL[operation]
        self._shapes.append(ShapeTest(crs=self._crs, test=lambda shapes: test(shapes, geometry)))
        return f"shape({len(self._shapes) - 1}, position)"

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
            literal = next(arg for arg in node["args"] if arg != _GEOMETRY)
            west, south, east, north = shapely.bounds(self._geometry(literal))
            return float(west), float(south), float(east), float(north)
        return None


def _time(text: str) -> str:
    at = dt.datetime.fromisoformat(text)
    try:
        return stamp(at if at.tzinfo is not None else at.replace(tzinfo=dt.UTC))
    except OverflowError as error:
        raise ValueError(text) from error
