"""Inputs of a job: checked when it is submitted, and again when it runs, because they may change in between."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from pipeline.errors import InputError
from pipeline.io.area_of_use import location_of
from pipeline.io.formats import POINT_SUFFIXES, VECTOR_SUFFIXES
from service.downloads import Cancel, OnBytes, download, ignore_bytes, name_of
from service.errors import (
    InputRefusedError,
    NoSuchUploadError,
    OutsideAreaError,
    RequestError,
    ServiceError,
    TooLargeError,
)
from service.filenames import unread
from service.files import StateFolder
from service.input_policy import checked_crs, checked_path, checked_url
from service.jobs import InputReference, JobRequest, Upload
from service.preflight import outside_area, preflight, promised_points
from service.settings import ServiceSettings
from service.vectors import LINES, POLYGONS


class UploadTable(Protocol):
    """The part of the store that is used here."""

    def upload(self, upload_id: str, *, owner: str | None = None) -> Upload:
        """One upload; with `owner` only if it belongs to that key."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fetched:
    """An input on this machine's disk."""

    reference: InputReference
    """The reference in the request."""
    path: Path
    """Its path on disk."""
    points: int
    """Points of a point cloud, by its header; 0 for footprints and guides."""
    sha256: str | None
    """Hexadecimal; None for files that were read in place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobFiles:
    """The inputs of a job on this machine's disk."""

    tiles: Sequence[Fetched]
    """Point clouds."""
    footprints: Fetched | None = None
    """Building outlines."""
    guides: Fetched | None = None
    """Lines of roofs."""

    @property
    def all(self) -> list[Fetched]:
        """All of them."""
        return [*self.tiles, *(one for one in (self.footprints, self.guides) if one is not None)]


_Kind = Literal["point cloud", "file of footprints", "file of guides"]
"""What an input must be."""
_SUFFIXES: Mapping[_Kind, tuple[str, ...]] = {
    "point cloud": POINT_SUFFIXES,
    "file of footprints": VECTOR_SUFFIXES,
    "file of guides": VECTOR_SUFFIXES,
}
_SHAPES: Mapping[_Kind, str] = {"file of footprints": POLYGONS, "file of guides": LINES}
"""What a vector file must hold."""


def resolve_inputs(
    request: JobRequest, *, store: UploadTable, folder: StateFolder, settings: ServiceSettings, owner: str | None
) -> None:
    """Check the inputs of a job before it is accepted.

    Uploads exist, belong to `owner` (None for any) and have the right kind; paths are files below a root; URLs lead to
    listed hosts; and the points known so far are not too many.

    Raises
    ------
    RequestError
        Listing all faults.
    OutsideAreaError
        The only faults are tiles far outside the area of use of their CRS.
    InputRefusedError
        The only faults are inputs that are not allowed.
    TooLargeError
        Too many inputs or points.
    """
    sources: list[tuple[InputReference, _Kind]] = [(tile, "point cloud") for tile in request.tiles]
    if request.footprints is not None:
        sources.append((request.footprints, "file of footprints"))
    if request.guides is not None:
        sources.append((request.guides, "file of guides"))
    if len(sources) > settings.max_inputs:
        raise TooLargeError(f"the job names {len(sources)} inputs, this service takes {settings.max_inputs}")
    faults: list[str] = []
    refusals, outside, points = 0, 0, 0
    for source, kind in dict.fromkeys(sources):
        try:
            if source.kind == "upload":
                points += _check_upload(source, kind, request, store, folder, owner)
            elif source.kind == "path":
                path = checked_path(source.value, settings)
                _check_suffix(source, path.name, kind)
                points += (promised_points(path) or 0) if kind == "point cloud" else 0
            else:
                _check_suffix(source, name_of(checked_url(source.value, settings)), kind)
        except TooLargeError:
            raise
        except (ServiceError, InputError) as fault:
            faults.append(str(fault))
            refusals += isinstance(fault, InputRefusedError)
            outside += isinstance(fault, OutsideAreaError)
    if faults and outside == len(faults):
        raise OutsideAreaError(faults)
    if faults:
        raise InputRefusedError("; ".join(faults)) if refusals == len(faults) else RequestError(faults)
    _check_sum(points, settings)


def _check_upload(
    source: InputReference,
    kind: _Kind,
    request: JobRequest,
    store: UploadTable,
    folder: StateFolder,
    owner: str | None,
) -> int:
    """The number of points of an upload; refuses one that does not fit."""
    upload = store.upload(source.value, owner=owner)
    _upload_path(upload, folder)
    _check_suffix(source, upload.filename, kind)
    _check_shape(upload, kind)
    far = _outside_area(upload, request.crs)
    problems = [str(problem) for problem in upload.preflight.get("problems", ()) if problem != far]
    if kind == "file of footprints" and request.footprints_layer is not None:
        _check_layer(upload, request.footprints_layer)
        problems = []  # several layers are one of them
    if problems and request.crs is None:
        raise RequestError([f"upload {upload.upload_id} ({upload.filename}): {'; '.join(problems)}"])
    if far is not None and not request.allow_outside_area_of_use:
        raise OutsideAreaError([f"{upload.filename}: {far}"])
    return int(upload.preflight.get("pointCount") or 0)


def _check_layer(upload: Upload, layer: str) -> None:
    """Refuse a layer that a file does not have; not all formats say before they are read."""
    layers = upload.preflight.get("layers")
    if layers and layer not in layers:
        there = ", ".join(map(str, layers))
        problem = f"upload {upload.upload_id} ({upload.filename}) has no layer {layer[:80]!r}"
        raise RequestError([f"footprintsLayer: {problem}: name one of {there}"])


def _outside_area(upload: Upload, crs: str | None) -> str | None:
    """Why the tile's place is refused, by the given CRS or that of its header; None if it is not, or not known."""
    if crs is None:
        far: str | None = upload.preflight.get("outsideAreaOfUse")
        return far
    bounds = upload.preflight.get("bounds")
    if bounds is None:
        return None
    wkt = checked_crs(crs, path="crs").to_wkt("WKT2_2019")
    return outside_area(location_of(wkt, (bounds[0], bounds[1], bounds[3], bounds[4])))


def _upload_path(upload: Upload, folder: StateFolder) -> Path:
    """The file of an upload; it must be complete."""
    path = folder.upload(upload.upload_id) / upload.filename
    try:
        size = path.stat().st_size
    except FileNotFoundError:
        size = -1
    if size != upload.size_bytes:
        raise NoSuchUploadError(f"the file of upload {upload.upload_id} is gone: upload {upload.filename} again")
    return path


def _check_suffix(source: InputReference, name: str, kind: _Kind) -> None:
    """Refuse points as footprints and vice versa, by the ending that decides how a file is read."""
    suffixes = _SUFFIXES[kind]
    if not name.lower().endswith(suffixes):
        if kind != "point cloud" and (about := unread(name)):
            raise RequestError([f"{source.kind} {name[:80]!r} cannot be used: {about}"])
        raise RequestError([f"{source.kind} {name[:80]!r} is not a {kind}: its name must end in {', '.join(suffixes)}"])


def _check_shape(upload: Upload, kind: _Kind) -> None:
    """Refuse lines as footprints and vice versa, by what was found when the file came."""
    held = upload.preflight.get("shapes", [POLYGONS])
    if kind in _SHAPES and _SHAPES[kind] not in held:
        what = f"holds {' and '.join(held)}, not {_SHAPES[kind]}"
        raise RequestError([f"upload {upload.filename[:80]!r} is not a {kind}: it {what}. Upload a file that does"])


def _known_facts(upload: Upload, settings: ServiceSettings) -> Mapping[str, Any] | None:
    """What was found in an upload when it arrived: nothing changes its file. None if it must be examined again."""
    known = "kind" in upload.preflight and int(upload.preflight.get("pointCount") or 0) <= settings.max_points
    return upload.preflight if known else None


def _check_sum(points: int, settings: ServiceSettings) -> None:
    if points > settings.max_points:
        raise TooLargeError(
            f"the inputs have {points} points together, this service takes {settings.max_points} per job: "
            "submit several jobs, or raise GABLEWORK_MAX_POINTS"
        )


def gather(
    request: JobRequest,
    *,
    store: UploadTable,
    folder: StateFolder,
    settings: ServiceSettings,
    target: Path,
    cancelled: Cancel,
    progress: OnBytes = ignore_bytes,
) -> JobFiles:
    """The inputs of a job on this machine's disk, within the limits; raises as `materialise`.

    `progress` gets the bytes of all inputs that were fetched so far, as `download` reports them.
    """
    before, seen = 0, 0

    def fetched(source: InputReference) -> Fetched:
        nonlocal before
        found = materialise(
            source,
            store=store,
            folder=folder,
            settings=settings,
            target=target,
            cancelled=cancelled,
            progress=on_bytes,
        )
        before = seen
        # an input that was examined is progress, too, though no byte of it was fetched
        progress(seen)
        return found

    def on_bytes(so_far: int) -> None:
        nonlocal seen
        seen = before + so_far
        progress(seen)

    tiles, points = [], 0
    for tile in dict.fromkeys(request.tiles):
        tiles.append(fetched(tile))
        points += tiles[-1].points
        _check_sum(points, settings)
    footprints, guides = (None if one is None else fetched(one) for one in (request.footprints, request.guides))
    return JobFiles(tiles=tiles, footprints=footprints, guides=guides)


def materialise(
    reference: InputReference,
    *,
    store: UploadTable,
    folder: StateFolder,
    settings: ServiceSettings,
    target: Path,
    cancelled: Cancel,
    progress: OnBytes = ignore_bytes,
) -> Fetched:
    """One input on this machine's disk, checked again and examined; `cancelled` and `progress` as in `download`.

    The owner of an upload was checked when the job was submitted.

    Raises
    ------
    NoSuchUploadError
        The upload is gone.
    InputRefusedError
        The path or the URL, or what it redirects to, is not allowed.
    TooLargeError
        Too many bytes or points.
    NoSpaceError
        The disk is full.
    InputError
        It cannot be fetched or read.
    RunCancelledError
        The job was cancelled.
    """
    digest = None
    facts: Mapping[str, Any] | None = None
    if reference.kind == "upload":
        upload = store.upload(reference.value)
        path, digest = _upload_path(upload, folder), upload.sha256
        facts = _known_facts(upload, settings)
    elif reference.kind == "path":
        path = checked_path(reference.value, settings)
    else:
        path, digest = download(
            reference.value, settings=settings, target=target, cancelled=cancelled, progress=progress
        )
    if facts is None:
        facts = preflight(path, settings.max_points)
    return Fetched(reference=reference, path=path, points=int(facts.get("pointCount") or 0), sha256=digest)
