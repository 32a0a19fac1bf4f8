"""The files of compiled kernels: where they are, what they hold, and which may be loaded.

One file holds one kernel for one signature. It begins with the kernel's fingerprint: a file of another fingerprint is
overwritten, never used. Its name says kernel, signature, Python, numba and processor, so that these do not overwrite
each other. Machine code is code: a file that came with an installed package is loaded only if the package's list names
its hash.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import glob
import hashlib
import json
import os
import struct
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

ENDING = ".kernel"
_PACKAGE = Path(__file__).resolve().parents[1]
LIST = "kernels.json"
"""Beside kernels that came with a package or an image: the sha256 of each, by file name."""
_HEADER = struct.Struct("<8s32sQQQ")
_MAGIC = b"gwkern02"
_LOCKS = "locks"
_LOCK_RANGE = 2**30


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stored:
    """What the file of a kernel holds."""

    facts: bytes
    """Pickled: what numba must know of the compiled function."""
    machine_code: bytes
    """An object file; empty where only kernels call this one."""
    bitcode: bytes
    """LLVM's own form, which is linked into kernels that call this one."""

    def packed(self, fingerprint: bytes) -> bytes:
        """The content of the file."""
        lengths = (len(self.facts), len(self.machine_code), len(self.bitcode))
        return _HEADER.pack(_MAGIC, fingerprint, *lengths) + self.facts + self.machine_code + self.bitcode

    @staticmethod
    def fingerprint_of(content: bytes) -> bytes:
        """The fingerprint in a file's head."""
        return content[len(_MAGIC) : len(_MAGIC) + 32]

    @classmethod
    def unpacked(cls, content: bytes, fingerprint: bytes) -> Stored | None:
        """What a file holds; None where it is cut off, or of another fingerprint."""
        if len(content) < _HEADER.size:
            return None
        magic, stamp, facts, code, bitcode = _HEADER.unpack_from(content)
        if magic != _MAGIC or stamp != fingerprint or len(content) != _HEADER.size + facts + code + bitcode:
            return None
        at = _HEADER.size
        return cls(
            facts=content[at : at + facts],
            machine_code=content[at + facts : at + facts + code],
            bitcode=content[at + facts + code :],
        )


def load(name: str, fingerprint: bytes, *, runnable: bool) -> Stored | None:
    """A compiled kernel; None where there is none of this fingerprint.

    Parameters
    ----------
    name : str
        Of the file, without its ending.
    fingerprint : bytes
        Of the kernel, 32 bytes.
    runnable : bool
        Whether it must have machine code: what came with a package may have none where only kernels called it.
    """
    file_name = name + ENDING
    listed = _shipped_hashes().get(file_name)
    for folder in (shipped_folder(), folder_of_kernels()) if listed else (folder_of_kernels(),):
        try:
            content = (folder / file_name).read_bytes()
        except OSError:
            continue
        if folder == shipped_folder() and hashlib.sha256(content).hexdigest() != listed:
            _warn(f"{folder / file_name} is not the file that {LIST} names: this kernel is compiled anew")
            continue
        stored = Stored.unpacked(content, fingerprint)
        if stored is not None and (stored.machine_code or not runnable):
            return stored
    return None


def say_what_does_not_fit(name: str) -> None:
    """Warn once where kernels came with the package and the one that is about to be compiled is not among them."""
    if _shipped_hashes():
        _warn(
            f"kernels are compiled, {name} first: those in {shipped_folder()} were made for another Python, numba or "
            "processor, or are called in a new way",
            once="what came does not fit",
        )


def save(name: str, fingerprint: bytes, stored: Stored) -> None:
    """Keep a compiled kernel for processes to come. Where nothing can be written, warn once and go on."""
    folder = folder_of_kernels()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part = folder / f".{name}.{os.getpid()}.part"
        try:
            part.write_bytes(stored.packed(fingerprint))
            part.replace(folder / (name + ENDING))
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        told = f"compiled kernels cannot be kept in {folder}: {error.strerror}. Name a folder by NUMBA_CACHE_DIR"
        _warn(told, once="cannot be kept")


def is_kept(prefix: str, fingerprint: bytes) -> bool:
    """Whether there is a file of a kernel, for whatever signature and processor; reads its first bytes.

    Parameters
    ----------
    prefix : str
        With which the names of the kernel's files begin.
    fingerprint : bytes
        Of the kernel.
    """
    for folder in (shipped_folder(), folder_of_kernels()):
        for path in folder.glob(f"{glob.escape(prefix)}*{ENDING}"):
            with contextlib.suppress(OSError), path.open("rb") as file:
                head = file.read(_HEADER.size)
                if len(head) == _HEADER.size and _HEADER.unpack(head)[:2] == (_MAGIC, fingerprint):
                    return True
    return False


@contextlib.contextmanager
def claimed(name: str) -> Iterator[None]:
    """Hold a kernel while it is compiled: another process that wants it waits, and finds it compiled then.

    Where files cannot be locked, both compile it, which costs time and harms nothing.
    """
    file = _lock_file()
    if file is None:
        yield
        return
    at = zlib.crc32(name.encode()) % _LOCK_RANGE
    # some file systems have no locks; two kernels may share a byte, so that two processes would wait for each other
    with contextlib.suppress(OSError):
        fcntl.lockf(file, fcntl.LOCK_EX, 1, at)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            fcntl.lockf(file, fcntl.LOCK_UN, 1, at)


def ship(folder: Path, is_current: Callable[[str, bytes], bool]) -> int:
    """Copy what is compiled to a folder with a list of hashes, so that a package can take it along; how many files.

    Parameters
    ----------
    folder : Path
        New or empty.
    is_current : callable
        Whether a kernel, `module.function`, has a fingerprint: what is left of earlier versions stays here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    hashes = {}
    for path in sorted(folder_of_kernels().glob(f"*{ENDING}")):
        content = path.read_bytes()
        if is_current(path.name.partition(f".{sys.implementation.cache_tag}-")[0], Stored.fingerprint_of(content)):
            (folder / path.name).write_bytes(content)
            hashes[path.name] = hashlib.sha256(content).hexdigest()
    (folder / LIST).write_text(json.dumps(hashes, indent=0) + "\n", encoding="ascii")
    return len(hashes)


@functools.cache
def shipped_folder() -> Path:
    """The folder of kernels that came with the package, or that the environment names; never written."""
    named = os.environ.get("GABLEWORK_KERNELS")
    return Path(named) if named else _PACKAGE / "compiled"


@functools.cache
def folder_of_kernels() -> Path:
    """The folder that new files go to: of the environment, beside the sources, or the user's own."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return Path(named)
    if os.access(_PACKAGE, os.W_OK):
        return _PACKAGE / "__pycache__" / "kernels"
    import platformdirs

    return Path(platformdirs.user_cache_dir("gablework")) / "kernels"


@functools.cache
def _shipped_hashes() -> dict[str, str]:
    """The hashes of the files that came with the package, by name."""
    try:
        hashes: dict[str, str] = json.loads((shipped_folder() / LIST).read_text(encoding="ascii"))
    except FileNotFoundError:
        return {}
    return hashes


@functools.cache
def _lock_file() -> int | None:
    """The file whose bytes are locked, opened once: closing any descriptor of it would drop all locks."""
    try:
        folder_of_kernels().mkdir(parents=True, exist_ok=True)
        return os.open(folder_of_kernels() / _LOCKS, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return None


# locks belong to a process: a forked one opens the file for itself, as its copy of the descriptor may be closed
os.register_at_fork(after_in_child=_lock_file.cache_clear)

_said: set[str] = set()


def _warn(text: str, *, once: str = "") -> None:
    """Warn once of each thing."""
    if (once or text) not in _said:
        _said.add(once or text)
        warnings.warn(text, RuntimeWarning, stacklevel=3)
