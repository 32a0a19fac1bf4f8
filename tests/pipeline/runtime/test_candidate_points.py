"""The points that a candidate knows besides its own: split returns, and those beside it, whatever the tiles."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from pipeline.model import Candidate
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.run import RunSummary
from pipeline.runtime.stages.gather import noise_of_ground_m
from pipeline.runtime.stages.window_points import Surroundings

WALLS = {"outline": "walls"}
WALLS_BENEATH = {"wall_outline": True}


# --- split returns: the pulses that went on below the roof


def test_split_returns_are_the_points_that_were_first_of_several(
    suburb: Path, reconstruct: Callable[..., RunSummary], candidates: list[Candidate]
) -> None:
    reconstruct(suburb)
    assert candidates
    las = laspy.read(suburb)
    first = (np.array(las.return_number) == 1) & (np.array(las.number_of_returns) > 1)
    mm = np.rint(np.column_stack((las.x, las.y, las.z)) * 1e3).astype(np.int64)
    count, wanted = 0, {tuple(row) for row in mm[first].tolist()}
    for candidate in candidates:
        origin_mm = np.rint(np.array(candidate.origin) * 1e3).astype(np.int64)
        points = np.rint(candidate.points * 1e3).astype(np.int64) + origin_mm
        split = np.rint(candidate.split_returns * 1e3).astype(np.int64) + origin_mm
        own = [tuple(row) for row in points.tolist() if tuple(row) in wanted]
        assert [tuple(row) for row in split.tolist()] == own
        count += len(own)
    assert count > 50


def test_a_file_of_single_returns_has_none(
    suburb: Path, tmp_path: Path, reconstruct: Callable[..., RunSummary], candidates: list[Candidate]
) -> None:
    las = laspy.read(suburb)
    las.return_number[:] = 1
    las.number_of_returns[:] = 1
    las.write(tmp_path / "single.laz")
    reconstruct(tmp_path / "single.laz")
    assert candidates
    assert sum(len(candidate.split_returns) for candidate in candidates) == 0


# --- points beside, which outlines at the walls need


def absolute_mm(candidate: Candidate, xyz: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(row) for row in np.rint((xyz + np.array(candidate.origin)) * 1e3).astype(np.int64).tolist()}


@pytest.mark.parametrize("roof", [WALLS, WALLS_BENEATH], ids=["at the walls", "walls beneath"])
def test_points_beside_are_those_of_the_file_that_are_near_and_no_points_of_the_candidate(
    suburb: Path, reconstruct: Callable[..., RunSummary], candidates: list[Candidate], roof: dict[str, Any]
) -> None:
    reconstruct(suburb, settings={"roof": roof})
    las = laspy.read(suburb)
    mm = np.rint(np.column_stack((las.x, las.y, las.z)) * 1e3).astype(np.int64)
    of, order = np.array(las.number_of_returns), np.array(las.return_number)
    assert candidates
    for candidate in candidates:
        own = absolute_mm(candidate, candidate.points)
        cells = {(x // 1000 + i, y // 1000 + j) for x, y, _ in own for i in range(-2, 3) for j in range(-2, 3)}
        for beside, wanted in ((candidate.beside, of == 1), (candidate.beside_later, (of > 1) & (order == of))):
            near = {tuple(row) for row in mm[wanted].tolist() if (row[0] // 1000, row[1] // 1000) in cells}
            assert absolute_mm(candidate, beside) == near - own
    assert sum(len(candidate.beside) for candidate in candidates) > 100


def test_outlines_at_the_eaves_need_no_points_beside(
    suburb: Path, reconstruct: Callable[..., RunSummary], candidates: list[Candidate]
) -> None:
    reconstruct(suburb)
    reconstruct(suburb, settings={"roof": {**WALLS, "straight_eaves": False}})
    assert candidates
    assert not any(len(candidate.beside) or len(candidate.beside_later) for candidate in candidates)


def test_outlines_at_the_walls_do_not_depend_on_tiles_and_files(
    suburb: Path, halves: tuple[Path, Path], reconstruct: Callable[..., RunSummary]
) -> None:
    whole = reconstruct(suburb, settings={"roof": WALLS})
    tiled = reconstruct(suburb, settings={"roof": WALLS, "tile_size_m": 23.7, "lattice_x_m": 7.3, "lattice_y_m": -11.9})
    assert tiled.digest == whole.digest
    assert reconstruct(*halves, settings={"roof": WALLS}).digest == whole.digest
    assert reconstruct(suburb).digest != whole.digest


# --- the noise of the ground nearby


@pytest.mark.parametrize("density_per_m2", [1.5, 10.0])
@pytest.mark.parametrize("noise_m", [0.03, 0.15])
def test_candidates_know_the_noise_of_the_ground_nearby(
    density_per_m2: float,
    noise_m: float,
    tmp_path: Path,
    reconstruct: Callable[..., RunSummary],
    candidates: list[Candidate],
) -> None:
    made = simulate("city", tmp_path, 3, size_m=(60.0, 60.0), density_per_m2=density_per_m2, noise_m=noise_m)
    reconstruct(made.laz)
    assert candidates
    assert np.median([candidate.ground_noise_m for candidate in candidates]) == pytest.approx(noise_m, rel=0.25)


@pytest.mark.parametrize(("slope", "is_level"), [(0.0, True), (0.08, True), (0.3, False), (0.9, False)])
@pytest.mark.parametrize("noise_m", [0.02, 0.15])
def test_slopes_are_no_noise(slope: float, is_level: bool, noise_m: float) -> None:
    """A cell's point may lie anywhere in it, and the terrain is that of its centre."""
    rng, side = np.random.default_rng(2), 40
    along = np.arange(side) + 0.5
    terrain = np.broadcast_to(np.rint(1000 * slope * along).astype(np.int32), (side, side))
    off_mm = 1000 * (slope * rng.uniform(-0.5, 0.5, (side, side)) + rng.normal(0.0, noise_m, (side, side)))
    around = Surroundings(0, 0, terrain, np.ones((side, side), np.bool_), np.rint(off_mm).astype(np.int16))
    found_m = noise_of_ground_m(around, 1.0)
    assert np.isnan(found_m) != is_level
    if is_level:
        assert found_m == pytest.approx(noise_m / 0.9, rel=0.15, abs=0.025)
