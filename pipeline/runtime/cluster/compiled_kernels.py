"""Whether the kernels of a run are compiled already: compiling them takes longer than many runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pipeline.quality.self_intersection import shell_intersects_itself
from pipeline.roof.arrangement.raster_labels import raster_labels
from pipeline.roof.arrangement.subdivision import subdivide
from pipeline.segmentation.trial_regions import take_regions
from pipeline.spatial_hash import points_by_cell
from pipeline.terrain.facets import classify_facets
from pipeline.terrain.point_assignment import assign_points
from pipeline.triangulation.face_triangles import triangulate_rings

GROUND = (points_by_cell, classify_facets, assign_points)
"""Kernels of every run that finds ground and buildings in the points alone."""
MODELLING = (take_regions, raster_labels, subdivide, triangulate_rings, shell_intersects_itself)
"""Kernels of every process that models by the default method, in the order of their calls
(`pipeline.runtime.stages.rehearsal.load`). A kernel is stored after its callees."""


def kernels_are_compiled(kernels: Iterable[Any] = (*GROUND, *MODELLING)) -> bool:
    """Whether a run here needs no compilation; only reads the header of one file per kernel.

    The answer holds for this user on this machine, or for all users of `NUMBA_CACHE_DIR`, not for workers elsewhere.
    The kernels represent all others; `MODELLING` is enough for inputs with classes. Also True if numba is switched off
    (`NUMBA_DISABLE_JIT`).
    """
    return all(kernel.is_compiled for kernel in kernels)
