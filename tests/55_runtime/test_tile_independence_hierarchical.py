"""The hierarchical ground filter through whole runs: the same content whatever the tiles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

HIERARCHICAL = {"ground": {"filter": "hierarchical"}}
NARROW = {
    "outliers": {"cube_m": 1.0},
    "ground": {
        "filter": "hierarchical",
        "seed_cell_m": 16,
        "level_ratio": 8,
        "passes": 1,
        "min_reach_m": 4,
        "bridge_m": 8,
        "clump_m": 1,
    },
}
"""Looks less far than the town is wide, so that the windows do not all see the whole of it."""


def test_a_suburb_in_tiles_gives_the_content_of_one_tile(suburb: Path, reconstruct: Any) -> None:
    whole = reconstruct(suburb, settings={"tile_size_m": 1000.0, **HIERARCHICAL})
    assert whole.statuses.get("ok", 0) >= 3
    cut = reconstruct(suburb, settings={"tile_size_m": 33.0, "lattice_x_m": 7.25, "lattice_y_m": -3.5, **HIERARCHICAL})
    assert cut.digest == whole.digest
    assert cut.rejected == whole.rejected


@pytest.mark.slow
@pytest.mark.parametrize(("size_m", "shift_m"), [(61.0, 0.0), (97.3, -40.125)])
def test_a_town_in_tiles_that_see_a_part_gives_the_content_of_one_tile(
    town: Path, reconstruct: Any, size_m: float, shift_m: float
) -> None:
    whole = reconstruct(town, settings={"tile_size_m": 1000.0, **NARROW})
    cut = reconstruct(town, settings={"tile_size_m": size_m, "lattice_x_m": shift_m, "lattice_y_m": shift_m, **NARROW})
    assert whole.statuses["ok"] > 15
    assert cut.digest == whole.digest
    assert cut.rejected == whole.rejected
