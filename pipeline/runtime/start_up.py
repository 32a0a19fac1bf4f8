"""What a process of ours spares itself: packages that it never uses, and a garbage collection every few imports.

Some libraries load packages where they are installed, for features that this program never uses: pyarrow loads pandas
with its first array, pyogrio loads geopandas, laspy loads requests (to read COPC from servers). The program does not
depend on them, so in most installations they are not there; where other programs brought them, processes of this one do
without. numba loads scipy.linalg with the first kernel, only to note whether there is a BLAS for `np.cov`, and scipy
loads numpy.f2py on the way; kernels that want BLAS themselves find it all the same.

Together, with the rarer collections, this is a quarter of the processor time of a run over two hundred buildings.
"""

from __future__ import annotations

import gc
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

UNUSED = frozenset({"pandas", "geopandas", "requests"})
"""Top-level names of the packages."""

_ASKS_FOR_BLAS = "numba.np.arraymath"
_OBJECTS_A_COLLECTION = 50_000
"""New objects, of those that can be in cycles, between two collections of the youngest; Python's own is 700. Modules
and models are built of many objects and few cycles."""


class _Refusal:
    """A finder that stands before all others and says of packages that they are not installed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None, /
    ) -> ModuleSpec | None:
        """Nothing, so that the next finder is asked.

        Raises
        ------
        ModuleNotFoundError
            For a package that is not to be loaded, or not now.
        """
        del path, target
        if fullname in UNUSED or (fullname == "scipy.linalg" and _is_loading(_ASKS_FOR_BLAS)):
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)
        return None


def _is_loading(name: str) -> bool:
    """Whether the import of a module has begun and not ended."""
    spec = getattr(sys.modules.get(name), "__spec__", None)
    return bool(getattr(spec, "_initializing", False))


def start_own_process() -> None:
    """Spare this process what it never uses; what is loaded already stays.

    For processes that are ours from start to end, never for one that imports this program as a library.
    """
    gc.set_threshold(_OBJECTS_A_COLLECTION, *gc.get_threshold()[1:])
    if not any(isinstance(finder, _Refusal) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Refusal())
