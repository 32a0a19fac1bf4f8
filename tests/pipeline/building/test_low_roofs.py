"""Low roofs in a given footprint are modelled as their points lie, whatever their height."""

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Reason, Status
from pipeline.recipe import reconstruct_building


def shed(lowest_m: float, rise: float, *, with_footprint: bool) -> BuildingResult:
    """A mono-pitch roof of 5 m by 4 m over the floor 0, 8 points per m2."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0, 5, 160), rng.uniform(0, 4, 160)
    z = lowest_m + rise * y + rng.normal(0, 0.03, 160)
    one = candidate(np.column_stack((x, y, z)), footprint=shapely.box(0, 0, 5, 4) if with_footprint else None)
    return reconstruct_building(one, "arrangement", ReconstructSettings())


@pytest.mark.parametrize(("lowest_m", "rise"), [(0.5, 0.0), (0.5, 0.2), (0.25, 0.5)])
def test_a_low_shed_in_a_footprint_keeps_its_height_and_slope(lowest_m: float, rise: float) -> None:
    result = shed(lowest_m, rise, with_footprint=True)
    assert (result.status, result.lod) == (Status.OK, "2.2")
    assert [plane.slope_deg for plane in result.planes] == pytest.approx([np.degrees(np.arctan(rise))], abs=1.0)
    assert result.rmse_m < 0.05


def test_a_roof_that_comes_down_to_the_ground_keeps_its_slope_above_it() -> None:
    result = shed(-0.2, 0.5, with_footprint=True)
    assert result.status is Status.OK
    assert sorted(round(plane.slope_deg) for plane in result.planes) == [0, 27]
    assert result.footprint is not None
    assert result.footprint.area == pytest.approx(20.0, abs=0.01)


def test_without_a_footprint_low_points_are_not_roof_points() -> None:
    result = shed(0.5, 0.1, with_footprint=False)
    assert (result.status, result.reason) == (Status.FAILED, Reason.TOO_FEW_POINTS)
