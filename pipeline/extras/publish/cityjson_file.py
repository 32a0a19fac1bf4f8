"""One CityJSON 2.0 file of the lines of a CityJSONSeq file: for tools that do not read sequences."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.errors import RunError
from pipeline.export.cityjson import lines_of
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.extras.publish.finished_run import (
    SEQUENCES,
    FinishedRun,
    Published,
    new_files,
    path_outside,
    sequences_of,
)
from pipeline.io import storage_at
from pipeline.runtime.monitoring.progress import Event, Listener, ignore

SUFFIX = ".city.json"
"""Ending of the files."""


def city_of(*sequences: Iterable[str]) -> dict[str, Any]:
    """The object of a CityJSON file with all features of some sequences, in their order; each vertex is listed once.

    The metadata are those of the first sequence, with the extent of all. Raises ValueError if the first line of one is
    not the metadata, or if their CRS or steps differ.

    >>> feature = {"type": "CityJSONFeature", "CityObjects": {"b": {"type": "Building"}}, "vertices": [[1, 2, 3]]}
    >>> city_of(['{"type": "CityJSON", "CityObjects": {}, "vertices": []}', json.dumps(feature)])["vertices"]
    [[1, 2, 3]]
    """
    city: dict[str, Any] | None = None
    number: dict[tuple[int, int, int], int] = {}
    for lines in sequences:
        remaining = iter(lines)
        heading: dict[str, Any] | None = next((json.loads(line) for line in remaining), None)
        if heading is None or heading.get("type") != "CityJSON":
            raise ValueError("the first line is not the metadata of a CityJSONSeq file")
        city = heading if city is None else city
        away = _between(city, heading)
        for line in remaining:
            feature = json.loads(line)
            vertices = (
                tuple(value + by for value, by in zip(vertex, away, strict=True)) for vertex in feature["vertices"]
            )
            places = [number.setdefault(vertex, len(number)) for vertex in vertices]
            for name, thing in feature["CityObjects"].items():
                for geometry in thing.get("geometry", ()):
                    geometry["boundaries"] = _renumbered(geometry["boundaries"], places)
                city["CityObjects"][name] = thing
    if city is None:
        raise ValueError("there is no sequence")
    city["vertices"] = [list(vertex) for vertex in number]
    return city


def _between(first: dict[str, Any], other: dict[str, Any]) -> list[int]:
    """Steps from the origin of the first sequence to that of another, whose extent joins that of the first."""
    if first is other:
        return [0, 0, 0]
    names = [heading.get("metadata", {}).get("referenceSystem") for heading in (first, other)]
    one, two = first["transform"], other["transform"]
    if one["scale"] != two["scale"] or names[0] != names[1]:
        raise ValueError("the sequences differ in CRS or scale")
    held, more = (heading.get("metadata", {}).get("geographicalExtent") for heading in (first, other))
    if more is not None:
        low, high = [*map(min, held or more, more)][:3], [*map(max, held or more, more)][3:]
        first.setdefault("metadata", {})["geographicalExtent"] = low + high
    # origins are whole units
    return [round((b - a) / step) for a, b, step in zip(one["translate"], two["translate"], one["scale"], strict=True)]


def _renumbered(boundaries: list[Any], places: list[int]) -> list[Any]:
    """Boundaries with other numbers of their vertices, however deep they are nested."""
    return [_renumbered(part, places) if isinstance(part, list) else places[part] for part in boundaries]


def publish_cityjson(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write `<tile>.city.json` of each tile, with its terrain if any; parameters and errors as in `publishing.Form`."""
    target = path_outside(run_dir, out)
    run = FinishedRun.at(run_dir, {SEQUENCES})
    sequences, terrains = sequences_of(run_dir), sequences_of(run_dir, TERRAIN_FOLDER)
    keys = {
        f"{tile}{SUFFIX}": [found[tile] for found in (sequences, terrains) if tile in found]
        for tile in sorted({*sequences, *terrains})
    }
    buildings = size = 0
    with new_files(target, overwrite, keys, lambda: target.glob(f"*{SUFFIX}")) as made:
        for done, (name, of_tile) in enumerate(keys.items(), start=1):
            city = _city(run_dir, of_tile)
            buildings += sum(thing["type"] == "Building" for thing in city["CityObjects"].values())
            content = json.dumps(city, separators=(",", ":"), ensure_ascii=False).encode()
            made.put(name, content)
            size += len(content)
            on_event(Event(kind="progress", stage=SEQUENCES, done=done, total=len(keys)))
        run.check({"buildings": buildings})
    return Published(place=str(target), size_bytes=size, rows={"buildings": buildings})


def _city(run_dir: str, keys: Sequence[str]) -> dict[str, Any]:
    """The CityJSON object of the sequences of one tile; raises RunError if a file is damaged."""
    sequences = [lines_of(storage_at(run_dir).get(key).decode()) for key in keys]
    try:
        return city_of(*sequences)
    except (ValueError, KeyError, TypeError) as fault:
        raise RunError(f"{keys[0]} of the run in {run_dir} is damaged ({str(fault)[:160]}): run it again") from fault
