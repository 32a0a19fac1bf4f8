"""Whether the kernels of a run are compiled already.

A run that meets none compiles them first, which takes longer than many a run.
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
(`pipeline.runtime.stages.model_batch.load`). What a kernel calls is kept before it is."""


def kernels_are_compiled(kernels: Iterable[Any] = (*GROUND, *MODELLING)) -> bool:
    """Whether a run in this place need not compile kernels; compiles nothing, and reads the head of a file per kernel.

    It holds for this user on this machine, or for all who share `NUMBA_CACHE_DIR`; it says nothing of workers
    elsewhere.

    Parameters
    ----------
    kernels : iterable
        Those that stand for all; `MODELLING` is enough for inputs with classes.

    Returns
    -------
    bool
        Also True where numba is switched off (`NUMBA_DISABLE_JIT`): nothing is compiled then.
    """
    return all(kernel.is_compiled for kernel in kernels)
