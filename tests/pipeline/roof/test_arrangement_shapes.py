"""The arrangement on shapes of many faces: mansards, sawtooth halls, set-backs, towers, with noise and turned."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FloatArray, LabelArray, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.footprint_in_mm import footprint_in_mm
from pipeline.roof.roof_settings import ArrangementSettings
from pipeline.roof.solid import solid_parts

Volume = Callable[[Solid], float]
WIDE, DEEP = 24.0, 18.0
CENTRE = np.array([WIDE / 2, DEEP / 2])


def lower_envelope(planes: FloatArray, xy: FloatArray) -> LabelArray:
    """The lowest plane at each place."""
    labels: LabelArray = (xy @ planes[:, :2].T + planes[:, 2]).argmin(axis=1).astype(np.int32)
    return labels


def slopes(rise: float, low: float) -> list[tuple[float, float, float]]:
    """Planes that rise from the four eaves, at height `low` there."""
    east, north = low + rise * WIDE, low + rise * DEEP
    return [(rise, 0.0, low), (-rise, 0.0, east), (0.0, rise, low), (0.0, -rise, north)]


def mansard() -> tuple[FloatArray, Callable[[FloatArray], LabelArray]]:
    planes = np.array([*slopes(2.0, 4.0), *slopes(0.35, 6.5)])
    return planes, lambda xy: lower_envelope(planes, xy)


def sawtooth() -> tuple[FloatArray, Callable[[FloatArray], LabelArray]]:
    planes = np.array([(0.45, 0.0, 6.0 - 0.45 * 4.0 * bay) for bay in range(6)])
    return planes, lambda xy: np.minimum(xy[:, 0] // 4.0, 5).astype(np.int32)


def set_backs() -> tuple[FloatArray, Callable[[FloatArray], LabelArray]]:
    planes = np.array([(0.0, 0.0, z) for z in (9.0, 15.0, 21.0)])
    return planes, lambda xy: sum(
        (np.abs(xy - CENTRE) < half).all(axis=1).astype(np.int32) for half in ((8.0, 6.0), (4.0, 3.0))
    )


def towers() -> tuple[FloatArray, Callable[[FloatArray], LabelArray]]:
    planes = np.array([*slopes(0.5, 5.0)[2:], (0.0, 0.0, 14.0), (0.0, 0.0, 17.0)])

    def labels(xy: FloatArray) -> LabelArray:
        found = lower_envelope(planes[:2], xy)
        found[(xy < 4.0).all(axis=1)] = 2
        found[(xy[:, 0] > 20.0) & (np.abs(xy[:, 1] - 9.0) < 2.5)] = 3
        return found

    return planes, labels


SHAPES = {"mansard": (mansard, 8), "sawtooth": (sawtooth, 6), "set-backs": (set_backs, 3), "towers": (towers, 4)}


def arranged_volume(shape: str, turn_deg: float, density: float, noise_m: float, volume: Volume) -> tuple[int, float]:
    """Faces of what the arrangement makes of noisy points, valid and filling the outline, and its share of the volume.

    The true volume is that of a fine raster.
    """
    planes, labels_at = SHAPES[shape][0]()
    turn = math.radians(turn_deg)
    axes = np.array([(math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))])
    rng = np.random.default_rng(round(100 * turn_deg))
    flat = rng.uniform((0.0, 0.0), (WIDE, DEEP), (round(density * WIDE * DEEP), 2))
    labels = labels_at(flat)
    z = (flat * planes[labels, :2]).sum(axis=1) + planes[labels, 2] + rng.normal(0.0, noise_m, len(flat))
    xy = flat @ axes
    order = np.lexsort((xy[:, 1], xy[:, 0]))
    points, labels = np.rint(np.column_stack((xy, z))[order] * 1e3) / 1e3, labels[order]
    turned = np.column_stack((planes[:, :2] @ axes, planes[:, 2]))
    outline_mm = footprint_in_mm(shapely.transform(shapely.box(0, 0, WIDE, DEEP), lambda one: one @ axes))
    for clearance in (1.0, 2.5, 4.0):
        partition = arrange(points, labels, turned, outline_mm, density**-0.5, ArrangementSettings(), clearance)
        assert shapely.coverage_is_valid(list(partition.polygons))
        assert sum(polygon.area for polygon in partition.polygons) == pytest.approx(outline_mm.area, rel=1e-3)
        assert partition.planes is not None
        (part,) = solid_parts(partition, partition.planes, 0.0)
        codes = check_solid(part.solid)
        if not codes:
            break
    assert codes == ()
    raster = np.stack(np.meshgrid(np.arange(0.05, WIDE, 0.1), np.arange(0.05, DEEP, 0.1)), -1).reshape(-1, 2)
    over = labels_at(raster)
    true = float(((raster * planes[over, :2]).sum(axis=1) + planes[over, 2]).mean()) * WIDE * DEEP
    return len(partition.polygons), volume(part.solid) / true


@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 44.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_roof_of_many_faces_gets_each_of_them_once_and_its_volume(
    shape: str, turn_deg: float, volume: Volume
) -> None:
    faces, share = arranged_volume(shape, turn_deg, 10.0, 0.04, volume)
    assert faces == SHAPES[shape][1]
    assert share == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_with_two_points_a_square_metre_the_volume_is_right_to_a_fiftieth(shape: str, volume: Volume) -> None:
    _, share = arranged_volume(shape, 30.0, 2.0, 0.05, volume)
    assert share == pytest.approx(1.0, abs=0.02)


@settings(max_examples=examples(25), deadline=None)
@given(shape=st.sampled_from(sorted(SHAPES)), turn_deg=st.floats(0.0, 90.0), density=st.sampled_from([1.0, 4.0, 12.0]))
def test_they_are_sound_at_any_turn_and_density(shape: str, turn_deg: float, density: float) -> None:
    arranged_volume(shape, turn_deg, density, 0.05, lambda _: 1.0)
