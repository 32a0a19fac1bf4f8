"""The scratch folder of a run: points by tile, fragments, terrain, models to publish.

It has plain files of fixed records and is visible to all workers. Every file is written under a temporary name and
renamed, so a task may run twice or die half way.

The folder may outlive a run. Each attempt at a run then has a mark of its own there, and removes the mark of the one
before. Tasks of a driver that died may still run somewhere; without their mark they write nothing.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import math
import mmap
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal
from uuid import uuid4

import numpy as np
import numpy.typing as npt

from pipeline.errors import RunCancelledError, RunOverError

POINT = np.dtype(
    [
        ("x", "<i8"),
        ("y", "<i8"),
        ("z", "<i4"),
        ("source", "<u2"),
        ("return_number", "u1"),
        ("return_count", "u1"),
        ("gps_time", "<f8"),
        ("classification", "u1"),
    ]
)
"""A point in scratch: absolute millimetres and the attributes of `PointCloud`."""


_CANCELLED = "cancelled"
ATTEMPTS = "attempts"
"""Folder with the mark of the attempt at a run that works in scratch which outlives its runs."""
PULSE = "pulse"
"""File whose time of change says when a task of a run last got somewhere, in scratch that outlives its runs."""
_BEAT_S = 1.0
_beaten_s: dict[str, float] = {}
"""When this process last wrote it, by the folder of scratch."""
_LONGEST_HEADER_BYTES = 256
"""Enough for the arrays stored here, numbers of up to three dimensions."""


def _layout(head: bytes) -> tuple[np.dtype[Any], tuple[int, ...], Literal["C", "F"], int]:
    """Type, shape, order and place of the array in a file of format npy 1.0, by its first bytes."""
    offset = 10 + int.from_bytes(head[8:10], "little")
    return _parsed(head[:offset])


@functools.lru_cache(maxsize=256)
def _parsed(header: bytes) -> tuple[np.dtype[Any], tuple[int, ...], Literal["C", "F"], int]:
    """As `_layout`, from a whole header; cached, since numpy takes longer for it than for the array."""
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(io.BytesIO(header[8:]))
    return dtype, shape, "F" if fortran else "C", len(header)


@dataclasses.dataclass(frozen=True)
class Scratch:
    """A folder for the duration of a run."""

    root: str
    """Path of the folder; a string, so that tasks stay small and picklable."""
    attempt: str = ""
    """Name of the attempt at a run in a folder that outlives it; empty where the folder ends with the run."""

    @property
    def name(self) -> str:
        """Name of the run in logs: the attempt, or the folder's own name."""
        return self.attempt or Path(self.root).name

    def create(self) -> None:
        """Make the folder, once, when the run starts; no task ever makes it again.

        A folder that outlives its runs is taken over from the attempts before.
        """
        Path(self.root).mkdir(parents=True, exist_ok=True)
        if self.attempt:
            folder = Path(self.root, ATTEMPTS)
            folder.mkdir(exist_ok=True)
            for earlier in folder.iterdir():
                earlier.unlink(missing_ok=True)
            (folder / self.attempt).touch()

    def path(self, *parts: str) -> Path:
        """A path inside; its folder exists afterwards. Raises RunOverError if scratch, and the run, is gone."""
        path = os.path.join(self.root, *parts)  # noqa: PTH118 - a Path takes longer
        folder = os.path.dirname(path)  # noqa: PTH120
        if not os.path.isdir(folder):  # noqa: PTH112
            self._make(folder)
        return Path(path)

    def _make(self, folder: str) -> None:
        """Make a folder inside and those above it, but never the scratch folder itself."""
        try:
            for above in reversed(Path(folder, "any").relative_to(self.root).parents[:-1]):
                Path(self.root, above).mkdir(exist_ok=True)
        except FileNotFoundError:
            raise RunOverError(f"{self.root} is gone: the run is over") from None

    def put_arrays(self, name: str, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Store arrays, one file each under the folder `name`, so that they can be mapped."""
        for key, array in arrays.items():
            target = self.path(name, f"{key}.npy")
            temporary = target.with_name(f".{key}.{uuid4().hex}.npy")
            try:
                np.save(temporary, array, allow_pickle=False)
                self.check_cancelled()
                temporary.replace(target)
            finally:
                temporary.unlink(missing_ok=True)

    def array(self, name: str, key: str, *, mapped: bool = False) -> npt.NDArray[Any]:
        """One stored array, read whole or mapped."""
        with open(f"{self.root}/{name}/{key}.npy", "rb", buffering=0) as stream:  # noqa: PTH123 - a Path takes longer
            dtype, shape, order, offset = _layout(stream.read(_LONGEST_HEADER_BYTES))
            size = math.prod(shape)
            flat: npt.NDArray[Any]
            if mapped and size:
                content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
                flat = np.frombuffer(content, dtype, size, offset)
            else:
                stream.seek(offset)
                flat = np.fromfile(stream, dtype, size)
        return flat.reshape(shape, order=order)

    def rows(self, name: str, key: str, start: int, stop: int) -> npt.NDArray[Any]:
        """Some rows of a stored array, whose others are not read; raises ValueError if the file ends before them."""
        with open(f"{self.root}/{name}/{key}.npy", "rb", buffering=0) as stream:  # noqa: PTH123 - a Path takes longer
            dtype, shape, _, offset = _layout(stream.read(_LONGEST_HEADER_BYTES))
            width = math.prod(shape[1:])
            stream.seek(offset + start * width * dtype.itemsize)
            return np.fromfile(stream, dtype, (stop - start) * width).reshape(stop - start, *shape[1:])

    def has(self, name: str) -> bool:
        """Whether anything is stored under a name; raises OSError if the file system fails, which is no answer."""
        try:
            os.stat(f"{self.root}/{name}")  # noqa: PTH116 - asked for every item, and a path takes longer to make
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def put_bytes(self, name: str, content: bytes) -> None:
        """Store bytes under a name, whole or not at all.

        Raises RunCancelledError if the run was cancelled, or another took its place.
        """
        target = self.path(name)
        temporary = target.with_name(f".{target.name}.{uuid4().hex}")
        try:
            temporary.write_bytes(content)
            self.check_cancelled()
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)

    def cancel(self) -> None:
        """Mark the run as cancelled; its tasks look for the mark wherever they can stop.

        Where the mark cannot be set, because the folder is gone or the disk is full, the folder's removal ends them.
        """
        with contextlib.suppress(OSError):
            if self.attempt:
                self._mark.unlink(missing_ok=True)
            else:
                Path(self.root, _CANCELLED).touch()

    @property
    def _mark(self) -> Path:
        return Path(self.root, ATTEMPTS, self.attempt)

    @property
    def cancelled(self) -> bool:
        """Whether the run was cancelled, or is over: then its folder is gone, or another attempt took it over."""
        if self.attempt:
            return not self.has(f"{ATTEMPTS}/{self.attempt}")
        return self.has(_CANCELLED) or not self.has(".")

    def check_cancelled(self) -> None:
        """Raise as `check_mark` in a task of a run that is over; a task that goes on has got somewhere."""
        self.check_mark()
        self.beat()

    def check_mark(self) -> None:
        """Raise `RunCancelledError` if the run was cancelled, `RunOverError` where its mark is gone. No progress."""
        if not self.cancelled:
            return
        if not self.attempt and self.has(_CANCELLED):
            raise RunCancelledError("the run was cancelled")
        raise RunOverError(f"the run in {self.root} is over: it was cancelled, or the folder was removed")

    def beat(self) -> None:
        """Note that a task got somewhere, where others may watch for that: at most once a second per process."""
        now_s = time.monotonic()
        if self.attempt and now_s - _beaten_s.get(self.root, -_BEAT_S) >= _BEAT_S:
            _beaten_s.clear()
            _beaten_s[self.root] = now_s
            # a beat that is missed is noted a second later; scratch that is gone needs none
            with contextlib.suppress(OSError):
                Path(self.root, PULSE).touch()


@dataclasses.dataclass(frozen=True)
class OpenScratch(Scratch):
    """The same folder for one batch of items, of which many read the same arrays: each array is opened once.

    For as long as nothing writes to these arrays. It travels to other processes closed.
    """

    _held: dict[tuple[str, str], npt.NDArray[Any]] = dataclasses.field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _seen: set[str] = dataclasses.field(default_factory=set, init=False, repr=False, compare=False)

    def __reduce__(self) -> tuple[type[OpenScratch], tuple[str, str]]:
        """Only the place of the folder."""
        return OpenScratch, (self.root, self.attempt)

    def array(self, name: str, key: str, *, mapped: bool = False) -> npt.NDArray[Any]:
        """One stored array, mapped once if it is large."""
        found = self._held.get((name, key))
        if found is None:
            found = self._held[name, key] = super().array(name, key, mapped=mapped)
            self._seen.add(name)
        return found

    def has(self, name: str) -> bool:
        """Whether anything is stored under a name; not asked again where an array was read from."""
        return name in self._seen or super().has(name)

    def rows(self, name: str, key: str, start: int, stop: int) -> npt.NDArray[Any]:
        """Some rows of a stored array; raises ValueError if the file ends before them."""
        found = self.array(name, key, mapped=True)[start:stop]
        if len(found) != stop - start:
            raise ValueError(f"{name}/{key} ends before row {stop}")
        return found
