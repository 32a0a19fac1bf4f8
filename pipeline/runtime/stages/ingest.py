"""Ingest: one streamed read of each input file, which buckets its points on the lattice of tiles.

LAZ has no spatial index, so reading windows would decode the file again for every tile. Several tasks read a large file
at once, each a share of it.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from uuid import uuid4

import numpy as np
import numpy.typing as npt

from pipeline.errors import EmptyInputError, InconsistentInputError, InputError, UnreadableInputError
from pipeline.io import ReadOptions, SourceInfo, is_url, open_source, shown
from pipeline.io.file_facts import Share
from pipeline.io.places import file_at
from pipeline.io.reading import heard_by, moved, one_input, stalled
from pipeline.io.storage import sha256_of
from pipeline.io.strays import MOST_STRAYS
from pipeline.model import IntArray, PointCloud, Reason
from pipeline.registry import extra
from pipeline.runtime.isolation.process_limits import IsolationLimits, Loss
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import is_fetched_by_nodes, shares_of
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.scratch.outcomes import Files, Place, key_of, whole
from pipeline.runtime.stages.cleanup import clear_points
from pipeline.runtime.stages.ingested import Ingested, of_file, points_by_tile, spread_m
from pipeline.runtime.stages.tile_content import ZoneSums, zone_sums
from pipeline.terrain.flight_passes import NO_SLICES, Strip, ids_of_timed, slices_of, united_slices
from pipeline.tiling import MM, Tile, TileGrid

_CHUNK_POINTS = 250_000
"""Points per chunk: few enough that numpy uses the same memory again for each chunk."""
_LINE_SPREAD_M = 0.05
"""Points that stray less from one line make no surface. Not a setting: the noise of a scanner is of this size."""
_TWO_BYTES = 2**16
_MANY_TILES, _FEW_POINTS = 100, 4
"""Points are scattered if more than `MOST_STRAYS` of them lie in tiles with too few, and these are too many tiles. Not
settings: a survey fills its tiles, except for some at its border."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class IngestTask:
    """One input file, or a share of it."""

    part: str
    """Names its buckets in scratch; no two tasks have one name."""
    path: str
    """The file, or its URL with its query."""
    options: ReadOptions
    """CRS, units, area of interest, dropped classes."""
    grid: TileGrid
    """The lattice."""
    scratch: Scratch
    """Where the buckets go."""
    known: SourceInfo | None = None
    """Header facts from the plan."""
    share: Share | None = None
    """The share; None for the whole file."""
    limits: IsolationLimits | None = None
    """Limits of the child process that reads it; None reads it in the process that runs the task."""
    moves_mm: tuple[tuple[Strip, int], ...] = ()
    """Flight strips that are moved, and by how much up; those named by GPS times get ids of their own, too. With
    these, all strips of the survey."""

    @property
    def supervises(self) -> bool:
        """Whether it is read in a child process of the process that runs the task."""
        return self.limits is not None


def tasks_of(
    context: RunContext, paths: Sequence[str], moves_mm: Mapping[Strip, int] | None = None
) -> dict[Place, IngestTask]:
    """The tasks that read all inputs, in the order of the paths, by the places of their outcomes."""
    plan = context.plan
    known = {info.path: info for info in plan.sources}
    tasks = {}
    for path in paths:
        file = known[shown(path)]
        # a file without any mark of its state may have changed unnoticed: read it again
        written = (file.modified_ns, file.etag) if file.modified_ns or file.etag else uuid4().hex
        for share in shares_of(file, plan.options):
            task = IngestTask(
                part=part_of(path) if share is None else f"{part_of(path)}-{share.number:03d}",
                path=path,
                options=plan.options,
                grid=plan.grid,
                scratch=context.scratch,
                known=file,
                share=share,
                limits=context.reading,
                moves_mm=tuple(sorted((moves_mm or {}).items())),
            )
            key = key_of(path, file.file_size, written, task.options, task.grid, share, task.moves_mm)
            tasks[Place("ingest", task.part, key)] = task
    return tasks


def ingest(context: RunContext, paths: Sequence[str], moves_mm: Mapping[Strip, int] | None = None) -> list[Ingested]:
    """Bucket the points of all inputs by tile; what each input held, in the order of the paths.

    `moves_mm` are flight strips whose points are moved up, and get ids of their own if they share one. Raises
    EmptyInputError if no usable point is left, InconsistentInputError if all points lie on one line.
    """
    progress = context.progress
    known = {info.path: info for info in context.plan.sources}
    tasks = tasks_of(context, paths, moves_mm)
    clear_points(context.scratch, tasks)
    buckets: Files[IngestTask, Ingested] = Files(leaves=_buckets, intact=is_intact)
    stored = context.map_stored("ingest", ingest_file, tasks, whole, files=buckets)
    shares: dict[str, list[Ingested]] = {path: [] for path in paths}
    for place, found in stored.items():
        shares[tasks[place].path].append(found)
    ingested = [of_file(known[shown(path)], found) for path, found in shares.items()]
    for found in ingested:
        for warning in found.warnings:
            progress.warn("ingest", f"{shown(found.path)}: {warning}")
    points = sum(points_by_tile(ingested).values())
    if points == 0:
        causes = Counter[str]()
        for found in ingested:
            causes.update(found.findings.dropped)
        lost = ", ".join(f"{count} {cause}" for cause, count in causes.items() if count)
        raise EmptyInputError(
            shown(paths[0]),
            f"no usable point is left ({lost or 'none in the files'})",
            "Check --bbox and --aoi; points that are withheld or of the noise classes 7 and 18 are never used",
        )
    spread = spread_m(ingested)
    if spread < _LINE_SPREAD_M:
        raise InconsistentInputError(
            shown(paths[0]),
            f"all {points} points lie on one line (they stray {spread:.3f} m from it)",
            "Check the columns and the scale of the file",
        )
    return ingested


def _buckets(_: IngestTask, found: Ingested) -> list[str]:
    """The folders of scratch with a file's buckets."""
    return [f"points/{tile.key}" for tile in found.points_by_tile]


def is_intact(task: IngestTask, found: Ingested, folder: str) -> bool:
    """Whether a file's bucket in a folder of scratch holds the points that were read; raises OSError without it."""
    tile = Tile.from_key(folder.rpartition("/")[2])
    path = Path(task.scratch.root, folder, f"{task.part}.bin")
    if path.stat().st_size != found.points_by_tile[tile] * POINT.itemsize:
        return False
    sums = np.zeros((3, 3, 3), np.uint64)
    for start in range(0, found.points_by_tile[tile], _CHUNK_POINTS):
        points = np.fromfile(path, POINT, _CHUNK_POINTS, offset=start * POINT.itemsize)
        sums += _content_of(points, tile, task.grid)
    return sums.tobytes() == found.content[tile]


def part_of(path: str) -> str:
    """Name of an input file's parts in scratch; it does not depend on other inputs.

    >>> part_of("/data/37EN1.LAZ")
    '406afe307fa1d623'
    """
    return hashlib.sha256(path.encode()).hexdigest()[:16]


def to_records(cloud: PointCloud) -> npt.NDArray[np.void]:
    """Points in whole millimetres; sources leave out those that 32 bits would not hold (`pipeline.io.strays`)."""
    records = np.empty(len(cloud), POINT)
    rounded = np.rint(cloud.xyz * MM)
    records["x"] = rounded[:, 0]
    records["y"] = rounded[:, 1]
    records["z"] = rounded[:, 2]
    records["source"] = cloud.source_id
    records["return_number"] = cloud.return_number
    records["return_count"] = cloud.return_count
    records["gps_time"] = cloud.gps_time
    records["classification"] = cloud.classification
    return records


def ingest_file(task: IngestTask) -> Ingested:
    """Read one file, or a share of it, and bucket its points by tile; a file behind a URL is fetched meanwhile.

    With limits it is read in a supervised child process: a decoder that hangs, crashes or takes all memory ends that
    process alone. The points are in scratch under `points/<tile>/<part>.bin`. Raises InputError if the file cannot be
    used, or reading it breaks the limits.
    """
    task.scratch.check_cancelled()
    if task.limits is None:
        with one_input(shown(task.path)):
            return _ingest_here(task)
    from pipeline.runtime.isolation.isolated_items import supervise

    cancelled = functools.partial(_cancelled, task.scratch)
    ((_, found),) = supervise(_ingest_watched, [task], task.limits, cancelled, loads=(), one="reader")
    if isinstance(found, Loss):
        raise _lost(task, found, task.limits)
    return found


def _cancelled(scratch: Scratch) -> bool:
    return scratch.cancelled


def _lost(task: IngestTask, loss: Loss, limits: IsolationLimits) -> InputError:
    """The error for a file whose reading ended its process."""
    name = shown(task.path)
    if loss.reason is Reason.TIMED_OUT:
        return stalled(name, limits.timeout_s)
    return UnreadableInputError(name, f"it cannot be read: {loss.detail}", "Get the file again, or write it again")


def _ingest_watched(task: IngestTask) -> Ingested:
    """As `ingest_file`, in the child process."""
    from pipeline.runtime.isolation.progress_reports import report_progress

    with heard_by(report_progress):
        return _ingest_here(task)


def _ingest_here(task: IngestTask) -> Ingested:
    """As `ingest_file`, in this process."""
    if not is_url(task.path):
        return _ingested(task)
    if task.known is not None and is_fetched_by_nodes(task.known, task.options):
        return dataclasses.replace(_ingested(task), path=shown(task.path))
    file = extra("RemoteFile")(task.path)
    copy = task.scratch.path("fetched", uuid4().hex, f"points{file.suffix}")
    try:
        known = task.known if task.known is not None and task.known.is_of(file) else None
        file.fetch(copy, functools.partial(_between_pieces, task.scratch))
        if known is not None:
            now = copy.stat()
            same = (now.st_size, file.stat().st_mtime_ns) == (known.file_size, known.modified_ns)
            known = dataclasses.replace(known, modified_ns=now.st_mtime_ns, etag="") if same else None
        found = _ingested(dataclasses.replace(task, path=str(copy), known=known))
        return dataclasses.replace(found, path=shown(task.path))
    except InputError as fault:
        raise fault.of(shown(task.path), str(copy)) from None
    finally:
        shutil.rmtree(copy.parent, ignore_errors=True)


def _between_pieces(scratch: Scratch) -> None:
    """Between two pieces of a file that is fetched."""
    moved()
    scratch.check_cancelled()


def _check_unchanged(task: IngestTask) -> None:
    """Refuse a file of which different states would be read; raises UnreadableInputError.

    A task that reads a file of this machine alone opens it once.
    """
    is_alone = task.share is None and not is_url(task.path)
    if not is_alone and task.known is not None and not task.known.is_of(file_at(task.path)):
        raise UnreadableInputError(
            shown(task.path), "it changed after the run began", "Run again once nothing writes to it any more"
        )


def _ingested(task: IngestTask) -> Ingested:
    """As `ingest_file`, for a file that is read where it is."""
    _check_unchanged(task)
    source = open_source(task.path, task.options, task.known)
    suffix = f".{uuid4().hex}.part"
    counts: Counter[Tile] = Counter()
    content: dict[Tile, ZoneSums] = {}
    classes: Counter[int] = Counter()
    low = np.full(3, 2**62)
    high = np.full(3, -(2**62))
    moments = np.zeros(6)
    first: tuple[int, int] | None = None
    multiple = False
    own_ids = ids_of_timed(strip for strip, _ in task.moves_mm)
    slices = NO_SLICES
    for cloud in source.chunks(_CHUNK_POINTS, task.share):
        task.scratch.check_cancelled()
        records = to_records(cloud)
        slices = united_slices([slices, slices_of(cloud.source_id, cloud.gps_time)])
        for strip, move_mm in task.moves_mm:
            if not (move_mm or strip.is_timed):
                continue
            held = strip.holds(cloud.source_id, cloud.gps_time)
            records["z"][held] += move_mm
            records["source"][held] = own_ids.get(strip, strip.source)
        x, y, z = (np.ascontiguousarray(records[name]) for name in "xyz")
        for axis, values in enumerate((x, y, z)):
            low[axis] = min(low[axis], int(values.min()))
            high[axis] = max(high[axis], int(values.max()))
        if first is None:
            first = int(x[0]), int(y[0])
        dx, dy = (x - first[0]) / MM, (y - first[1]) / MM
        moments += (len(records), dx.sum(), dy.sum(), (dx * dx).sum(), (dx * dy).sum(), (dy * dy).sum())
        histogram = np.bincount(records["classification"])
        classes.update({int(c): int(histogram[c]) for c in np.flatnonzero(histogram)})
        multiple = multiple or bool((records["return_count"] > 1).any())
        counts.update(_append_by_tile(records, x, y, task, suffix, content, counts))
    sha256 = "" if is_url(task.path) else _digest_of(task)
    _check_unchanged(task)
    for tile in counts:
        part = task.scratch.path("points", tile.key, f"{task.part}{suffix}")
        task.scratch.check_cancelled()
        part.replace(task.scratch.path("points", tile.key, f"{task.part}.bin"))
    return Ingested(
        path=task.path,
        parts=(task.part,),
        points_by_tile=dict(counts),
        content={tile: sums.tobytes() for tile, sums in content.items()},
        classes=dict(classes),
        findings=source.findings,
        warnings=source.warnings,
        bounds_mm=None if first is None else (*(int(v) for v in low), *(int(v) for v in high)),  # type: ignore[arg-type]
        moments=tuple(float(v) for v in moments),
        first_mm=first or (0, 0),
        multiple_returns=multiple,
        slices=slices.tobytes(),
        sha256=sha256,
    )


def _digest_of(task: IngestTask) -> str:
    """The digest of a file of this machine, by the task of its first share."""
    return "" if task.share is not None and task.share.number else sha256_of(Path(task.path))


def _append_by_tile(
    records: npt.NDArray[np.void],
    x_mm: IntArray,
    y_mm: IntArray,
    task: IngestTask,
    suffix: str,
    content: dict[Tile, ZoneSums],
    before: Counter[Tile],
) -> Counter[Tile]:
    """Append a chunk to the parts of its tiles, and its content to that of the file; the chunk's points by tile.

    `before` has the points of the chunks before. Raises InconsistentInputError for points scattered over the Earth.
    """
    columns, rows = task.grid.columns_rows(x_mm, y_mm)
    west, south = int(columns.min()), int(rows.min())
    height = int(rows.max()) - south + 1
    number = (columns - west) * height + (rows - south)
    n_tiles = (int(columns.max()) - west + 1) * height
    # a stable sort of two bytes is a radix sort
    order = np.argsort(number.astype(np.uint16) if n_tiles <= _TWO_BYTES else number, kind="stable")
    ordered, number = np.take(records, order), number[order]
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    stops = [*starts[1:].tolist(), len(ordered)]
    tiles = [Tile(west + place // height, south + place % height) for place in number[starts].tolist()]
    counts = Counter({tile: stop - start for tile, start, stop in zip(tiles, starts.tolist(), stops, strict=True)})
    _refuse_scattered(task, before + counts if len(counts) > _MANY_TILES else counts)
    for tile, start, stop in zip(tiles, starts.tolist(), stops, strict=True):
        with task.scratch.path("points", tile.key, f"{task.part}{suffix}").open("ab") as part:
            ordered[start:stop].tofile(part)
        sums = _content_of(ordered[start:stop], tile, task.grid)
        content[tile] = content[tile] + sums if tile in content else sums
    return counts


def _refuse_scattered(task: IngestTask, counts: Counter[Tile]) -> None:
    """Refuse points of which many lie alone in their tiles: each tile would cost files and tasks.

    Raises InconsistentInputError. Single strays are left to the outlier filter.
    """
    if len(counts) <= _MANY_TILES:
        return
    alone = [count for count in counts.values() if count < _FEW_POINTS]
    points = sum(counts.values())
    if len(alone) > _MANY_TILES and sum(alone) > MOST_STRAYS * points:
        size_m = task.grid.size_mm / MM
        raise InconsistentInputError(
            shown(task.path),
            f"{sum(alone)} of the first {points} points lie scattered over {len(alone)} tiles of {size_m:g} m, with "
            f"fewer than {_FEW_POINTS} points each",
            "Check the scale, the columns and the file itself: its coordinates look damaged",
        )


def _content_of(points: npt.NDArray[np.void], tile: Tile, grid: TileGrid) -> ZoneSums:
    """The content of some points of a tile."""
    core = grid.core(tile)
    bits = np.ascontiguousarray(points["gps_time"]).view(np.uint64)
    return zone_sums(points, bits, core.x0_mm, core.y0_mm, core.x1_mm, core.y1_mm, grid.halo_mm)
