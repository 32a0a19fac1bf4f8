"""The files of compiled kernels: their place, their content, and which ones may be loaded.

One file holds one kernel for one signature. It begins with the kernel's fingerprint: a file with another fingerprint is
overwritten, never used. Its name contains kernel, signature, Python, numba and processor. As machine code can do
anything, a file of an installed package is loaded only if the package's list contains its hash.
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
"""File beside the kernels of a package or an image: the sha256 of each, by file name."""
_HEADER = struct.Struct("<8s32sQQQ")
_MAGIC = b"gwkern03"
_LOCKS = "locks"
_LOCK_RANGE = 2**30


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stored:
    """Content of the file of a kernel."""

    facts: bytes
    """Numba's description of the compiled function, pickled."""
    machine_code: bytes
    """An object file; empty if only kernels call this one."""
    bitcode: bytes
    """LLVM bitcode, linked into the kernels that call this one."""

    def to_bytes(self, fingerprint: bytes) -> bytes:
        """The bytes of the file."""
        lengths = (len(self.facts), len(self.machine_code), len(self.bitcode))
        return _HEADER.pack(_MAGIC, fingerprint, *lengths) + self.facts + self.machine_code + self.bitcode

    @staticmethod
    def fingerprint_of(content: bytes) -> bytes:
        """The fingerprint in a file's header."""
        return content[len(_MAGIC) : len(_MAGIC) + 32]

    @classmethod
    def from_bytes(cls, content: bytes, fingerprint: bytes) -> Stored | None:
        """Content of a file; None if it is truncated or has another fingerprint."""
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
    """The compiled kernel in the file `name` (without its ending); None if none has this fingerprint of 32 bytes.

    A `runnable` one has machine code, which a kernel lacks if only kernels have called it.
    """
    file_name = name + ENDING
    listed = _shipped_hashes().get(file_name)
    for folder in (shipped_folder(), folder_of_kernels()) if listed else (folder_of_kernels(),):
        try:
            content = (folder / file_name).read_bytes()
        except OSError:
            continue
        if folder == shipped_folder() and hashlib.sha256(content).hexdigest() != listed:
            _warn(f"{folder / file_name} is not the file that {LIST} lists: this kernel is compiled again")
            continue
        stored = Stored.from_bytes(content, fingerprint)
        if stored is not None and (stored.machine_code or not runnable):
            return stored
    return None


def warn_of_misfits(name: str) -> None:
    """Warn once if the package has compiled kernels and this one has to be compiled nevertheless."""
    if _shipped_hashes():
        _warn(
            f"kernels are compiled, {name} first: those in {shipped_folder()} were made for another Python, numba or "
            "processor, or are called in a new way",
            once="misfit",
        )


def save(name: str, fingerprint: bytes, stored: Stored) -> None:
    """Store a compiled kernel for later processes; if nothing can be written, warn once and continue."""
    folder = folder_of_kernels()
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
        _warn(fault, once="cannot be stored")


def can_save() -> bool:
    """Whether compiled kernels can be stored; makes their folder."""
    with contextlib.suppress(OSError):
        folder_of_kernels().mkdir(parents=True, exist_ok=True)
    return os.access(folder_of_kernels(), os.W_OK)


def is_stored(prefix: str, fingerprint: bytes) -> bool:
    """Whether a file of a kernel exists, for any signature and processor; reads its first bytes."""
    for folder in (shipped_folder(), folder_of_kernels()):
        for path in folder.glob(f"{glob.escape(prefix)}*{ENDING}"):
            with contextlib.suppress(OSError), path.open("rb") as file:
                head = file.read(_HEADER.size)
                if len(head) == _HEADER.size and _HEADER.unpack(head)[:2] == (_MAGIC, fingerprint):
                    return True
    return False


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
    for path in sorted(folder_of_kernels().glob(f"*{ENDING}")):
        content = path.read_bytes()
        if is_current(path.name.partition(f".{sys.implementation.cache_tag}-")[0], Stored.fingerprint_of(content)):
            (folder / path.name).write_bytes(content)
            hashes[path.name] = hashlib.sha256(content).hexdigest()
    (folder / LIST).write_text(json.dumps(hashes, indent=0) + "\n", encoding="ascii")
    return len(hashes)


@functools.cache
def shipped_folder() -> Path:
    """The folder of the package's kernels, or the one that `GABLEWORK_KERNELS` names; never written."""
    named = os.environ.get("GABLEWORK_KERNELS")
    return Path(named) if named else _PACKAGE / "compiled"


@functools.cache
def folder_of_kernels() -> Path:
    """The folder for new files: `NUMBA_CACHE_DIR`, beside the sources, or the user's cache."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return Path(named)
    if os.access(_PACKAGE, os.W_OK):
        return _PACKAGE / "__pycache__" / "kernels"
    import platformdirs

    return Path(platformdirs.user_cache_dir("gablework")) / "kernels"


@functools.cache
def _shipped_hashes() -> dict[str, str]:
    """The hashes of the package's files, by name."""
    try:
        hashes: dict[str, str] = json.loads((shipped_folder() / LIST).read_text(encoding="ascii"))
    except FileNotFoundError:
        return {}
    return hashes


@functools.cache
def _lock_file() -> int | None:
    """The file whose bytes are locked, opened once: closing any descriptor of it would release all locks."""
    try:
        folder_of_kernels().mkdir(parents=True, exist_ok=True)
        return os.open(folder_of_kernels() / _LOCKS, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return None


# locks belong to a process: a forked one opens the file itself, as its copy of the descriptor may be closed
os.register_at_fork(after_in_child=_lock_file.cache_clear)

_warned: set[str] = set()


def _warn(text: str, *, once: str = "") -> None:
    """Warn once about each thing."""
    if (once or text) not in _warned:
        _warned.add(once or text)
        warnings.warn(text, RuntimeWarning, stacklevel=3)


_BASELINES = {"x86_64": "x86-64-v2"}
"""What numpy's own packages require, too: SSE4.2, all such processors since 2009."""


PORTABLE = _BASELINES.get(os.uname().machine, "generic")
"""Any processor of this architecture that numpy runs on. Such code gives the same last bits on all of them, and its
files can be copied from machine to machine. Code for the exact processor is hardly faster."""


def processor() -> str:
    """LLVM's name of the processor: `NUMBA_CPU_NAME`, or `PORTABLE`."""
    return os.environ.get("NUMBA_CPU_NAME") or PORTABLE
