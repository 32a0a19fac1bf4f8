"""Figures of fit of whole models: facades do not spoil them, and are counted apart."""

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate
from shapely import Polygon

from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, FloatArray, Status
from pipeline.recipe import reconstruct_building


def house(density: float, rng: np.random.Generator) -> FloatArray:
    """A gable of 12 m by 8 m with 2 cm of noise."""
    n = round(density * 96)
    x, y = rng.uniform(0, 12, n), rng.uniform(0, 8, n)
    return np.column_stack((x, y, 5.0 + 0.75 * np.minimum(y, 8.0 - y) + rng.normal(0, 0.02, n)))


def walls(n: int, rng: np.random.Generator) -> FloatArray:
    """Points on all four walls, half a metre inside the eaves and gables, from the ground to the roof."""
    along, side = rng.uniform(0, 1, n), rng.integers(0, 4, n)
    x = np.select([side == 0, side == 1], [0.5, 11.5], 0.5 + 11.0 * along)
    y = np.select([side == 2, side == 3], [0.5, 7.5], 0.5 + 7.0 * along)
    top = 5.0 + 0.75 * np.minimum(y, 8.0 - y)
    return np.column_stack((x, y, rng.uniform(0.1, 1.0, n) * top))


def modelled(points: FloatArray, footprint: Polygon | None = None, method: str = "arrangement") -> BuildingResult:
    return reconstruct_building(candidate(points, footprint=footprint), method, ReconstructSettings())


@pytest.mark.parametrize("footprint", [None, shapely.box(0, 0, 12, 8)])
@pytest.mark.parametrize("method", ["arrangement", "fuzzy-sart"])
@pytest.mark.parametrize("density", [3.0, 10.0])
def test_many_facade_points_leave_the_figures_of_a_right_model(
    density: float, method: str, footprint: Polygon | None
) -> None:
    rng = np.random.default_rng(0)
    roof = house(density, rng)
    points = np.concatenate((roof, walls(len(roof) // 2, rng)))
    result = modelled(points, footprint, method)
    assert result.status is Status.OK
    assert result.quality.share_within > 0.98
    assert result.coverage > 0.98
    assert result.rmse_m < 0.1
    assert result.p95_m < 0.1
    assert result.quality.share_below_roof == pytest.approx(1 / 3, abs=0.03)


def test_a_block_and_a_model_without_facades_count_none_apart() -> None:
    points = house(8.0, np.random.default_rng(1))
    assert modelled(points).quality.share_below_roof == 0.0
    block = reconstruct_building(candidate(points), "arrangement", ReconstructSettings(lods=("1.2",)))
    assert block.lod == "1.2"
    assert block.quality.share_below_roof == 0.0
    assert block.rmse_m > 0.5, "the form of a roof is misfit of its block"


def test_without_a_model_no_share_is_known() -> None:
    result = modelled(np.zeros((3, 3)))
    assert result.status is Status.FAILED
    assert np.isnan([result.quality.share_below_roof, result.quality.share_within, result.rmse_m]).all()
