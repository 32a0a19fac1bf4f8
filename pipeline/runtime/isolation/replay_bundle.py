"""Quarantine bundles: one building with everything needed to model it, in one small file.

A zip of `bundle.json` (names, settings, incident), `points.npy`, `ground.npy`, `split_returns.npy`, `beside.npy` and
`beside_later.npy` (for outlines at the walls), `elsewhere.npy` (in given footprints) and `stderr.txt`. Reading a bundle
executes nothing from it: there are no pickles, and sizes are checked before anything is unpacked.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import platform
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Polygon

from pipeline import __version__
from pipeline.errors import UnreadableInputError
from pipeline.io import place_below, storage_at
from pipeline.io.crs import SpatialReference
from pipeline.methods import ReconstructSettings, method_named
from pipeline.model import Candidate, FloatArray, GivenHeights, Guide, GuideKind
from pipeline.runtime.isolation.process_limits import BUNDLE_SUFFIX
from pipeline.settings import RunSettings

_FORMAT = "gablework bundle 2"
_OPTIONAL = ("beside", "beside_later", "elsewhere", "voids")
"""Points of a candidate that a bundle holds only if there are any."""
_LARGEST_BYTES = 2 * 2**30
_LARGEST_TEXT_BYTES = 64 * 2**20
_FIX = "Use a file of a run's quarantine folder, whole and unchanged"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Incident:
    """What happened to a building."""

    reason: str
    """As in its record."""
    detail: str
    """As in its record."""
    engine_version: str = __version__
    """Version of gablework."""
    seconds: float = math.nan
    """Time from its beginning to its end; nan if not measured."""
    memory_bytes: int = 0
    """Largest private memory; 0 if not measured."""
    stderr: str = ""
    """The last lines of its process's standard error, with the traceback if available."""
    platform: str = dataclasses.field(default_factory=platform.platform)
    """Operating system of the machine."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bundle:
    """One building with everything needed to model it."""

    candidate: Candidate
    method: str
    settings: ReconstructSettings
    incident: Incident
    reference: SpatialReference = dataclasses.field(default_factory=SpatialReference)
    """CRS and units of its outputs."""


def _known(given: GivenHeights) -> dict[str, float]:
    """Heights by attributes, those that are known."""
    return {name: value for name, value in dataclasses.asdict(given).items() if not math.isnan(value)}


def is_whole(path: Path) -> bool:
    """Whether a bundle is as it was written, by its own checksums."""
    try:
        with zipfile.ZipFile(path) as parts:
            return parts.testzip() is None
    except (zipfile.BadZipFile, zlib.error, EOFError):
        return False


def write_bundle(folder: str, bundle: Bundle) -> str:
    """Write `<folder>/<building_id>.bundle`, whole or not at all; replaces an earlier one and returns its path or URL.

    Raises OSError or RunError if it cannot be written.
    """
    candidate = bundle.candidate
    footprint = candidate.footprint
    own = bundle.settings.method or method_named(bundle.method).settings_type()
    incident = dataclasses.asdict(bundle.incident)
    stderr = incident.pop("stderr")
    incident["seconds"] = None if math.isnan(bundle.incident.seconds) else round(bundle.incident.seconds, 3)
    document = {
        "format": _FORMAT,
        "building_id": candidate.building_id,
        "source_id": candidate.source_id,
        "origin": list(candidate.origin),
        "ground_z_m": candidate.ground_z_m if math.isfinite(candidate.ground_z_m) else None,
        "footprint": None if footprint is None else shapely.to_wkb(footprint, hex=True),
        "given": None if candidate.given is None else _known(candidate.given),
        "outline": None if candidate.outline is None else shapely.to_wkb(candidate.outline, hex=True),
        "guides": [[guide.kind.value, shapely.to_wkb(guide.line, hex=True)] for guide in candidate.guides],
        "touches_data_edge": candidate.touches_data_edge,
        "is_known": candidate.is_known,
        "strip_offset_m": None if math.isnan(candidate.strip_offset_m) else candidate.strip_offset_m,
        "ground_noise_m": None if math.isnan(candidate.ground_noise_m) else candidate.ground_noise_m,
        "method": bundle.method,
        "settings": {
            "lods": ",".join(bundle.settings.lods),
            bundle.method: dataclasses.asdict(own),
            "roof": dataclasses.asdict(bundle.settings.roof),
            "plan": dataclasses.asdict(bundle.settings.plan),
            "roof-type": dataclasses.asdict(bundle.settings.roof_type),
            "guides": dataclasses.asdict(bundle.settings.guides),
            "support": dataclasses.asdict(bundle.settings.support),
        },
        "incident": incident,
        "reference": dataclasses.asdict(bundle.reference),
    }
    key = candidate.building_id + BUNDLE_SUFFIX
    with (
        storage_at(folder).putting(key) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        archive.writestr("bundle.json", json.dumps(document, indent=1, allow_nan=False))
        archive.writestr("stderr.txt", stderr)
        arrays = {"points": candidate.points, "ground": candidate.ground, "split_returns": candidate.split_returns}
        for name in _OPTIONAL:
            if len(getattr(candidate, name)):
                arrays[name] = getattr(candidate, name)
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), (1, 0), allow_pickle=False)
    return place_below(folder, key)


def read_bundle(path: str) -> Bundle:
    """Read a bundle from any source: nothing in it is executed.

    Raises
    ------
    UnreadableInputError
        It is not a bundle, is broken, or is larger than a building can be.
    SettingsError
        This version does not know its settings.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            document = json.loads(_member(archive, path, "bundle.json", _LARGEST_TEXT_BYTES))
            if document["format"] != _FORMAT:
                raise UnreadableInputError(path, f"its format is {document['format']!r}, not {_FORMAT!r}", _FIX)
            stderr = _member(archive, path, "stderr.txt", _LARGEST_TEXT_BYTES).decode("utf-8", errors="replace")
            points = _array(_member(archive, path, "points.npy", _LARGEST_BYTES))
            ground = _array(_member(archive, path, "ground.npy", _LARGEST_BYTES))
            split_returns = _array(_member(archive, path, "split_returns.npy", _LARGEST_BYTES))
            optional: dict[str, Any] = {
                name: _array(_member(archive, path, f"{name}.npy", _LARGEST_BYTES))
                for name in _OPTIONAL
                if f"{name}.npy" in archive.namelist()
            }
        bundle = _bundle(document, points, ground, split_returns, stderr)
        return dataclasses.replace(bundle, candidate=dataclasses.replace(bundle.candidate, **optional))
    except OSError as error:
        raise UnreadableInputError(path, f"it cannot be read: {error.strerror or error}", _FIX) from error
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise UnreadableInputError(path, f"it is not a bundle, or broken: {error}", _FIX) from error
    except (KeyError, ValueError, TypeError, AttributeError, OverflowError, shapely.errors.ShapelyError) as error:
        raise UnreadableInputError(path, f"its content is odd: {type(error).__name__}: {error}", _FIX) from error


def _member(archive: zipfile.ZipFile, path: str, name: str, largest_bytes: int) -> bytes:
    """A member's content, unpacked up to a limit, whatever size the archive declares."""
    with archive.open(name) as member:
        content = member.read(largest_bytes + 1)
    if len(content) > largest_bytes:
        raise UnreadableInputError(path, f"its {name} is larger than {largest_bytes // 2**20} MiB", _FIX)
    return content


def _array(content: bytes) -> FloatArray:
    """Coordinates, shape (n, 3); the header is checked against the content before memory is allocated."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"an array of npy version {version}")
    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(stream)
    values = content[stream.tell() :]
    if dtype != np.float64 or len(shape) != 2 or shape[1] != 3 or fortran_order:
        raise ValueError(f"coordinates are {dtype} of shape {shape}: expected float64 of shape (n, 3)")
    if len(values) != dtype.itemsize * shape[0] * shape[1]:
        raise ValueError(f"coordinates of shape {shape} in {len(values)} bytes")
    coordinates: FloatArray = np.frombuffer(values, np.float64).reshape(shape).copy()
    return coordinates


def _bundle(
    document: Mapping[str, Any], points: FloatArray, ground: FloatArray, split_returns: FloatArray, stderr: str
) -> Bundle:
    """The bundle that a document and arrays describe."""
    east, north, up = (float(value) for value in document["origin"])
    footprint = None if document["footprint"] is None else shapely.from_wkb(document["footprint"])
    if not isinstance(footprint, Polygon | MultiPolygon | None):
        raise TypeError(f"its footprint is a {footprint.geom_type}")
    outline = None if document.get("outline") is None else shapely.from_wkb(document["outline"])
    if not isinstance(outline, MultiPolygon | None):
        raise TypeError(f"its outline is a {outline.geom_type}")
    building_id, method, source_id = document["building_id"], document["method"], document["source_id"]
    if not (isinstance(building_id, str) and building_id.isalnum()):
        raise ValueError(f"its building_id is {building_id!r}")
    candidate = Candidate(
        building_id=building_id,
        origin=(east, north, up),
        points=points,
        ground=ground,
        split_returns=split_returns,
        ground_z_m=math.nan if document["ground_z_m"] is None else float(document["ground_z_m"]),
        footprint=footprint,
        source_id=None if source_id is None else str(source_id),
        given=None if document.get("given") is None else GivenHeights(**document["given"]),
        outline=outline,
        touches_data_edge=bool(document["touches_data_edge"]),
        is_known=bool(document.get("is_known", False)),
        strip_offset_m=math.nan if document.get("strip_offset_m") is None else float(document["strip_offset_m"]),
        ground_noise_m=math.nan if document.get("ground_noise_m") is None else float(document["ground_noise_m"]),
        guides=tuple(_guide(kind, line) for kind, line in document.get("guides", ())),
    )
    return Bundle(
        candidate=candidate,
        method=method,
        settings=RunSettings.from_mapping({"method": method, **document["settings"]}).building,
        incident=_incident(document["incident"], stderr),
        reference=SpatialReference(**document["reference"]),
    )


def _guide(kind: str, wkb: str) -> Guide:
    """A guide of the document."""
    line = shapely.from_wkb(wkb)
    if not isinstance(line, LineString):
        raise TypeError(f"a guide is a {line.geom_type}")
    return Guide(kind=GuideKind(kind), line=line)


def _incident(document: Mapping[str, Any], stderr: str) -> Incident:
    return Incident(
        reason=str(document["reason"]),
        detail=str(document["detail"]),
        engine_version=str(document["engine_version"]),
        seconds=math.nan if document["seconds"] is None else float(document["seconds"]),
        memory_bytes=int(document["memory_bytes"]),
        stderr=stderr,
        platform=str(document["platform"]),
    )
