"""CityJSON 1.0, 1.1 and 2.0 and CityJSONSeq, of this program and of others (3DBAG, roofer and the like).

Ledoux et al. (2019), CityJSON: a compact and easy-to-use encoding of the CityGML data model.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError, UnreadableInputError
from pipeline.io.crs import SpatialReference
from pipeline.io.crs_given import parse_crs
from pipeline.io.crs_resolution import resolve_reference
from pipeline.io.file_facts import Readable
from pipeline.model import FloatArray, RoofType, Status
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading.cityjson_geometry import Object, Places, chosen, has_inner_shells, parts_of
from pipeline.ruler.evaluation.reading.collected import Collected, model_of
from pipeline.ruler.evaluation.reading.model_surfaces import assemble
from pipeline.ruler.evaluation.reading.roof_type_names import named_roof_type

VERSIONS = ("1.0", "1.1", "2.0")
"""Versions that are read."""

_TRANSFORM_IS_OPTIONAL = "1.0"
_IDENTITY = {"scale": [1.0, 1.0, 1.0], "translate": [0.0, 0.0, 0.0]}
_BUILDING_TYPES = ("Building", "BuildingPart")
_FOOTPRINT_PREFIXES = ("b3_", "rf_")
_FAULTS = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)
_PEEK_BYTES = 1 << 16
_SAYS_CITYJSON = re.compile(rb'"type"\s*:\s*"CityJSON"')
_FIX = "Give a file that cjio or another validator of CityJSON accepts"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """The frame of all coordinates, from the header."""

    scale: FloatArray
    """(3,) float64."""
    translate: FloatArray
    """(3,) float64."""
    empty: Places
    """Templates and units, without vertices."""

    def places(self, vertices: Sequence[Sequence[float]]) -> Places:
        """Vertices of a file or feature in metres."""
        with np.errstate(over="ignore", invalid="ignore"):
            metres = (_triples(vertices) * self.scale + self.translate) * self.empty.units_m
        return dataclasses.replace(self.empty, vertices=metres)


def is_cityjson(path: Path) -> bool:
    """Whether a JSON file says near its start or its end that it is CityJSON."""
    try:
        with path.open("rb") as stream:
            start = stream.read(_PEEK_BYTES)
            stream.seek(max(0, path.stat().st_size - _PEEK_BYTES))
            return _SAYS_CITYJSON.search(start) is not None or _SAYS_CITYJSON.search(stream.read()) is not None
    except OSError as error:
        raise _unreadable(path, str(error)) from error


def read_cityjson_files(paths: Sequence[Path], into: Collected) -> None:
    """Read the buildings of CityJSON files, each in memory as a whole.

    Raises InputError if one is broken, or not CityJSON of a supported version.
    """
    for path in paths:
        try:
            document = json.loads(path.read_bytes())
        except OSError as error:
            raise _unreadable(path, str(error)) from error
        except ValueError as error:
            fix = "A CityJSONSeq has one JSON text a line: name it .city.jsonl"
            raise _unreadable(path, f"no JSON ({error})", fix) from error
        _read_document(path, document, into)


def _read_document(path: Path, document: Any, into: Collected) -> None:
    frame = _frame(path, "", document, into)
    where = ""
    try:
        objects = document["CityObjects"]
        places = frame.places(document["vertices"])
        for where, parts in _buildings(objects, into):
            into.add(_model(where, parts, objects, places, into))
    except _FAULTS as fault:
        raise _broken(path, f"building {where!r}: " if where else "", fault) from fault


def read_cityjsonseq_files(paths: Sequence[Path], into: Collected) -> None:
    """Read the buildings of CityJSONSeq files, one feature in memory at a time; an InputError names a broken line."""
    for path in paths:
        for feature, places, where in features(path, into):
            try:
                objects = feature["CityObjects"]
                for name, parts in _buildings(objects, into):
                    into.add(_model(name, parts, objects, places, into))
            except _FAULTS as fault:
                raise _broken(path, where, fault) from fault


def features(
    path: Readable, into: Collected, units_m: tuple[float, float] | None = None
) -> Iterator[tuple[Object, Places, str]]:
    """The features of a CityJSONSeq file, with their vertices and lines, for messages.

    `into` receives the coordinate reference system. `units_m`, metres per horizontal and per vertical unit, overrides
    the file. Raises InputError if a line is not JSON, or neither metadata nor a feature.
    """
    frame: Frame | None = None
    try:
        with path.open("rb") as stream:
            for number, line in enumerate(stream, start=1):
                if not line.strip():
                    continue
                where = f"line {number}: "
                try:
                    entry = json.loads(line)
                except ValueError as fault:
                    raise _broken(path, where, fault) from fault
                kind = entry.get("type") if isinstance(entry, dict) else None
                if kind == "CityJSON":
                    frame = _frame(path, where, entry, into, units_m)
                elif frame is None:
                    raise _unreadable(path, f"{where}no line of metadata (type CityJSON) before it")
                elif kind != "CityJSONFeature":
                    raise _unreadable(path, f"{where}type is {kind!r}, not CityJSONFeature")
                else:
                    try:
                        places = frame.places(entry["vertices"])
                    except _FAULTS as fault:
                        raise _broken(path, where, fault) from fault
                    yield entry, places, where
    except OSError as error:
        raise _unreadable(path, str(error)) from error
    if frame is None:
        raise _unreadable(path, "the file is empty")


def _unreadable(path: Readable, problem: str, fix: str = _FIX) -> InputError:
    return UnreadableInputError(str(path), problem, fix)


def _broken(path: Readable, where: str, fault: Exception) -> InputError:
    """The error for a fault in the content of a file."""
    problem = f"{fault} is missing" if isinstance(fault, KeyError) else str(fault)
    return _unreadable(path, f"{where}{problem}")


def _triples(vertices: Any) -> FloatArray:
    """(n, 3) float64; ValueError if they are not finite triples of numbers."""
    array = np.array(vertices, np.float64) if len(vertices) else np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise ValueError("vertices are not triples of finite numbers")
    return array


def _frame(
    path: Readable, where: str, header: Any, into: Collected, units_m: tuple[float, float] | None = None
) -> Frame:
    """The frame of a header."""
    kind = header.get("type") if isinstance(header, dict) else type(header).__name__
    if kind != "CityJSON":
        raise _unreadable(path, f"{where}type is {kind!r}, not CityJSON")
    version = str(header.get("version", ""))
    if version[:3] not in VERSIONS:
        raise _unreadable(
            path, f"{where}version is {version!r}, read are {', '.join(VERSIONS)}", "Upgrade the file with cjio upgrade"
        )
    try:
        reference = _reference(path, header.get("metadata") or {}, into)
        if units_m is None:
            units_m = (reference.horizontal_unit_m, reference.vertical_unit_m)
        is_optional = version.startswith(_TRANSFORM_IS_OPTIONAL) and not where
        transform = header.get("transform", _IDENTITY) if is_optional else header["transform"]
        templates = header.get("geometry-templates") or {}
        return Frame(
            scale=_triples([transform["scale"]])[0],
            translate=_triples([transform["translate"]])[0],
            empty=Places(
                vertices=np.empty((0, 3)),
                units_m=np.array([units_m[0], units_m[0], units_m[1]]),
                templates=templates.get("templates", ()),
                template_vertices=_triples(templates.get("vertices-templates", ())),
            ),
        )
    except _FAULTS as fault:
        raise _broken(path, where, fault) from fault


def _reference(path: Readable, metadata: Object, into: Collected) -> SpatialReference:
    """The coordinate reference system and its units; metres without one."""
    text = metadata.get("referenceSystem")
    if not text:
        into.note("no referenceSystem in the file: coordinates are taken as metres")
        return SpatialReference()
    reference, notes = resolve_reference(path=str(path), header_crs=parse_crs(str(text), path=str(path)))
    if reference.horizontal_unit_m != 1.0:
        for sentence in notes:
            into.note(sentence.split(";")[0])
    into.is_at(reference.name if reference.epsg is None else f"EPSG:{reference.epsg}")
    return reference


def _buildings(objects: Mapping[str, Object], into: Collected) -> Iterator[tuple[str, list[str]]]:
    """The buildings of a file or feature with their parts; a part without its building counts as a building."""
    parent_of: dict[str, str] = {}
    for name, entry in objects.items():
        for child in entry.get("children", ()):
            parent_of.setdefault(child, name)
        for parent in entry.get("parents", ())[:1]:
            parent_of[name] = parent
    parts: dict[str, list[str]] = {}
    for name, entry in objects.items():
        if entry["type"] not in _BUILDING_TYPES:
            into.count("{n} objects that are neither Building nor BuildingPart are left out")
            continue
        root, steps = name, 0
        while (above := parent_of.get(root, "")) in objects and objects[above]["type"] in _BUILDING_TYPES:
            root, steps = above, steps + 1
            if steps > len(objects):
                raise ValueError(f"{name!r} is its own parent")
        parts.setdefault(root, [])
        if root != name:
            parts[root].append(name)
    yield from parts.items()


def _model(
    name: str, parts: Sequence[str], objects: Mapping[str, Object], places: Places, into: Collected
) -> RoofModel:
    """One building from its geometries."""
    attributes = objects[name].get("attributes") or {}
    geometries, lod = chosen(
        objects[name].get("geometry") or (), [objects[part].get("geometry") or () for part in parts], places
    )
    if any(has_inner_shells(geometry, places) for geometry in geometries):
        into.count("cavities of solids are not looked at: {n} buildings have some")
    source_id = attributes.get("source_id")
    into.has_footprints = into.has_footprints or source_id is not None
    if not into.has_footprints and any(key.startswith(_FOOTPRINT_PREFIXES) for key in attributes):
        into.has_footprints = True
        into.note("attributes of roofer or 3DBAG: the models are taken to follow given footprints")
    return model_of(
        name,
        assemble([part for geometry in geometries for part in parts_of(geometry, places)]),
        roof_type=_roof_type(attributes, [objects[part].get("attributes") or {} for part in parts]),
        status=_status(attributes.get("status")),
        lod=lod,
        source_id=None if source_id is None else str(source_id),
        touches_data_edge=attributes.get("touches_data_edge") is True,
    )


def _status(value: object) -> Status:
    """The status of a model that a run delivered; `ok` where its file does not state one of ours."""
    return Status(str(value)) if value in {Status.DOUBTFUL.value, Status.FALLBACK.value} else Status.OK


def _roof_type(attributes: Object, of_parts: Sequence[Object]) -> RoofType:
    """The roof type of a building, else the one that its parts agree on."""
    own = named_roof_type(attributes)
    found = {named_roof_type(part) for part in of_parts}
    return found.pop() if own is RoofType.UNKNOWN and len(found) == 1 else own
