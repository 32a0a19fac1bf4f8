"""Writing the files of compiled kernels: see `pipeline.compiler.store`, which reads them."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import json
import os
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from pipeline.compiler import store
from pipeline.compiler.store import ENDING, LIST, Stored

_LOCKS = "locks"
_LOCK_RANGE = 2**30


def warn_of_misfits(name: str) -> None:
    """Warn once if the package has compiled kernels and this one has to be compiled nevertheless."""
    if store.shipped_hashes():
        store.warn(
            f"kernels are compiled, {name} first: those in {store.shipped_folder()} were made for another Python, "
            "numba or processor, or are called in a new way",
            once="misfit",
        )


def save(name: str, fingerprint: bytes, stored: Stored) -> None:
    """Store a compiled kernel for later processes; if nothing can be written, warn once and continue."""
    folder = store.folder_of_kernels()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part = folder / f".{name}.{os.getpid()}.part"
        try:
            part.write_bytes(stored.to_bytes(fingerprint))
            part.replace(folder / (name + ENDING))
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        fault = f"compiled kernels cannot be stored in {folder}: {error.strerror}. Set NUMBA_CACHE_DIR to a folder"
        store.warn(fault, once="cannot be stored")


def can_save() -> bool:
    """Whether compiled kernels can be stored; makes their folder."""
    with contextlib.suppress(OSError):
        store.folder_of_kernels().mkdir(parents=True, exist_ok=True)
    return os.access(store.folder_of_kernels(), os.W_OK)


@contextlib.contextmanager
def claimed(name: str) -> Iterator[None]:
    """Lock a kernel while it is compiled: another process that needs it waits and then finds it compiled.

    If files cannot be locked, both compile it, which costs time and does no harm.
    """
    file = _lock_file()
    if file is None:
        yield
        return
    at = zlib.crc32(name.encode()) % _LOCK_RANGE
    # some file systems have no locks; and if two kernels share a byte, the system reports the deadlock of two processes
    with contextlib.suppress(OSError):
        fcntl.lockf(file, fcntl.LOCK_EX, 1, at)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.lockf(file, fcntl.LOCK_UN, 1, at)


def ship(folder: Path, is_current: Callable[[str, bytes], bool]) -> int:
    """Copy the compiled kernels to a folder for a package, with a list of their hashes; returns the number of files.

    The folder is new or empty. `is_current` says whether a kernel, `module.function`, has a fingerprint; files of
    earlier versions are left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    hashes = {}
    for path in sorted(store.folder_of_kernels().glob(f"*{ENDING}")):
        content = path.read_bytes()
        if is_current(path.name.partition(f".{sys.implementation.cache_tag}-")[0], Stored.fingerprint_of(content)):
            (folder / path.name).write_bytes(content)
            hashes[path.name] = hashlib.sha256(content).hexdigest()
    (folder / LIST).write_text(json.dumps(hashes, indent=0) + "\n", encoding="ascii")
    return len(hashes)


@functools.cache
def _lock_file() -> int | None:
    """The file whose bytes are locked, opened once: closing any descriptor of it would release all locks."""
    try:
        store.folder_of_kernels().mkdir(parents=True, exist_ok=True)
        return os.open(store.folder_of_kernels() / _LOCKS, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return None


# locks belong to a process: a forked one opens the file itself, as its copy of the descriptor may be closed
os.register_at_fork(after_in_child=_lock_file.cache_clear)
