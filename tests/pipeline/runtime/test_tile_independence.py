"""The promise of the whole design: the same content whatever the tiles, the order and the workers."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from examples import examples
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.settings import RunSettings

SUPPORT_M = RunSettings().scene.support_m


def grids(size_m: tuple[float, float], shift_m: float, spare_m: float) -> st.SearchStrategy[dict[str, float]]:
    """Lattices of tiles of these sizes, moved this far at most, with the support as halo or some metres to spare."""
    shifts = st.floats(-shift_m, shift_m).map(lambda shift: round(shift, 3))
    return st.fixed_dictionaries(
        {
            "tile_size_m": st.floats(*size_m).map(lambda size: round(size, 2)),
            "lattice_x_m": shifts,
            "lattice_y_m": shifts,
            "halo_m": st.sampled_from([0.0, SUPPORT_M, SUPPORT_M + spare_m]),
        }
    )


def tried(number: int) -> settings:
    """So many examples of whole runs."""
    return settings(
        max_examples=examples(number),
        deadline=None,
        phases=[Phase.explicit, Phase.reuse, Phase.generate],  # a smaller failing grid is no clearer, and costs minutes
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """Digests of this module's runs."""
    return {}


@tried(6)
@given(grid=grids((21.0, 150.0), 80.0, 17.3), order=st.integers(0, 99))
def test_any_grid_halo_and_order_give_the_same_content(
    grid: dict[str, float], order: int, suburb: Path, reconstruct: Any, shuffled: Any, seen: dict[str, Any]
) -> None:
    if "whole" not in seen:
        seen["whole"] = reconstruct(suburb, settings={"tile_size_m": 1000.0})
    whole = seen["whole"]
    assert whole.statuses.get("ok", 0) >= 3
    cut = reconstruct(suburb, settings=grid, executor=shuffled(order))
    assert cut.digest == whole.digest
    assert cut.rejected == whole.rejected


def test_overlapping_shuffled_files_give_the_content_of_one_file(
    suburb: Path, halves: tuple[Path, Path], reconstruct: Any
) -> None:
    whole = reconstruct(suburb)
    split = reconstruct(*halves)
    assert split.digest == whole.digest
    assert split.counts["duplicates"] == 1000
    assert any("1000 duplicated points" in warning for warning in split.warnings)


def test_overlaps_that_disagree_about_classes_do_not_depend_on_tiles(
    suburb: Path, tmp_path: Path, reconstruct: Any
) -> None:
    las = laspy.read(suburb)
    low = np.asarray(las.z) < np.percentile(las.z, 60)
    for name, roofs in (("a.laz", 6), ("b.laz", 1)):
        las.classification = np.where(low, 2, roofs).astype(np.uint8)
        las.write(tmp_path / name)
    paths = tmp_path / "a.laz", tmp_path / "b.laz"
    digests = {reconstruct(*paths, settings={"tile_size_m": size}).digest for size in (1000.0, 31.0, 47.3)}
    assert len(digests) == 1


def test_a_halo_below_the_support_is_refused() -> None:
    with pytest.raises(SettingsError, match=f"halo_m is 20: use at least {SUPPORT_M:g}"):
        RunSettings.from_mapping({"halo_m": 20.0})


@pytest.mark.slow
def test_two_dask_workers_give_the_content_of_a_serial_run(suburb: Path, reconstruct: Any) -> None:
    serial = reconstruct(suburb, settings={"tile_size_m": 40.0})
    cluster = reconstruct(suburb, settings={"tile_size_m": 40.0}, workers=2)
    assert cluster.digest == serial.digest
    assert len(cluster.peak_memory_bytes) == 3  # two workers and the driver


wide_grids = grids((55.0, 260.0), 130.0, 31.9)


@pytest.mark.slow
@tried(4)
@given(grid=wide_grids, order=st.integers(0, 99))
def test_a_town_of_rows_in_any_grid_gives_the_same_content(
    grid: dict[str, float], order: int, town: Path, reconstruct: Any, shuffled: Any, seen: dict[str, Any]
) -> None:
    if "town" not in seen:
        seen["town"] = reconstruct(town, settings={"tile_size_m": 1000.0})
    cut = reconstruct(town, settings=grid, executor=shuffled(order))
    assert cut.digest == seen["town"].digest
    assert cut.statuses["ok"] > 15


@pytest.mark.slow
@tried(4)
@given(grid=wide_grids, order=st.integers(0, 99))
def test_delft_in_any_grid_gives_the_same_content(
    grid: dict[str, float], order: int, shared_data: Path, reconstruct: Any, shuffled: Any, seen: dict[str, Any]
) -> None:
    tiles = [shared_data / "ahn3" / name for name in ("delft_west.laz", "delft_east.laz")]
    if "delft" not in seen:
        seen["delft"] = reconstruct(*tiles, crs="EPSG:7415", settings={"tile_size_m": 1000.0})
    cut = reconstruct(*reversed(tiles), crs="EPSG:7415", settings=grid, executor=shuffled(order))
    assert cut.digest == seen["delft"].digest
    assert cut.statuses["ok"] > 50


# --- the hierarchical ground filter

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
