"""Stored outcomes of tasks, each under a key of all that it depends on: nothing is done twice, not even by later runs.

The outcome of a task lies in scratch at `kept/<stage>/<unit>/<key>`. The unit is what the task is about (an input file,
a tile); the key is a digest of everything that can change the outcome, including versions and settings. The worker
writes the outcome whole and last, after all other files that the task leaves in scratch. A task with a stored outcome
need not run: an interrupted run resumes where it stopped, and a later run repeats only what changed. (Mokhov, Mitchell
and Peyton Jones 2018, Build systems à la carte, call this a constructive trace.)

An outcome has a brief, the small part that travels to the driver, and a result, which the tasks of later stages read:
whole, or part by part (`InParts`).
The other files that a task leaves belong to its unit, and the unit's next task replaces them. Outcomes of other keys
are therefore removed before that task starts.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import enum
import functools
import hashlib
import itertools
import marshal
import os
import pickle
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

import numpy as np
import shapely

from pipeline.errors import RunError, RunOverError
from pipeline.runtime.monitoring.versions import fingerprint
from pipeline.runtime.scratch.folder import Scratch

Task = TypeVar("Task")
Result = TypeVar("Result")
Brief = TypeVar("Brief")

FOLDER = "kept"
"""Folder of scratch for all outcomes."""
_FORMAT = 12
"""Part of every key, to be raised when the class of an outcome moves or gets another content: the pickles of an older
checkout of the same version are then not read."""
_MARSHAL = 2
"""Format of what keys are made from: the last one in which equal values have equal bytes, however they came about."""
_AS_IT_IS = frozenset({float, int, str, bytes, bool, type(None)})
"""Types that marshal writes by value."""
_LARGE = 2**24
"""Bytes of an array from which a key holds its digest in its place: marshal writes 2 GB at once at most."""
_KEY_DIGITS = 40
"""Hexadecimal digits of a key: 160 bits."""
_HEAD = struct.Struct("<QQII")
"""Before a stored outcome: the bytes of the whole file and of the brief, the checksums of brief and result."""
_PART = struct.Struct("<QQI")
"""Where a part begins and ends in the file, and its checksum."""


class DamagedError(RunError):
    """A stored outcome is not as it was written."""


def key_of(*parts: object) -> str:
    """Digest of all that an outcome depends on, and of the versions of this process.

    Dataclasses, enums, mappings, sequences, numbers, texts, times, geometries and arrays are hashed by type and value,
    alike in every process. Raises TypeError for a part of an unknown kind, which must not be left out in silence.

    >>> key_of(1, "a") == key_of(1, "a"), key_of(1) == key_of(1.0), key_of(("a", "b")) == key_of("ab")
    (True, False, False)
    """
    content = marshal.dumps((_FORMAT, fingerprint(), *map(_plain, parts)), _MARSHAL)
    return hashlib.sha256(content).hexdigest()[:_KEY_DIGITS]


def _plain(value: object) -> Any:
    """A value as numbers, texts, bytes and lists, which marshal writes; all else is a tuple that begins with its kind.

    Raises TypeError as `key_of`.
    """
    kind: Any = type(value)
    if kind in _AS_IT_IS:
        return value
    if isinstance(value, np.ndarray):
        content = value.tobytes()
        if len(content) >= _LARGE:
            content = hashlib.sha256(content).digest()
        return "array", value.dtype.str, value.shape, content
    if isinstance(value, enum.Enum):
        return "enum", kind.__name__, value.name
    if isinstance(value, float):
        return float(value)
    if isinstance(value, int | str | bytes | dt.date):
        return "text", kind.__name__, str(value)
    if isinstance(value, shapely.Geometry):
        return "geometry", shapely.to_wkb(value, include_srid=True)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = _names_of(kind)
        return "fields", kind.__name__, names, *[_plain(getattr(value, name)) for name in names]
    if isinstance(value, tuple | Sequence):  # tuple, since a Sequence takes longer to find
        return list(map(_plain, value))
    if isinstance(value, Mapping):
        return "mapping", *((_plain(name), _plain(value[name])) for name in sorted(value))
    raise TypeError(f"the content of a {kind.__name__} is not known to key_of")


@functools.cache
def _names_of(kind: Any) -> tuple[str, ...]:
    """The names of the fields of a dataclass."""
    return tuple(field.name for field in dataclasses.fields(kind))


@dataclasses.dataclass(frozen=True, slots=True)
class Place:
    """Where an outcome is stored."""

    stage: str
    """Stage of the run; its variants share the stage, since their keys differ."""
    unit: str
    """What the task is about; must be valid as a file name."""
    key: str
    """From `key_of`."""

    @property
    def name(self) -> str:
        """Name in scratch."""
        return f"{self.folder}/{self.key}"

    @property
    def folder(self) -> str:
        """Folder in scratch of the outcomes of its unit."""
        return f"{FOLDER}/{self.stage}/{self.unit}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class InParts(Generic[Brief]):
    """A result of which only the brief and the parts are stored; each part can be read alone by `part_of`."""

    parts: tuple[Any, ...]
    """Its parts."""
    brief: Brief
    """What travels to the driver."""


def brief_within(result: InParts[Brief]) -> Brief:
    """The brief of a result in parts."""
    return result.brief


def whole(result: Result) -> Result:
    """The brief of a small result: all of it."""
    return result


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class OutcomeTask(Generic[Task, Result, Brief]):
    """A task, and where its outcome will be stored."""

    function: Callable[[Task], Result]
    """What to do."""
    task: Task
    """Its one argument."""
    place: Place
    """Where the outcome is stored."""
    scratch: Scratch
    """The run's scratch."""
    brief: Callable[[Result], Brief]
    """The small part of the result that travels to the driver."""
    stage: str
    """Name of the stage in messages."""

    @property
    def memory_bytes(self) -> int:
        """Memory that the task declares to need."""
        return int(getattr(self.task, "memory_bytes", 0))

    @property
    def supervises(self) -> bool:
        """Whether the task runs its items in child processes of its own."""
        return bool(getattr(self.task, "supervises", False))

    def __repr__(self) -> str:
        """The task alone, for messages."""
        return repr(self.task)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredOutcome(Generic[Brief]):
    """A stored outcome, as the driver sees it."""

    place: Place
    """Where it is."""
    brief: Brief
    """The small part of its result."""


def run_and_store(work: OutcomeTask[Task, Result, Brief]) -> StoredOutcome[Brief]:
    """Run a task and store its outcome.

    Raises RunError if scratch or results cannot be read or written; earlier outcomes stay.
    """
    work.scratch.beat()
    try:
        result = work.function(work.task)
        brief = work.brief(result)
        work.scratch.put_bytes(work.place.name, _packed(brief, result))
    except OSError as error:
        work.scratch.check_cancelled()  # the folders of a run that is over may be gone
        where = error.filename or work.scratch.root
        why = error.strerror or f"a file could not be written whole ({error})"
        raise RunError(
            f"{where}: {why}, in stage {work.stage}. Free space or mend the storage, then run again"
        ) from error
    return StoredOutcome(place=work.place, brief=brief)


def _packed(brief: object, result: object) -> bytes:
    """The two pickles one after the other, so that the brief can be read alone; in place of the second, the parts.

    Before the parts is a table of where each lies in the file, with its checksum.
    """
    first = pickle.dumps(brief, protocol=pickle.HIGHEST_PROTOCOL)
    if isinstance(result, InParts):
        pieces = [pickle.dumps(part, protocol=pickle.HIGHEST_PROTOCOL) for part in result.parts]
        begin = _HEAD.size + len(first) + _PART.size * len(pieces)
        edges = itertools.pairwise(itertools.accumulate(map(len, pieces), initial=begin))
        table = (_PART.pack(*edge, zlib.crc32(piece)) for edge, piece in zip(edges, pieces, strict=True))
        second = b"".join((*table, *pieces))
    else:
        second = b"" if result is brief else pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)
    size = _HEAD.size + len(first) + len(second)
    return _HEAD.pack(size, len(first), zlib.crc32(first), zlib.crc32(second)) + first + second


def brief_of(scratch: Scratch, place: Place) -> Any:
    """The brief of a stored outcome; raises DamagedError. Only for our own scratch: pickles run code."""
    with Path(scratch.root, place.name).open("rb") as stream:
        return pickle.loads(_first_of(stream, place)[0])  # noqa: S301


def result_of(scratch: Scratch, place: Place) -> Any:
    """The result of a stored outcome. Only for our own scratch: pickles run code.

    Raises
    ------
    RunOverError
        The outcome is gone, and the run with it.
    DamagedError
        It is not as it was written.
    """
    with _opened(scratch, place) as stream:
        first, second = _whole_of(stream, place)
    return pickle.loads(second or first)  # noqa: S301


def part_of(scratch: Scratch, place: Place, number: int) -> Any:
    """A part of a stored result that is `InParts`, counted from 0; the others are not read.

    Raises the errors of `result_of`.
    """
    with _opened(scratch, place) as stream:
        start = _HEAD.size + _head_of(stream, place)[0]
        stream.seek(start + _PART.size * number)
        entry = stream.read(_PART.size)
        begin, end, checksum = _PART.unpack(entry) if len(entry) == _PART.size else (0, 0, 1)
        content = b""
        if begin <= end <= os.fstat(stream.fileno()).st_size:
            stream.seek(begin)
            content = stream.read(end - begin)
    if zlib.crc32(content) != checksum:
        raise _damaged(place)
    return pickle.loads(content)  # noqa: S301


def check_outcome(scratch: Scratch, place: Place) -> None:
    """Raise DamagedError if a stored outcome is not as it was written; the errors of `result_of`."""
    with _opened(scratch, place) as stream:
        _whole_of(stream, place)


def _head_of(stream: BinaryIO, place: Place) -> tuple[int, int, int]:
    """Bytes of the brief, and the checksums of brief and result; the file has the length that it was written with."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise _damaged(place)
    size, first, *checksums = _HEAD.unpack(head)
    if os.fstat(stream.fileno()).st_size != size or _HEAD.size + first > size:
        raise _damaged(place)
    return first, checksums[0], checksums[1]


def _first_of(stream: BinaryIO, place: Place) -> tuple[bytes, int]:
    """The pickled brief, and the checksum of what follows it."""
    size, checksum, of_rest = _head_of(stream, place)
    first = stream.read(size)
    if zlib.crc32(first) != checksum:
        raise _damaged(place)
    return first, of_rest


def _whole_of(stream: BinaryIO, place: Place) -> tuple[bytes, bytes]:
    """The pickled brief and what follows it."""
    first, checksum = _first_of(stream, place)
    rest = stream.read()
    if zlib.crc32(rest) != checksum:
        raise _damaged(place)
    return first, rest


def _damaged(place: Place) -> DamagedError:
    return DamagedError(f"{place.name} in the scratch folder is damaged. Run again: its task is then repeated")


@contextlib.contextmanager
def _opened(scratch: Scratch, place: Place) -> Iterator[BinaryIO]:
    """The file of an outcome."""
    try:
        stream = Path(scratch.root, place.name).open("rb")  # noqa: SIM115 - closed below
    except FileNotFoundError:
        scratch.check_cancelled()
        raise RunOverError(f"{place.name} is gone from {scratch.root}: another run works there") from None
    with stream:
        yield stream


def keys_of(scratch: Scratch, stage: str, unit: str) -> list[str]:
    """Keys of the stored outcomes of a unit, sorted."""
    return [name for name in _names(scratch, f"{FOLDER}/{stage}/{unit}") if name[0] != "."]


def stored_units(scratch: Scratch, stage: str) -> list[str]:
    """The units of a stage that have outcomes or had some, sorted."""
    return _names(scratch, f"{FOLDER}/{stage}")


def drop_outcomes(scratch: Scratch, stage: str, wanted: Iterable[Place]) -> None:
    """Remove the stored outcomes of a stage except the wanted ones."""
    names = {place.name for place in wanted}
    for unit in stored_units(scratch, stage):
        for key in keys_of(scratch, stage, unit):
            name = Place(stage, unit, key).name
            if name not in names:
                Path(scratch.root, name).unlink(missing_ok=True)


def _names(scratch: Scratch, folder: str) -> list[str]:
    """Names in a folder of scratch, sorted; none where it does not exist."""
    try:
        return sorted(entry.name for entry in Path(scratch.root, folder).iterdir())
    except FileNotFoundError:
        return []


def _nothing(*_: object) -> tuple[str, ...]:
    return ()


def all_there(*_: object) -> bool:
    """Files that need no check."""
    return True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Files(Generic[Task, Brief]):
    """What the tasks of a stage read and leave in scratch, by folders there; the functions see one task at a time."""

    reads: Callable[[Task], Iterable[str]] = _nothing
    """Folders with files of earlier stages that a task reads."""
    leaves: Callable[[Task, Brief], Iterable[str]] = _nothing
    """Folders in which later stages read what a task left; that of its outcome need not be named."""
    intact: Callable[[Task, Brief, str], bool] = all_there
    """Whether the files in one of these folders are as the task left them, by its brief. Runs in a worker."""
    results: bool = False
    """Whether every run reads the results of all tasks: outcomes of earlier runs are then checked to their end."""
    at_once: bool = False
    """Whether the files of earlier runs are checked when the stage begins, since every run relies on all of them."""
