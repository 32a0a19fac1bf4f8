"""The files of compiled kernels: their place, their content, and which ones may be loaded.

One file holds one kernel for one signature. It begins with the kernel's fingerprint: a file with another fingerprint is
overwritten, never used. Its name contains kernel, signature, Python, numba and processor. As machine code can do
anything, a file of an installed package is loaded only if the package's list contains its hash.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import glob
import hashlib
import json
import os
import struct
import warnings
from pathlib import Path

ENDING = ".kernel"
_PACKAGE = Path(__file__).resolve().parents[1]
LIST = "kernels.json"
"""File beside the kernels of a package or an image: the sha256 of each, by file name."""
_HEADER = struct.Struct("<8s32sQQQ")
_MAGIC = b"gwkern03"


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
    listed = shipped_hashes().get(file_name)
    for folder in (shipped_folder(), folder_of_kernels()) if listed else (folder_of_kernels(),):
        try:
            content = (folder / file_name).read_bytes()
        except OSError:
            continue
        if folder == shipped_folder() and hashlib.sha256(content).hexdigest() != listed:
            warn(f"{folder / file_name} is not the file that {LIST} lists: this kernel is compiled again")
            continue
        stored = Stored.from_bytes(content, fingerprint)
        if stored is not None and (stored.machine_code or not runnable):
            return stored
    return None


def is_stored(prefix: str, fingerprint: bytes) -> bool:
    """Whether a file of a kernel exists, for any signature and processor; reads its first bytes."""
    for folder in (shipped_folder(), folder_of_kernels()):
        for path in folder.glob(f"{glob.escape(prefix)}*{ENDING}"):
            with contextlib.suppress(OSError), path.open("rb") as file:
                head = file.read(_HEADER.size)
                if len(head) == _HEADER.size and _HEADER.unpack(head)[:2] == (_MAGIC, fingerprint):
                    return True
    return False


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
def shipped_hashes() -> dict[str, str]:
    """The hashes of the package's files, by name."""
    try:
        hashes: dict[str, str] = json.loads((shipped_folder() / LIST).read_text(encoding="ascii"))
    except FileNotFoundError:
        return {}
    return hashes


_warned: set[str] = set()


def warn(text: str, *, once: str = "") -> None:
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
