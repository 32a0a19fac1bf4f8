"""Ground and terrain on a lattice of lowest last returns.

The lattice has cells of 1 m, anchored at the CRS's origin, and holds integer millimetres. A filter tells the cells that
hold ground, the progressive morphological one or the hierarchical one; the terrain is then drawn through them by local
planes. Everything looks a bounded distance far: no statistic of a whole tile decides.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numba import njit

from pipeline.model import BoolArray, IntArray
from pipeline.parameters import parameter
from pipeline.terrain.hierarchical_filter import HierarchicalFilterSettings, hierarchical_ground
from pipeline.terrain.lattice import CELL_MM, NO_DATA, PIT_CELLS, Elevations, lowest_per_cell, without_pits
from pipeline.terrain.morphological import objects
from pipeline.terrain.planar_fitting import MIN_CELLS, plane_around, plane_sums

_MAX_SUPPORT_M = 500


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroundSettings(HierarchicalFilterSettings):
    """How ground is told from objects."""

    filter: str = parameter(
        "morphological",
        "What tells ground from objects: openings of growing size, or TIN densification with planar fitting.",
        choices=("morphological", "hierarchical"),
    )

    max_window_m: int = parameter(
        20,
        "Largest half side of the opening: buildings up to twice as wide are cut off the ground.",
        unit="m",
        minimum=2,
        maximum=60,
    )
    max_slope: float = parameter(
        0.25, "Steepest terrain, as rise over run, that the opening does not cut off.", minimum=0.01, maximum=2.0
    )
    min_step_m: float = parameter(
        0.35, "Least height of an object above what the opening leaves.", unit="m", minimum=0.05, maximum=3.0
    )
    pit_depth_m: float = parameter(
        1.0,
        "A cell that lies deeper than this below all but two of its 24 neighbours is a low outlier.",
        unit="m",
        minimum=0.2,
        maximum=20.0,
    )
    bridge_m: int = parameter(
        24,
        "Farthest that the terrain is drawn under objects, where max_window_m asks for no more.",
        unit="m",
        minimum=4,
        maximum=80,
    )
    tolerance_m: float = parameter(
        0.5, "Points closer than this to the terrain are ground.", unit="m", minimum=0.05, maximum=3.0
    )

    def cross_faults(self) -> list[str]:
        """A hierarchy of so many passes that its tiles would be all halo."""
        counts = (self.seed_cell_m, self.level_ratio, self.passes, self.min_reach_m, self.clump_m, self.bridge_m)
        if self.filter != "hierarchical" or not all(isinstance(n, int) for n in counts) or self.level_ratio < 2:
            return []
        if self.support_m <= _MAX_SUPPORT_M:
            return []
        fault = (
            f"filter looks {self.support_m:g} m far, by seed_cell_m {self.seed_cell_m}, level_ratio {self.level_ratio},"
            f" passes {self.passes}: use fewer passes or smaller cells, for at most {_MAX_SUPPORT_M} m"
        )
        return [fault]

    @property
    def windows(self) -> tuple[int, ...]:
        """Half sides of the openings in cells, growing to the largest."""
        sizes = [1]
        while sizes[-1] < self.max_window_m:
            sizes.append(min(self.max_window_m, sizes[-1] + max(1, sizes[-1] // 2)))
        return tuple(sizes)

    @property
    def reach_m(self) -> int:
        """Farthest that the terrain is drawn under objects: at least to the middle of the widest that are cut off."""
        if self.filter == "hierarchical":
            return max(self.bridge_m, 2 * self.seed_cell_m // 3)
        return max(self.bridge_m, self.max_window_m + 1)

    @property
    def support_m(self) -> float:
        """How far a terrain elevation looks: the pit tests, the filter, the local planes, cell sizes."""
        if self.filter == "hierarchical":
            return self.hierarchical_support_m + self.reach_m + 3
        return float(PIT_CELLS + 2 * self.max_window_m + self.reach_m + 3)


@njit(cache=True, nogil=True)
def _terrain(lowest: Elevations, is_ground: BoolArray, bridge: int, max_slope: float) -> Elevations:
    """Draw local least-squares planes through the ground cells of the smallest box that holds enough."""
    rows, columns = lowest.shape
    sums = plane_sums(lowest, is_ground)
    terrain = np.full((rows, columns), NO_DATA, np.int32)
    for r in range(rows):
        for c in range(columns):
            half = 1
            while True:
                n, level, _, _, carries = plane_around(sums, r, c, half)
                # cells in a row carry no plane: under an object a wider box is needed
                if carries or half == bridge or (n >= MIN_CELLS and is_ground[r, c]):
                    break
                half = min(2 * half, bridge)
            if n == 0:
                continue
            if carries:
                # a plane is trusted as far as the terrain may rise within the box, not farther
                low, high = 1e12, -1e12
                for rr in range(max(r - half, 0), min(r + half, rows - 1) + 1):
                    for cc in range(max(c - half, 0), min(c + half, columns - 1) + 1):
                        if is_ground[rr, cc]:
                            low = min(low, float(lowest[rr, cc]))
                            high = max(high, float(lowest[rr, cc]))
                slack = max_slope * CELL_MM * half
                level = min(max(level, low - slack), high + slack)
            terrain[r, c] = np.int32(round(level))
    return terrain


@dataclasses.dataclass(frozen=True, kw_only=True)
class Terrain:
    """The ground of a window, on the 1 m lattice."""

    elevation_mm: Elevations
    """(rows, columns) int32, terrain elevation at the cells' centres; NO_DATA where unknown."""
    measured: BoolArray
    """(rows, columns), True where a ground point lies in the cell."""
    column0: int
    """Absolute index of the first column: floor(easting / 1 m)."""
    row0: int
    """Absolute index of the first row."""


def ground_of(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    usable: BoolArray,
    window: tuple[int, int, int, int],
    settings: GroundSettings,
    *,
    trusted: bool,
) -> Terrain:
    """Terrain under a window of points.

    Parameters
    ----------
    x_mm, y_mm, z_mm : (n,) int64
        Absolute coordinates in millimetres.
    usable : (n,) bool
        The points that may be ground: last returns without outliers, or the file's own ground class.
    window : tuple of int
        column0, row0, columns, rows of the lattice.
    settings : GroundSettings
        Windows, slope and tolerances.
    trusted : bool
        The usable points are ground by the file's classes: no filter, only interpolation.

    Returns
    -------
    Terrain
        Elevations where there is ground within `reach_m`; NO_DATA elsewhere.
    """
    column0, row0, columns, rows = window
    lowest = lowest_per_cell(x_mm, y_mm, z_mm, usable, column0, row0, columns, rows)
    if trusted:
        is_ground = lowest != NO_DATA
    else:
        pit_depth_mm = round(settings.pit_depth_m * 1000)
        lowest = without_pits(lowest, pit_depth_mm)
        if settings.filter == "hierarchical":
            is_ground = hierarchical_ground(lowest, (column0, row0), settings, pit_depth_mm)
        else:
            windows = np.array(settings.windows, np.int64)
            flagged = objects(lowest, windows, settings.max_slope, settings.min_step_m * 1000.0)
            is_ground = (lowest != NO_DATA) & ~flagged
    return Terrain(
        elevation_mm=_terrain(lowest, is_ground, settings.reach_m, settings.max_slope),
        measured=is_ground,
        column0=column0,
        row0=row0,
    )
