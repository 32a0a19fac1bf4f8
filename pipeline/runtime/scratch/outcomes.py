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
import os
import pickle
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

import numpy as np
import shapely

from pipeline.errors import RunCancelledError, RunError
from pipeline.runtime.monitoring.versions import fingerprint
from pipeline.runtime.scratch.folder import Scratch

Task = TypeVar("Task")
Result = TypeVar("Result")
Brief = TypeVar("Brief")

FOLDER = "kept"
"""Folder of scratch for all outcomes."""
_FORMAT = 8
"""Part of every key, to be raised when the class of an outcome moves or gets another content: the pickles of an older
checkout of the same version are then not read."""
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
    digest = hashlib.sha256(f"{_FORMAT};{fingerprint()}".encode())
    for part in parts:
        _add(digest.update, part)
    return digest.hexdigest()[:_KEY_DIGITS]


@functools.cache
def _fields_of(kind: Any) -> tuple[bytes, tuple[tuple[str, bytes], ...]]:
    """Bytes that precede the values of a dataclass: its name, and each field's. Cached: a city's keys need millions."""
    names = [field.name for field in dataclasses.fields(kind)]
    return f"{kind.__name__} {len(names)} ".encode(), tuple((name, _plain(name)) for name in names)


def _plain(value: object) -> bytes:
    text = value if isinstance(value, bytes) else str(value).encode()
    return f"{type(value).__name__} {len(text)} ".encode() + text


def _add(update: Callable[[bytes], None], value: object) -> None:
    kind = type(value)
    if kind is float:  # the usual kinds first, and without a look at what else they might be
        update(b"float " + struct.pack("<d", value))
    elif kind is int or kind is str:
        text = str(value).encode()
        update(b"%b %d %b" % (kind.__name__.encode(), len(text), text))
    elif isinstance(value, tuple):
        _add_sequence(update, value)
    elif value is None or isinstance(value, bool | int | str | bytes | dt.date):
        update(_plain(value))
    elif isinstance(value, enum.Enum):
        _add(update, (type(value).__name__, value.name))
    elif isinstance(value, float):
        update(b"float " + struct.pack("<d", value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        head, fields = _fields_of(type(value))
        update(head)
        for name, name_bytes in fields:
            update(name_bytes)
            _add(update, getattr(value, name))
    elif isinstance(value, Mapping):
        update(f"mapping {len(value)} ".encode())
        for name in sorted(value):
            _add(update, name)
            _add(update, value[name])
    elif isinstance(value, shapely.Geometry):
        _add(update, shapely.to_wkb(value, include_srid=True))
    elif isinstance(value, np.ndarray):
        update(f"array {value.dtype.str} {value.shape} ".encode())
        update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Sequence):
        _add_sequence(update, value)
    else:
        raise TypeError(f"the content of a {kind.__name__} is not known to key_of")


def _add_sequence(update: Callable[[bytes], None], values: Sequence[object]) -> None:
    update(b"sequence %d " % len(values))
    for value in values:
        _add(update, value)


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
    RunCancelledError
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
        raise RunCancelledError(f"{place.name} is gone from {scratch.root}: another run works there") from None
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
