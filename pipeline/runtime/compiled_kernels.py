"""Whether the kernels of a run are compiled already: numba keeps them on disk, by source file, version and processor.

A run that meets none compiles them in each of its processes at once, which takes longer than many a run.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pipeline.quality.self_intersection import shell_intersects_itself
from pipeline.roof.arrangement.raster_labels import raster_labels
from pipeline.roof.arrangement.subdivision import subdivide
from pipeline.segmentation.trial_regions import take_regions
from pipeline.terrain.binning import points_by_cell
from pipeline.terrain.facets import classify_facets
from pipeline.terrain.point_assignment import assign_points
from pipeline.triangulation.faces import triangulate_rings

GROUND = (points_by_cell, classify_facets, assign_points)
"""Kernels that every run calls that finds ground and buildings in the points alone."""
MODELLING = (take_regions, raster_labels, subdivide, triangulate_rings, shell_intersects_itself)
"""Kernels that every process calls that models by the default method, in the order in which it comes to them
(`pipeline.runtime.modelling.load`). What a kernel calls is kept before it is."""


def kernels_are_compiled(kernels: Iterable[Any] = (*GROUND, *MODELLING)) -> bool:
    """Whether a run in this place need not compile kernels; compiles nothing, and reads one small file a kernel.

    It holds for this user on this machine (or whoever shares `NUMBA_CACHE_DIR`); of workers elsewhere it tells nothing.
    A kernel counts where its index is of this source file, this version of numba and this processor, as numba itself
    asks before it compiles. A run that was cut off while it compiled leaves some of them without.

    Parameters
    ----------
    kernels : iterable
        Those that bear witness for all; `MODELLING` is enough for inputs with classes.

    Returns
    -------
    bool
        Also True where numba is switched off (`NUMBA_DISABLE_JIT`): nothing is compiled then.
    """
    return all(_is_compiled(kernel) for kernel in kernels)


def _is_compiled(kernel: Any) -> bool:
    """Whether numba would find a kernel on disk, for arguments of whatever types."""
    if not hasattr(kernel, "targetctx"):
        # a plain function: numba is switched off
        return True
    processor = kernel.targetctx.codegen().magic_tuple()
    # numba has no public question for this; the test holds this against kernels that were and were not compiled
    index = kernel._cache._cache_file._load_index()  # noqa: SLF001
    return any(key[1] == processor for key in index)
