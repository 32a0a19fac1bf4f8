"""Plots lie beside one another, hold their building with its free ground, and cross no border of strips."""

import numpy as np
import pytest
import shapely

from pipeline.ruler.simulation.plots import PlannedBuilding, packed_plots
from pipeline.ruler.simulation.roofs import ROOFS, RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import turned


def planned(count: int) -> list[PlannedBuilding]:
    random = np.random.default_rng(4)
    return [
        PlannedBuilding(
            shape=RoofShape.L_SHAPE,
            dimensions=RoofDimensions(
                length_m=float(random.uniform(9.0, 20.0)),
                width_m=8.0,
                pitch_deg=35.0,
                wing_width_m=6.0,
                wing_length_m=float(random.uniform(2.0, 8.0)),
            ),
            azimuth_deg=float(random.uniform(0.0, 360.0)),
            margin_m=float(random.uniform(1.0, 5.0)),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("strips", [1, 3])
def test_plots_tile_the_strips_and_hold_their_buildings(strips: int) -> None:
    buildings = planned(40)
    plots, size = packed_plots(buildings, 90.0, strips, gap_m=2.0)
    assert size[0] == strips * 90.0
    areas = [shapely.box(*plot.extent) for plot in plots]
    assert shapely.union_all(areas).area == pytest.approx(sum(area.area for area in areas))
    for building, plot, area in zip(buildings, plots, areas, strict=True):
        plan = turned(ROOFS[building.shape](building.dimensions).vertices[:, :2], plot.x, plot.y, building.azimuth_deg)
        free = shapely.MultiPoint(plan).buffer(building.margin_m - 1e-9)
        assert area.contains(free)
        assert area.bounds[0] // 90.0 == (area.bounds[2] - 1e-9) // 90.0
        assert area.bounds[3] <= size[1]


def test_strips_are_about_equally_long() -> None:
    plots, size = packed_plots(planned(60), 90.0, 3)
    ends = [max(plot.extent[3] for plot in plots if plot.extent[0] // 90.0 == strip) for strip in range(3)]
    assert max(ends) == pytest.approx(size[1], abs=1.0)
    assert min(ends) > 0.7 * max(ends)


def test_a_plot_wider_than_a_strip_is_refused() -> None:
    with pytest.raises(ValueError, match="wide does not fit a strip of 20 m"):
        packed_plots(planned(40), 20.0, 2)
