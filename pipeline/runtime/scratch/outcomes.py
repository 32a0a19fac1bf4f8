"""What tasks found, kept under a key of all that it depends on: nothing is done twice, within a run or between runs.

A task's outcome lies in scratch at `kept/<stage>/<unit>/<key>`: the unit is what the task is about (an input file, a
tile), the key a digest of everything that can change the outcome, versions and settings included. The outcome is put
by the worker, whole and last, after whatever else the task leaves in scratch. Where it is there, the task need not
run: so a run that was cut off goes on where it stopped, and a later run does again only what changed. (The build
systems à la carte of Mokhov, Mitchell and Peyton Jones 2018 call this a constructive trace.)

What a task leaves beside its outcome lies at the unit's own place and is replaced by the unit's next task, so outcomes
of other keys go before that task starts.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import enum
import functools
import hashlib
import pickle
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import shapely

from pipeline.errors import RunCancelledError, RunError
from pipeline.runtime.monitoring.versions import fingerprint
from pipeline.runtime.scratch.folder import Scratch

Task = TypeVar("Task")
Result = TypeVar("Result")
Told = TypeVar("Told")

FOLDER = "kept"
"""Of scratch."""
_KEY_DIGITS = 40
"""Hexadecimal digits of a key: 160 bits."""


def key_of(*parts: object) -> str:
    """Digest of all that an outcome depends on, and of the versions of this process.

    Dataclasses, enums, mappings, sequences, numbers, texts, times, geometries and arrays are told apart by type and
    value, and hashed alike in every process.

    Raises
    ------
    TypeError
        A part is of a kind whose content is not known: it must not be left out in silence.

    >>> key_of(1, "a") == key_of(1, "a"), key_of(1) == key_of(1.0), key_of(("a", "b")) == key_of("ab")
    (True, False, False)
    """
    digest = hashlib.sha256(fingerprint().encode())
    for part in parts:
        _add(digest.update, part)
    return digest.hexdigest()[:_KEY_DIGITS]


@functools.cache
def _fields_of(kind: Any) -> tuple[bytes, tuple[tuple[str, bytes], ...]]:
    """Bytes that go before the values of a dataclass: its name, and each field's. A city's keys ask a million times."""
    names = [field.name for field in dataclasses.fields(kind)]
    return f"{kind.__name__} {len(names)} ".encode(), tuple((name, _plain(name)) for name in names)


def _plain(value: object) -> bytes:
    text = value if isinstance(value, bytes) else str(value).encode()
    return f"{type(value).__name__} {len(text)} ".encode() + text


def _add(update: Callable[[bytes], None], value: object) -> None:
    if type(value) is float:  # most are
        update(b"float " + struct.pack("<d", value))
    elif value is None or isinstance(value, bool | int | str | bytes | dt.date):
        update(_plain(value))
    elif isinstance(value, enum.Enum):
        _add(update, (type(value).__name__, value.name))
    elif isinstance(value, float):
        update(b"float " + struct.pack("<d", value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        head, fields = _fields_of(type(value))
        update(head)
        for name, told in fields:
            update(told)
            _add(update, getattr(value, name))
    elif isinstance(value, Mapping):
        update(f"mapping {len(value)} ".encode())
        for name in sorted(value):
            _add(update, name)
            _add(update, value[name])
    elif isinstance(value, shapely.Geometry):
        _add(update, shapely.to_wkb(value, include_srid=True))
    elif isinstance(value, np.ndarray):
        _add(update, (value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()))
    elif isinstance(value, Sequence):
        update(f"sequence {len(value)} ".encode())
        for entry in value:
            _add(update, entry)
    else:
        raise TypeError(f"the content of a {type(value).__name__} is not known to key_of")


@dataclasses.dataclass(frozen=True)
class Place:
    """Where an outcome is kept."""

    stage: str
    """Of the run; variants of one stage share it, since their keys differ."""
    unit: str
    """What the task is about; a name that can be a file's."""
    key: str
    """From `key_of`."""

    @property
    def name(self) -> str:
        """Name in scratch."""
        return f"{FOLDER}/{self.stage}/{self.unit}/{self.key}"


def whole(result: Result) -> Result:
    """Tells all of a result, where it is little."""
    return result


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Keeping(Generic[Task, Result, Told]):
    """A task whose outcome is to be kept."""

    function: Callable[[Task], Result]
    """What to do."""
    task: Task
    """Its one argument."""
    place: Place
    """Where the outcome goes."""
    scratch: Scratch
    """Of the run."""
    told: Callable[[Result], Told]
    """What of the result travels to the driver: little."""
    stage: str
    """What people call the stage."""

    @property
    def memory_bytes(self) -> int:
        """What the task declares to need."""
        return int(getattr(self.task, "memory_bytes", 0))

    @property
    def supervises(self) -> bool:
        """Whether the task runs its items in child processes of its own."""
        return bool(getattr(self.task, "supervises", False))

    def __repr__(self) -> str:
        """The task alone, which is what people want to see."""
        return repr(self.task)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kept(Generic[Told]):
    """An outcome that is kept."""

    place: Place
    """Where."""
    told: Told
    """What the driver learns of it."""


def keep(work: Keeping[Task, Result, Told]) -> Kept[Told]:
    """Do a task and keep its outcome.

    Raises
    ------
    RunCancelledError
        The run was called off.
    RunError
        Scratch or results cannot be read or written; what was kept before stays.
    """
    try:
        result = work.function(work.task)
        told = work.told(result)
        work.scratch.put_bytes(work.place.name, _packed(told, result))
    except OSError as error:
        work.scratch.check_cancelled()  # of a run that is over the folders may be gone
        where = error.filename or work.scratch.root
        why = error.strerror or f"a file could not be written whole ({error})"
        raise RunError(
            f"{where}: {why}, in stage {work.stage}. Free space or mend the storage, then run again"
        ) from error
    return Kept(place=work.place, told=told)


def _packed(told: object, result: object) -> bytes:
    """Both as one pickle after the other, so that the first can be read alone."""
    first = pickle.dumps(told, protocol=pickle.HIGHEST_PROTOCOL)
    second = b"" if result is told else pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)
    return len(first).to_bytes(8, "little") + first + second


def told_of(scratch: Scratch, place: Place) -> Any:
    """What a kept outcome tells the driver. Of our own scratch only: pickles run code."""
    with Path(scratch.root, place.name).open("rb") as stream:
        size = int.from_bytes(stream.read(8), "little")
        return pickle.loads(stream.read(size))  # noqa: S301


def result_of(scratch: Scratch, place: Place) -> Any:
    """A kept result, whole. Of our own scratch only: pickles run code.

    Raises
    ------
    RunCancelledError
        It is gone, and with it the run.
    """
    try:
        content = Path(scratch.root, place.name).read_bytes()
    except FileNotFoundError:
        scratch.check_cancelled()
        raise RunCancelledError(f"{place.name} is gone from {scratch.root}: another run works there") from None
    first = 8 + int.from_bytes(content[:8], "little")
    return pickle.loads(content[first:] or content[8:first])  # noqa: S301


class Keeper:
    """Knows what is kept in a scratch folder.

    Parameters
    ----------
    scratch : Scratch
        Of the run.
    """

    def __init__(self, scratch: Scratch) -> None:
        self._scratch = scratch

    def units(self, stage: str) -> list[str]:
        """Units that any outcome of a stage is kept of, sorted."""
        return sorted(entry.name for entry in _entries(self._scratch, f"{FOLDER}/{stage}"))

    def keys(self, stage: str, unit: str) -> set[str]:
        """Keys of the outcomes that are kept of a unit."""
        return {entry.name for entry in _entries(self._scratch, f"{FOLDER}/{stage}/{unit}") if entry.name[0] != "."}

    def drop_others(self, stage: str, unit: str, wanted: Iterable[str]) -> None:
        """Remove the outcomes of a unit but those of some keys."""
        for key in self.keys(stage, unit) - set(wanted):
            Path(self._scratch.root, Place(stage, unit, key).name).unlink(missing_ok=True)


def _entries(scratch: Scratch, name: str) -> list[Path]:
    folder = Path(scratch.root, name)
    try:
        return list(folder.iterdir())
    except FileNotFoundError:
        return []
