"""Versions of the packages that can change a result or that Dask's processes must share to communicate."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Mapping

from pipeline import __version__

ENGINE = "gablework"
TALKING = ("dask", "distributed", "msgpack", "cloudpickle", "tornado", "toolz")
"""Packages that client, scheduler and workers must share, beside the engine, to communicate."""
WORKING = ("numpy", "scipy", "numba", "shapely", "pyproj", "pyarrow", "pyogrio", "laspy", "lazrs")
"""Packages whose versions can change a result; a scheduler runs no task and needs none of them."""
_METADATA = ".dist-info"


@functools.cache
def _installed() -> Mapping[str, str]:
    """Versions of installed packages, from the names of their metadata folders; the first of each on the path.

    The standard library would parse one file per package, which takes as long as the import of gablework.
    """
    found: dict[str, str] = {}
    for folder in sys.path:
        try:
            names = os.listdir(folder or ".")  # noqa: PTH208 - a Path takes longer
        except OSError:
            continue
        for name in names:
            if name.endswith(_METADATA):
                package, _, version = name.removesuffix(_METADATA).partition("-")
                found.setdefault(package.lower().replace("_", "-"), version)
    return found


def _version(package: str) -> str:
    if package in _installed():
        return _installed()[package]
    import importlib.metadata  # a zipped package, or another kind of metadata

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "none"


@functools.cache
def versions_here() -> Mapping[str, str]:
    """Versions of this process: of the engine, of Python (major and minor), and of each package; `none` if absent."""
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    return {ENGINE: __version__, "python": python, **{name: _version(name) for name in (*TALKING, *WORKING)}}


@functools.cache
def fingerprint() -> str:
    """The versions of this process as one line: equal where `versions_here` is equal.

    >>> fingerprint().startswith("gablework=")
    True
    """
    return ";".join(f"{name}={version}" for name, version in versions_here().items())
