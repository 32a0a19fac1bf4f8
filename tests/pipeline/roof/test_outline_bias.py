"""Outlines of scanned buildings against their exact footprints: of the right size whatever the survey."""

import dataclasses
import functools

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.block import block_plane
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.ruler.simulation.als import scan_all
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.sweep import SCANNER, sweep


@functools.cache
def scene() -> Scene:
    return sweep(seed_of("dev", 1))


def outlines(density: float, beam_radius_m: float, *, with_returns: bool = True) -> np.ndarray:
    """IoU, area and true area of every building that stands alone: rows (k, 3)."""
    survey = dataclasses.replace(SCANNER, pulse_density_per_m2=density, beam_radius_m=beam_radius_m)
    block = scan_all(scene(), survey, 3)
    points, settings, rows = block.points, RoofSettings(), []
    for number, building in enumerate(scene().buildings):
        if "row" in building.building_id:
            continue
        own = block.building == number
        x, y = (building.footprint.centroid.x, building.footprint.centroid.y)
        origin = np.round([scene().origin[0] + x, scene().origin[1] + y, 0.0])
        xyz = np.rint((points.xyz[own] - origin) * 1e3) / 1e3
        split = (points.return_number[own] == 1) & (points.return_count[own] > 1)
        roof = block.face[own] >= 0
        floor_m = float(xyz[roof, 2].min()) - 3.0
        house = candidate(xyz, ground_z_m=floor_m, split_returns=xyz[split & with_returns])
        bare = roof_points(prepare_cloud(house), settings)
        plane = block_plane(bare.points, floor_m, 70.0)
        labelled = dataclasses.replace(bare, labels=np.zeros(len(bare.points), np.int32))
        drawn_mm = partition_roof(labelled, [plane], settings).outline_mm
        assert drawn_mm.is_valid
        drawn = shapely.transform(drawn_mm, lambda xy: xy / 1e3 + origin[:2] - scene().origin[:2])  # noqa: B023
        true = building.footprint
        common = drawn.intersection(true).area
        rows.append((common / (drawn.area + true.area - common), drawn.area, true.area))
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("density", "beam_radius_m", "min_iou"),
    [(0.7, 0.12, 0.9), (2.0, 0.05, 0.95), (2.0, 0.3, 0.95), (6.0, 0.12, 0.98)],
)
def test_outlines_have_the_true_area_whatever_density_and_beam(
    density: float, beam_radius_m: float, min_iou: float
) -> None:
    rows = outlines(density, beam_radius_m)
    assert abs(rows[:, 1].sum() / rows[:, 2].sum() - 1.0) < 0.02
    assert abs(np.median(rows[:, 1] / rows[:, 2]) - 1.0) < 0.02
    assert np.median(rows[:, 0]) > min_iou


@pytest.mark.slow
def test_without_recorded_returns_a_roof_is_as_large_as_the_scanner_sees_it() -> None:
    rows, known = outlines(2.0, 0.3, with_returns=False), outlines(2.0, 0.3)
    grown = np.sqrt(rows[:, 1]) - np.sqrt(known[:, 1])
    assert 0.4 < np.median(grown) < 0.8  # twice the beam's radius on a square
