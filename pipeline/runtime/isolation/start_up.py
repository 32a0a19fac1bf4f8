"""Settings of a process of gablework, made before anything else is loaded."""

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
"""Variables that keep libraries from starting threads when they are loaded: for matrices, which are small here, and for
tidying memory. Threads would cost time, and a process with threads cannot be forked."""

_OBJECTS_A_COLLECTION = 300_000
"""New container objects between two garbage collections of the youngest generation; Python's default is 700. Modules
and models consist of many objects and few cycles: start-up makes 200 thousand lasting objects, and a town of 160
buildings leaves less than a hundred in cycles. With Python's default a run over such a town takes a twelfth more
processor time, with 50 thousand a fiftieth more."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_FREED_BYTES = 2**25
"""Freed blocks up to this size are reused for the next array. glibc at first returns blocks from 128 KiB on to the
system and raises that limit up to this size only as larger blocks are freed; until then every array of a tile consists
of new pages with a page fault each: a thirtieth of the processor time of a small run."""

NOT_OURS = frozenset({"cffi", "pandas", "requests", "pygments"})
"""Packages that libraries load if they are installed, although gablework needs none: numba, pyarrow and laspy the first
three, httpx the last, for a command line of its own. A run would take a third of a second longer with the first three,
and the start of a service or a client with the last."""

_NEEDED_BY = {"pandas": ("pvlib",), "requests": ("opentelemetry.exporter.otlp.proto.http", "pvlib")}
"""Packages that do need some of them: traces are sent with requests, pvlib computes with pandas and imports both. They
are loaded only where they are wanted."""


class _Blocker(MetaPathFinder):
    """Hides the packages of `NOT_OURS`."""

    def find_spec(self, name: str, *_: object) -> None:
        """Leave a module to the other finders."""
        if name in NOT_OURS and not any(package in sys.modules for package in _NEEDED_BY.get(name, ())):
            raise ModuleNotFoundError(f"No module named {name!r} in a process of gablework", name=name)


def start_own_process() -> None:
    """Collect garbage rarely and not at the end, hide unneeded packages, and log JSON if the environment asks for it.

    An interpreter searches all objects for cycles several times as it ends: after a run over a town .3 to .4 s, a tenth
    of its processor time, for memory that the operating system takes back anyway. `gc.freeze` exempts objects from
    that. Files and folders are closed and removed by their owners, or at exit, before this.

    For processes of gablework, never for one that imports it as a library.
    """
    if not any(isinstance(finder, _Blocker) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Blocker())
    for name, value in WITHOUT_THREADS.items():
        os.environ.setdefault(name, value)
    _keep_freed_memory()
    gc.set_threshold(_OBJECTS_A_COLLECTION, *gc.get_threshold()[1:])
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)
    if os.environ.get("GABLEWORK_LOG_JSON"):
        from pipeline.runtime.monitoring.logs import wants_json

        # the command itself reports an invalid value
        with contextlib.suppress(SettingsError):
            if wants_json():
                from pipeline.runtime.monitoring.log_lines import log_everything_as_json

                log_everything_as_json()


def _keep_freed_memory() -> None:
    """Set glibc's thresholds at once to their final values; other systems have no such setting."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _FREED_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _FREED_BYTES)
