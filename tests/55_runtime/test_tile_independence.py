"""The promise of the whole design: the same content whatever the tiles, the order and the workers."""

from __future__ import annotations

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

grids = st.fixed_dictionaries(
    {
        "tile_size_m": st.floats(21.0, 150.0).map(lambda size: round(size, 2)),
        "lattice_x_m": st.floats(-80.0, 80.0).map(lambda shift: round(shift, 3)),
        "lattice_y_m": st.floats(-80.0, 80.0).map(lambda shift: round(shift, 3)),
        "halo_m": st.sampled_from([0.0, SUPPORT_M, SUPPORT_M + 17.3]),
    }
)


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """Digests of this module's runs."""
    return {}


@settings(
    max_examples=examples(6),
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # a smaller failing grid is no clearer, and costs minutes
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(grid=grids, order=st.integers(0, 99))
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


SLOW = settings(
    max_examples=examples(4),
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
wide_grids = st.fixed_dictionaries(
    {
        "tile_size_m": st.floats(55.0, 260.0).map(lambda size: round(size, 2)),
        "lattice_x_m": st.floats(-130.0, 130.0).map(lambda shift: round(shift, 3)),
        "lattice_y_m": st.floats(-130.0, 130.0).map(lambda shift: round(shift, 3)),
        "halo_m": st.sampled_from([0.0, SUPPORT_M, SUPPORT_M + 31.9]),
    }
)


@pytest.mark.slow
@SLOW
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
@SLOW
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
