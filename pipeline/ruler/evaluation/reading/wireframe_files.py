"""True roof wireframes: vertices and edges that people drew, from JSON or from OBJ with `l` lines."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import EmptyInputError, InputError, UnreadableInputError
from pipeline.model import FloatArray, IntArray
from pipeline.ruler.evaluation.reading.raw import FARTHEST_M

_ENDINGS = (".json", ".obj")
_FORMATS = "JSON {id: {v: [[x, y, z], ...], e: [[i, j], ...]}}, an OBJ with `l` lines, or a folder of OBJ files"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wireframe:
    """The roof edges of one building."""

    building_id: str
    vertices: FloatArray
    """(v, 3) float64, metres."""
    edges: IntArray
    """(e, 2) int64, the two vertices of each edge; never the same one twice."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WireframeSet:
    """The wireframes of a file."""

    name: str
    """Name of the file in the report."""
    wireframes: tuple[Wireframe, ...]
    """Sorted by building_id, each with at least one edge."""
    notes: tuple[str, ...] = ()
    """Omissions of the reader, as sentences for the report."""


def read_wireframes(path: str | Path) -> WireframeSet:
    """The wireframes of a file or folder, in metres and in the CRS of the models.

    Parameters
    ----------
    path : str or Path
        JSON with `v` and `e` by the id of the building; an OBJ where each `o` (or `g`) is a building, the file if there
        are none; or a folder of such OBJ files.

    Raises
    ------
    InputError
        It cannot be read; the message names the building or line, the value and the fix.
    """
    place = Path(path)
    if not place.exists():
        raise InputError(str(place), "nothing is there", f"Give {_FORMATS}")
    files = sorted(place.glob("*.obj")) if place.is_dir() else [place]
    if not files:
        raise InputError(str(place), "the folder has no OBJ file", f"Give {_FORMATS}")
    if not files[0].name.lower().endswith(_ENDINGS):
        raise InputError(str(place), f"a file that ends in {place.suffix!r} holds no wireframes", f"Give {_FORMATS}")
    drawn: dict[str, Wireframe] = {}
    skipped = 0
    for file in files:
        for one, of_no_length in _read(file):
            if one.building_id in drawn:
                problem = f"building {one.building_id!r} is there twice"
                raise UnreadableInputError(str(file), problem, "Give each building one id")
            drawn[one.building_id] = one
            skipped += of_no_length
    wireframes = tuple(drawn[name] for name in sorted(drawn) if len(drawn[name].edges))
    if not wireframes:
        raise EmptyInputError(str(place), "the file has no edges", f"Give {_FORMATS}")
    notes = []
    if skipped:
        notes.append(f"{skipped} edges of {place.name} join a vertex to itself and are left out.")
    if len(wireframes) < len(drawn):
        notes.append(f"{len(drawn) - len(wireframes)} buildings of {place.name} have no edges and are left out.")
    return WireframeSet(name=place.name, wireframes=wireframes, notes=tuple(notes))


def _read(file: Path) -> list[tuple[Wireframe, int]]:
    """The wireframes of a file, each with its number of edges without length, which it lacks."""
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UnreadableInputError(str(file), str(error), f"Give {_FORMATS}") from error
    try:
        return _json(text) if file.name.lower().endswith(".json") else _obj(text, file.stem)
    except ValueError as fault:  # a JSONDecodeError is one
        raise UnreadableInputError(str(file), str(fault), f"Correct it, or write it again: {_FORMATS}") from fault


def _json(text: str) -> list[tuple[Wireframe, int]]:
    document = json.loads(text, object_pairs_hook=_without_repetition)
    entries = document.items() if isinstance(document, dict) else [("", document)]
    found = []
    for name, entry in entries:
        if not _has_lists(entry):
            raise ValueError(f"building {name!r} has no lists v and e" if name else "the file has no ids of buildings")
        vertices = [_vertex(xyz, f"vertex {k} of building {name!r}") for k, xyz in enumerate(entry["v"])]
        edges = [_edge(ends, len(vertices), f"edge {k} of building {name!r}") for k, ends in enumerate(entry["e"])]
        found.append(_wireframe(name, vertices, edges))
    return found


def _has_lists(entry: Any) -> bool:
    return isinstance(entry, dict) and all(isinstance(entry.get(key), list) for key in ("v", "e"))


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the name {next(name for name in names if names.count(name) > 1)!r} is there twice")
    return found


def _vertex(xyz: Any, what: str) -> list[float]:
    if not _are_numbers(xyz, 3, int | float):
        raise ValueError(f"{what} is {xyz}: three numbers are needed")
    if not all(abs(value) <= FARTHEST_M for value in xyz):
        raise ValueError(f"{what} is {xyz}: coordinates are finite, in metres and at most {FARTHEST_M:g}")
    return [float(value) for value in xyz]


def _edge(ends: Any, count: int, what: str) -> tuple[int, int]:
    if not _are_numbers(ends, 2, int):
        raise ValueError(f"{what} is {ends}: the numbers of two vertices are needed")
    if not all(0 <= value < count for value in ends):
        raise ValueError(f"{what} is {ends}: the {count} vertices are numbered from 0")
    return ends[0], ends[1]


def _are_numbers(values: Any, count: int, kind: Any) -> bool:
    """Whether values are a list of so many numbers."""
    if not isinstance(values, list) or len(values) != count:
        return False
    return all(isinstance(value, kind) and not isinstance(value, bool) for value in values)


def _wireframe(name: str, vertices: list[list[float]], edges: list[tuple[int, int]]) -> tuple[Wireframe, int]:
    some = [ends for ends in edges if ends[0] != ends[1]]
    return Wireframe(
        building_id=name,
        vertices=np.array(vertices, np.float64).reshape(-1, 3),
        edges=np.array(some, np.int64).reshape(-1, 2),
    ), len(edges) - len(some)


def _obj(text: str, stem: str) -> list[tuple[Wireframe, int]]:
    """Polylines by object or group; all of them share the vertices of the file."""
    vertices: list[list[float]] = []
    edges: dict[str, list[tuple[int, int]]] = {}
    name = stem
    for number, line in enumerate(text.splitlines(), start=1):
        key, *words = line.split() or [""]
        try:
            if key == "v":
                vertices.append(_vertex([float(word) for word in words[:3]], "the vertex"))
            elif key in ("o", "g"):
                name = " ".join(words) or stem
            elif key == "l":
                edges.setdefault(name, []).extend(_polyline(words, len(vertices)))
        except ValueError as fault:
            raise ValueError(f"line {number}: {fault}") from fault
    found = []
    for building, ends in edges.items():
        used, places = np.unique(np.array(ends), return_inverse=True)
        own = [(int(a), int(b)) for a, b in places.reshape(-1, 2)]
        found.append(_wireframe(building, [vertices[k] for k in used], own))
    return found


def _polyline(words: Sequence[str], count: int) -> Iterator[tuple[int, int]]:
    """The edges of an `l`."""
    if len(words) < 2:
        raise ValueError(f"an `l` of {len(words)} vertices: two are needed")
    return itertools.pairwise([_place(word, count) for word in words])


def _place(word: str, count: int) -> int:
    """The vertex that a word of an `l` names, from 0; negative numbers count back from the last one."""
    index = int(word.partition("/")[0])
    place = index - 1 if index > 0 else count + index
    if index == 0 or not 0 <= place < count:
        raise ValueError(f"an `l` names vertex {index}, {count} are there so far")
    return place
