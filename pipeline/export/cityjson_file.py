"""One CityJSON 2.0 file of the lines of a CityJSONSeq file: for tools that do not read sequences."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any


def city_of(lines: Iterable[str]) -> dict[str, Any]:
    """The object of a CityJSON file with all features of a sequence, in their order; each vertex is listed once.

    Raises ValueError if the first line is not the metadata.

    >>> feature = {"type": "CityJSONFeature", "CityObjects": {"b": {"type": "Building"}}, "vertices": [[1, 2, 3]]}
    >>> city_of(['{"type": "CityJSON", "CityObjects": {}, "vertices": []}', json.dumps(feature)])["vertices"]
    [[1, 2, 3]]
    """
    remaining = iter(lines)
    city: dict[str, Any] | None = next((json.loads(line) for line in remaining), None)
    if city is None or city.get("type") != "CityJSON":
        raise ValueError("the first line is not the metadata of a CityJSONSeq file")
    number: dict[tuple[int, ...], int] = {}
    for line in remaining:
        feature = json.loads(line)
        places = [number.setdefault(tuple(vertex), len(number)) for vertex in feature["vertices"]]
        for name, thing in feature["CityObjects"].items():
            for geometry in thing.get("geometry", ()):
                geometry["boundaries"] = _renumbered(geometry["boundaries"], places)
            city["CityObjects"][name] = thing
    city["vertices"] = [list(vertex) for vertex in number]
    return city


def _renumbered(boundaries: list[Any], places: list[int]) -> list[Any]:
    """Boundaries with other numbers of their vertices, however deep they are nested."""
    return [_renumbered(part, places) if isinstance(part, list) else places[part] for part in boundaries]
