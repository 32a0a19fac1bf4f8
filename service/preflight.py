"""Examines the header of a file before any work on it, and refuses bombs.

`examine` does the work. `Examiner` runs it in a child process with limited memory and time, because the bytes come from
strangers and the readers are native code. The child also keeps the readers out of the API's own process. It starts with
the first file, serves one file after the other, and ends with its parent.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import json
import math
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any

from pipeline.errors import CrsError, EmptyInputError, InputError, UnreadableInputError
from pipeline.io.area_of_use import Location
from pipeline.io.crs import LARGEST_COORDINATE
from pipeline.io.formats import FORMATS, VECTOR_SUFFIXES, PointFormat, recognise_format
from pipeline.io.temporary import temporary_folder
from pipeline.registry import loaded
from service.errors import TooLargeError
from service.vectors import examine_vector
from service.wording import as_inputs

PASS_BYTES = 128 << 20
"""Text and PLY have no bounds in a header: files up to this size are read through, larger ones are only counted."""
BLOCK_BYTES = 1 << 20
QUICK_BYTES = 8 << 20
"""Files up to this size are examined in a moment, whatever their format."""
CHILD_BYTES = 2 << 30
"""Address space of the child; its libraries alone map some hundred MiB."""
CHILD_S = 60.0
"""Seconds for one file, the child's start included."""
CHILD_FILES = 500
"""Files after which the child is replaced."""
REFUSED = "Get the file again, or rewrite it with another tool"


def examine(path: Path, *, max_points: int) -> dict[str, Any]:
    """The content of a file's header, read in this process; more than `max_points` points are refused.

    Returns
    -------
    dict
        Plain JSON values. `kind` points, footprints or guides, `format`, `usable`, `problems` that `crs` or other
        inputs may still fix, `warnings`, `crs` (name and EPSG code); for points `pointCount`, `horizontalUnitM`,
        `verticalUnitM`, `bounds` (x_min, y_min, z_min, x_max, y_max, z_max in the CRS's units), `place` (longitude and
        latitude of their middle), `areaOfUse`, `outsideAreaOfUse` (a sentence), `densityPerM2`, `hasReturns`,
        `hasClasses`, `acquiredFrom`, `acquiredTo`; else `featureCount`, `layers`, `shapes`. Unknown values are None.

    Raises
    ------
    InputError
        Not a supported format, damaged, or header and size disagree.
    TooLargeError
        More points than allowed.
    """
    try:
        if path.suffix.lower() in VECTOR_SUFFIXES:
            return examine_vector(path)
        return _examine_points(path, max_points)
    except OSError as fault:
        raise UnreadableInputError(
            str(path), f"cannot be read ({fault.strerror or fault})", "Check the file and its permissions"
        ) from fault
    except MemoryError:
        raise UnreadableInputError(str(path), "its header needs more memory than any real one", REFUSED) from None


def _examine_points(path: Path, max_points: int) -> dict[str, Any]:
    """Format, count, CRS, bounds of a point cloud."""
    form = recognise_format(path)
    _check_count(path, _count_before_reading(path, form), max_points)
    if not form.has_bounds and path.stat().st_size > PASS_BYTES:
        return _only_counted(path, form)
    from pipeline.io.source import ReadOptions, open_source, opened_as

    try:
        known = open_source(path).info
    except CrsError as fault:
        facts = opened_as(form, path, ReadOptions()).facts
        _check_facts(path, facts.point_count, facts.bounds, max_points)
        crs = None if facts.crs is None else {"name": facts.crs.name, "epsg": facts.crs.to_epsg()}
        return _points(
            facts.format,
            facts.point_count,
            crs=crs,
            bounds=list(facts.bounds),
            hasReturns=facts.has_returns,
            hasClasses=facts.has_classes,
            warnings=[as_inputs(warning) for warning in facts.warnings],
            problems=[as_inputs(f"{fault.problem}. {fault.fix}")],
        )
    _check_facts(path, known.point_count, known.bounds_m, max_points)
    reference = known.reference
    plan, up = reference.horizontal_unit_m, reference.vertical_unit_m
    units = (plan, plan, up, plan, plan, up)
    return _points(
        known.format,
        known.point_count,
        crs=None if reference.wkt is None else {"name": reference.name, "epsg": reference.epsg},
        horizontalUnitM=plan,
        verticalUnitM=up,
        bounds=[round(value / unit, 6) for value, unit in zip(known.bounds_m, units, strict=True)],
        densityPerM2=round(known.density_per_m2, 3) if math.isfinite(known.density_per_m2) else None,
        hasReturns=known.has_returns,
        hasClasses=known.has_classes,
        acquiredFrom=known.acquired_from.isoformat() if known.acquired_from else None,
        acquiredTo=known.acquired_to.isoformat() if known.acquired_to else None,
        warnings=[as_inputs(warning) for warning in known.warnings],
        **_place_facts(known.location),
    )


def _place_facts(location: Location | None) -> dict[str, Any]:
    """Where the tile would lie, and whether a job refuses that."""
    if location is None:
        return {}
    place = location.longitude_latitude
    far = outside_area(location)
    return {
        "place": None if place is None else {"longitude": round(place[0], 5), "latitude": round(place[1], 5)},
        "areaOfUse": None if location.area is None else dataclasses.asdict(location.area),
        "outsideAreaOfUse": far,
        "problems": [] if far is None else [far],
    }


def outside_area(location: Location | None) -> str | None:
    """Why a job refuses a tile at this place unless it allows it; None if it does not."""
    if location is None or not location.is_far_outside:
        return None
    return as_inputs(f"{location.problem}. {location.fix}")


def _check_facts(path: Path, count: int, bounds: Iterable[float], max_points: int) -> None:
    """Refuse too many points, and bounds that are not numbers."""
    _check_count(path, count, max_points)
    if not all(abs(bound) < LARGEST_COORDINATE for bound in bounds):
        raise UnreadableInputError(str(path), f"no place on Earth has the bounds {tuple(map(float, bounds))}", REFUSED)


def _points(kind: str, count: int, **known: Any) -> dict[str, Any]:
    """The facts of points; None if unknown."""
    names = ("crs", "horizontalUnitM", "verticalUnitM", "bounds", "densityPerM2", "hasReturns", "hasClasses")
    facts: dict[str, Any] = {"kind": "points", "format": kind, "pointCount": count}
    facts |= dict.fromkeys((*names, "place", "areaOfUse", "outsideAreaOfUse", "acquiredFrom", "acquiredTo"))
    facts |= {"warnings": [], "problems": []} | known
    return facts | {"usable": not facts["problems"]}


def _only_counted(path: Path, form: PointFormat) -> dict[str, Any]:
    """The facts of files without bounds that are too large to be read through here."""
    warning = f"the file has no header with bounds and more than {PASS_BYTES >> 20} MiB: the job reads it through"
    return _points(form.name, _count_before_reading(path, form), warnings=[warning])


def _check_count(path: Path, count: int, max_points: int) -> None:
    """Refuse too many points."""
    if count > max_points:
        raise TooLargeError(
            f"{path.name} has {count} points, this service takes {max_points}: cut it into tiles, or raise "
            "GABLEWORK_MAX_POINTS"
        )


def promised_points(path: Path) -> int | None:
    """The number of points in the header of a file; None for text, which has none.

    Raises
    ------
    InputError
        Not a supported format, or the header is damaged.
    """
    form = recognise_format(path)
    return _count_before_reading(path, form) if form.count else None


def _count_before_reading(path: Path, form: PointFormat) -> int:
    """Points by the header, or for text the largest possible number, without parsing any."""
    if form.count:
        count: int = loaded(form.count)(path)
        return count
    lines = 1
    with path.open("rb") as stream:
        while block := stream.read(BLOCK_BYTES):
            lines += block.count(b"\n")
    return lines


class Examiner:
    """Examines files in a child process. Any number of threads may call; they are served in turn."""

    def __init__(self, *, timeout_s: float = CHILD_S, memory_bytes: int = CHILD_BYTES) -> None:
        self._timeout_s = timeout_s
        self._memory_bytes = memory_bytes
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._held = contextlib.ExitStack()
        self._served = 0

    def examine(self, path: Path, *, max_points: int) -> dict[str, Any]:
        """As the function `examine`; a file that ends the child or takes too long is unreadable.

        Raises
        ------
        InputError
            As `examine`.
        TooLargeError
            As `examine`.
        """
        with self._lock:
            try:
                answer = self._ask({"path": str(path), "max_points": max_points})
            except BaseException:
                # a late answer would be taken for that of the next file
                self._end()
                raise
        if "facts" in answer:
            facts: dict[str, Any] = answer["facts"]
            return facts
        kind = _FAULTS.get(answer["kind"])
        if kind is None:
            raise TooLargeError(answer["problem"])
        raise kind(str(path), answer["problem"], answer["fix"])

    def close(self) -> None:
        """End the child."""
        with self._lock:
            self._end()

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """One answer. A child that was killed from outside is started again once."""
        for attempt in range(2):
            child = self._running()
            assert child.stdin is not None
            assert child.stdout is not None
            deadline_s = time.monotonic() + self._timeout_s
            try:
                child.stdin.write(json.dumps(request).encode() + b"\n")
                child.stdin.flush()
                line = _line_of(child.stdout, deadline_s)
            except BrokenPipeError:
                line = b""
            except TimeoutError:
                self._end()
                return _unreadable(f"its header could not be read within {self._timeout_s:g} s")
            if line.endswith(b"\n"):
                self._served += 1
                answer: dict[str, Any] = json.loads(line)
                return answer
            self._end()
            if attempt:
                break
        return _unreadable("reading its header crashes the reader")

    def _running(self) -> subprocess.Popen[bytes]:
        """The child; a new one if there is none or it has served enough files."""
        if self._child is not None and (self._child.poll() is not None or self._served >= CHILD_FILES):
            self._end()
        if self._child is None:
            secrets = {name for name in os.environ if name.startswith("GABLEWORK_")}
            env = {name: value for name, value in os.environ.items() if name not in secrets}
            env |= {"OPENBLAS_NUM_THREADS": "1", "RAYON_NUM_THREADS": "1", "PROJ_NETWORK": "OFF"}
            # what it unpacks goes with it, also if it is killed
            env["TMPDIR"] = str(self._held.enter_context(temporary_folder()))
            self._child = subprocess.Popen(  # noqa: S603 - our own module, no shell
                [sys.executable, "-m", "service.preflight", str(self._memory_bytes)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                bufsize=0,
                env=env,
            )
            self._served = 0
        return self._child

    def _end(self) -> None:
        """End the child, if there is one."""
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._held.close()


_quick_examiner, _slow_examiner = Examiner(), Examiner()


@atexit.register
def end_examiners() -> None:
    """End the children of this process that examine files; the next file starts another one."""
    for examiner in (_quick_examiner, _slow_examiner):
        examiner.close()


def is_quick(path: Path) -> bool:
    """Whether a file is examined in a moment: it is small, or only its header is read."""
    has_bounds = any(path.suffix.lower() in form.suffixes for form in FORMATS if form.has_bounds)
    return has_bounds or path.stat().st_size <= QUICK_BYTES


def preflight(path: Path, max_points: int) -> Mapping[str, Any]:
    """The content of a file's header, read by a child of this process; as `examine`, but errors name only the file.

    Quick files have a child of their own, so they do not wait for files that are read through.
    """
    examiner = _quick_examiner if is_quick(path) else _slow_examiner
    try:
        return examiner.examine(path, max_points=max_points)
    except InputError as fault:
        raise type(fault)(path.name, fault.problem, fault.fix) from None


_FAULTS: dict[str, type[InputError]] = {
    fault.__name__: fault for fault in (InputError, UnreadableInputError, EmptyInputError, CrsError)
}


def _unreadable(problem: str) -> dict[str, Any]:
    """The answer for a file that ended the child."""
    return {"kind": UnreadableInputError.__name__, "problem": problem, "fix": REFUSED}


def _line_of(stream: IO[bytes], deadline_s: float) -> bytes:
    """The child's output up to the end of the line, or to its own end."""
    line = bytearray()
    # select fails for file descriptors above 1023, and a service has many connections
    poll = select.poll()
    poll.register(stream, select.POLLIN)
    while not line.endswith(b"\n"):
        if not poll.poll(max(deadline_s - time.monotonic(), 0.0) * 1e3):
            raise TimeoutError
        piece = os.read(stream.fileno(), 65_536)
        if not piece:
            break
        line += piece
    return bytes(line)


def _answer(request: Mapping[str, Any]) -> dict[str, Any]:
    """The child's answer to one request."""
    path = Path(request["path"])
    try:
        return {"facts": examine(path, max_points=request["max_points"])}
    except TooLargeError as fault:
        return {"kind": TooLargeError.__name__, "problem": str(fault)}
    except InputError as fault:
        kind = type(fault).__name__
        return {
            "kind": kind if kind in _FAULTS else UnreadableInputError.__name__,
            "problem": fault.problem,
            "fix": fault.fix,
        }


def main() -> None:
    """The child: one request per line in, one answer per line out, until the parent closes the pipe."""
    import resource

    memory_bytes = int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin.buffer:
        sys.stdout.buffer.write(json.dumps(_answer(json.loads(line)), allow_nan=False).encode() + b"\n")
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
