"""Settings of the two ground filters, and how far each of them looks."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from pipeline.parameters import Parameters, parameter
from pipeline.terrain.reach import (
    CLUMP_CELLS,
    GAP_CELLS,
    NEAR_CELLS,
    PIT_CELLS,
    between_walls_support_m,
    embankments_support_m,
    wide_support_m,
)

if TYPE_CHECKING:
    from pipeline.model import BoolArray


class GroundFilter(NamedTuple):
    """A filter that separates the cells of ground from objects."""

    find: str
    """Its function, as "module:name": from the lowest points of cells (rows, columns), the column and row of the first
    cell, the settings, and the part where terrain is needed to a `FoundGround`."""
    bytes_per_cell: int
    """Peak memory per cell of 1 m, all cells filled."""
    widens_on_slopes: bool
    """Whether points of steep terrain are ground farther from it (`tolerance_slope`)."""


FILTERS = {
    "morphological": GroundFilter("pipeline.terrain.morphological:found_ground", 150, True),
    "hierarchical": GroundFilter("pipeline.extras.hierarchical_filter.hierarchical_filter:found_ground", 210, False),
}
"""The ground filters by name: 144 and 207 bytes per cell were measured."""


class FoundGround(NamedTuple):
    """The cells that hold ground, (rows, columns) each."""

    near: BoolArray
    """Those through which small squares draw the terrain."""
    wide: BoolArray
    """Those for squares beyond `NEAR_CELLS`."""
    beside: tuple[int, float] = (0, 0.0)
    """For ground at brows and crests: half side of the squares beside a cell, and a step in mm; 0 leaves them out."""


class MorphologicalFilterSettings(Parameters):
    """Sizes and limits of the openings; used only with the morphological filter."""

    max_window_m: int = parameter(
        20,
        "Largest radius of the openings on the terrain lattice; wider objects are searched on a coarse lattice.",
        unit="m",
        minimum=2,
        maximum=60,
    )
    residual_window_m: int = parameter(
        12,
        "Largest radius of the second openings; wider objects are those that the first openings see.",
        unit="m",
        minimum=2,
        maximum=60,
    )
    window_slope: float = parameter(
        0.12,
        "Height that a step of the first openings may remove, per metre of radius.",
        minimum=0.01,
        maximum=2.0,
    )
    residual_slope: float = parameter(
        0.1,
        "The same for the second openings, which work on heights above the trend of the first ground.",
        minimum=0.01,
        maximum=2.0,
    )
    residual_step_m: float = parameter(
        0.15, "Height that a step of the second openings may always remove.", unit="m", minimum=0.0, maximum=3.0
    )
    residual_steepness_m: float = parameter(
        0.6,
        "Additional height where the trend rises by 45 degrees, in proportion elsewhere: steep ground is rough.",
        unit="m",
        minimum=0.0,
        maximum=3.0,
    )
    trend_m: int = parameter(
        10,
        "Half side of the squares of the trend's planes; twice as much where they hold little ground.",
        unit="m",
        minimum=4,
        maximum=40,
    )
    clump_depth_m: float = parameter(
        4.0,
        "A few cells that lie deeper below the trend are a clump of low outliers.",
        unit="m",
        minimum=0.5,
        maximum=50.0,
    )
    widest_m: int = parameter(
        102,
        "Objects up to this width are cut off on a coarse lattice, if they are high enough for wide_slope.",
        unit="m",
        minimum=0,
        maximum=240,
    )
    wide_slope: float = parameter(
        0.12,
        "Height that a step of these openings may remove, per metre of radius: the least height of wide objects.",
        minimum=0.01,
        maximum=2.0,
    )
    wall_drop_m: float = parameter(
        1.0,
        "Decks and roofs between two parallel drops are not ground if both drops are deeper than this and than "
        "wide_slope times half the width between them; up to widest_m wide.",
        unit="m",
        minimum=0.2,
        maximum=20.0,
    )
    regrowth_passes: int = parameter(
        2, "Number of passes in which cells level with the ground beside them join it.", minimum=0, maximum=10
    )
    regrowth_m: int = parameter(
        3, "Half side of the largest square that counts as beside.", unit="m", minimum=1, maximum=10
    )
    regrowth_step_m: float = parameter(
        0.2, "Highest that a cell may lie above ground beside it.", unit="m", minimum=0.0, maximum=3.0
    )
    regrowth_share: float = parameter(
        0.4,
        "Least share of the nearest ground beside a cell that it does not exceed by more than regrowth_step_m.",
        minimum=0.0,
        maximum=1.0,
    )
    rejoin_passes: int = parameter(
        5,
        "Number of further passes in which cells, wide objects too, join the ground if its planes meet them from two "
        "sides, as on brows, benches and terraces.",
        minimum=0,
        maximum=10,
    )
    rejoin_m: int = parameter(
        4, "Half side of the eight squares of those planes, which touch the cell.", unit="m", minimum=2, maximum=10
    )
    rejoin_step_m: float = parameter(
        0.25, "Farthest that such a plane may pass above or below the cell.", unit="m", minimum=0.0, maximum=3.0
    )
    berm_passes: int = parameter(
        3,
        "Number of passes after these in which cells, wide objects too, join the ground that they rise from gently, as "
        "berms and rims do.",
        minimum=0,
        maximum=10,
    )
    berm_slope: float = parameter(
        0.1,
        "Added to regrowth_step_m in these passes per metre of distance: a berm rises gently, a wall does not.",
        minimum=0.0,
        maximum=1.0,
    )
    embankment_m2: int = parameter(
        600,
        "Least area of smooth surfaces that are ground because slopes lead up to them, as to dams and piers; 0 leaves "
        "them out. It is counted by the distances of neighbours: 1.2 of the area of dense points, half at 0.05 per m2.",
        unit="m2",
        minimum=0,
        maximum=2000,
    )

    @property
    def _openings_support_m(self) -> float:
        """How far the pit tests, openings, wide objects and decks look."""
        chain = 2 * GAP_CELLS + 2 * self.max_window_m + self.second_support_m
        wide = wide_support_m(self.widest_m // 2) if self.looks_for_wide else 0.0
        walls = between_walls_support_m(self.deck_m)
        return PIT_CELLS + max(float(chain), wide, walls)

    @property
    def second_support_m(self) -> int:
        """How far trend, clumps and second openings look at what the first openings found."""
        return 2 * GAP_CELLS + 2 * self.second_window_m + 2 * self.trend_m + CLUMP_CELLS

    def joining_support_m(self, reach: int) -> int:
        """How far terrain looks at what the openings found, by way of all that joins; `reach` is that of its planes."""
        steady = self.morphological_support_m + reach
        return int(max(steady, self.rejoined_support_m + min(reach, NEAR_CELLS)) - self._openings_support_m)

    @property
    def morphological_support_m(self) -> float:
        """How far the ground looks that terrain is drawn from at any distance: the longest chain, and regrowth."""
        return self._openings_support_m + self.regrowth_passes * self.regrowth_m

    @property
    def rejoined_support_m(self) -> float:
        """How far the ground looks that joined by planes or later; terrain is drawn from it up to `NEAR_CELLS` away."""
        passes = 2 * self.rejoin_passes * self.rejoin_m + self.berm_passes * self.regrowth_m
        whole = embankments_support_m() + min(self.berm_passes, 1) * self.regrowth_m if self.embankment_m2 else 0.0
        return max(self.morphological_support_m + passes, self._openings_support_m + whole)

    @property
    def second_window_m(self) -> int:
        """Largest radius of the second openings: no larger than that of the first."""
        return min(self.residual_window_m, self.max_window_m)

    @property
    def looks_for_wide(self) -> bool:
        """Whether objects wider than the largest opening are searched."""
        return self.widest_m > 2 * self.max_window_m

    @property
    def deck_m(self) -> int:
        """Widest that a deck between two walls may be."""
        return max(self.widest_m, 2 * self.max_window_m)


@dataclasses.dataclass(frozen=True)
class Level:
    """One pass of the densification; lengths in cells of the terrain lattice, which are metres."""

    cell: int
    """Side of the cells whose lowest points may join."""
    reach: int
    """How far the decision on a point looks."""


class HierarchicalFilterSettings(Parameters):
    """The hierarchy of cells and the tests of a joining point; used only with the hierarchical filter."""

    seed_cell_m: int = parameter(
        48,
        "Side of the coarsest cells, whose lowest points are ground: wider than most buildings.",
        unit="m",
        minimum=8,
        maximum=120,
    )
    level_ratio: int = parameter(
        4, "Factor by which the cells shrink from level to level; the last are 1 m wide.", minimum=2, maximum=8
    )
    passes: int = parameter(
        4,
        "Number of passes over each level after the first, each on the TIN of the pass before.",
        minimum=1,
        maximum=8,
    )
    min_reach_m: int = parameter(
        8,
        "Least distance that a decision looks; coarse levels look as far as one cell of their TIN.",
        unit="m",
        minimum=3,
        maximum=40,
    )
    max_angle_deg: float = parameter(
        10.0,
        "Largest angle between a facet and the lines from a joining point to its vertices.",
        unit="deg",
        minimum=1.0,
        maximum=60.0,
    )
    max_distance_m: float = parameter(
        0.6,
        "Largest perpendicular distance of a joining point above its facet or plane.",
        unit="m",
        minimum=0.05,
        maximum=5.0,
    )
    distance_rise: float = parameter(
        0.1, "Increase of that distance per metre of the level's cells.", minimum=0.0, maximum=1.0
    )
    noise_m: float = parameter(
        0.5, "Points this close to their facet join it at any angle.", unit="m", minimum=0.0, maximum=3.0
    )
    lone_slope: float = parameter(
        0.1,
        "Steepest rise over run to a point from the mean of the ground within reach, where that carries no plane.",
        minimum=0.0,
        maximum=2.0,
    )
    clump_m: int = parameter(
        3,
        "Side of the cells in which pits are searched a second time, to remove clumps of low outliers.",
        unit="m",
        minimum=1,
        maximum=12,
    )

    def levels(self) -> Iterator[Level]:
        """The passes, coarse to fine."""
        before, first = self.seed_cell_m, True
        while before > 1:
            cell = max(1, before // self.level_ratio)
            for _ in range(1 if first else self.passes):
                yield Level(cell, max(before, self.min_reach_m))
            before, first = cell, False

    @property
    def hierarchical_support_m(self) -> float:
        """How far the filter looks: both pit tests, a cell of seeds, and the reaches of all passes."""
        pits = PIT_CELLS + (PIT_CELLS + 1) * self.clump_m - 1
        return float(pits + self.seed_cell_m - 1 + sum(level.reach for level in self.levels()))
