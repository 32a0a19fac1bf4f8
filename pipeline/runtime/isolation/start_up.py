"""What a process of ours sets before anything else is loaded."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import os
import sys
from importlib.abc import MetaPathFinder

from pipeline.errors import SettingsError

WITHOUT_THREADS = {"OPENBLAS_NUM_THREADS": "1", "JE_ARROW_MALLOC_CONF": "background_thread:false"}
"""What keeps libraries from starting threads when they are loaded: those of matrices, which are small here, and one
that tidies memory. They would cost time, and a process with threads cannot be forked."""

_OBJECTS_A_COLLECTION = 300_000
"""New objects, of those that can be in cycles, between two collections of the youngest; Python's own is 700. Modules
and models are built of many objects and few cycles: start-up makes 200 thousand objects that all stay, a town of 160
buildings then leaves less than a hundred in cycles. With Python's own number a run over such a town takes a twelfth
more of processor time, and with 50 thousand a fiftieth more."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_FREED_BYTES = 2**25
"""Up to this size, memory that was freed is kept for the next array. glibc gives a block back to the system at first
from 128 KiB on, learns of larger ones as they are freed, and ends here; until then every array of a tile is made of new
pages, each of them a fault: a thirtieth of the processor time of a small run."""

NOT_OURS = frozenset({"cffi", "pandas", "requests"})
"""What libraries load where they find it, though nothing here uses it and no lock of the product has it: numba, pyarrow
and laspy. Beside a test's or somebody's own packages a run would take a third of a second more for it."""


class _WithoutThem(MetaPathFinder):
    """Finds nothing, and says so of what is not ours."""

    def find_spec(self, name: str, *_: object) -> None:
        """Leave a module to the other finders.

        Raises
        ------
        ModuleNotFoundError
            It is not ours.
        """
        if name in NOT_OURS:
            raise ModuleNotFoundError(f"No module named {name!r} in a process of gablework", name=name)


def start_own_process() -> None:
    """Collect garbage more rarely, and none at the end; log JSON to the end where the environment asks for it.

    Load none of the packages that only other programs of this environment need.

    An interpreter that ends looks through all objects for cycles, several times: after a run over a town .3 to .4 s, a
    tenth of its processor time, for memory that the operating system takes back anyway. Frozen objects are not looked
    at (`gc.freeze`). Files and folders are closed and removed by those who opened them, or at exit, before this.

    For processes that are ours from start to end, never for one that imports this program as a library.
    """
    if not any(isinstance(finder, _WithoutThem) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WithoutThem())
    for name, value in WITHOUT_THREADS.items():
        os.environ.setdefault(name, value)
    _keep_freed_memory()
    gc.set_threshold(_OBJECTS_A_COLLECTION, *gc.get_threshold()[1:])
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)
    if os.environ.get("GABLEWORK_LOG_JSON"):
        from pipeline.runtime.monitoring import logs

        # a value that is neither yes nor no is told by the command itself
        with contextlib.suppress(SettingsError):
            if logs.wants_json():
                logs.log_everything_as_json()


def _keep_freed_memory() -> None:
    """Tell glibc what it would learn; other systems have no such setting."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _FREED_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _FREED_BYTES)
