"""Roof types of exact roofs."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from simulated import placed

from pipeline.model import RoofType
from pipeline.roof.roof_settings import RoofTypeSettings
from pipeline.roof.roof_type import roof_type
from pipeline.roof.solid import solid_parts
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import ROOF_TYPES, RoofShape
from pipeline.ruler.simulation.solids import truth_record

ExactRoofs = Callable[..., Any]

TYPES = {
    "flat": RoofType.FLAT,
    "pent": RoofType.PENT,
    "gable": RoofType.GABLE,
    "hip": RoofType.HIP,
    "l": RoofType.L_SHAPE,
    "stepped": RoofType.FLAT,
    "tower": RoofType.FLAT,
}


def type_of(roof: Any, planes: Any = None, settings: RoofTypeSettings | None = None, parts: Any = None) -> RoofType:
    """The type of an exact roof, perhaps on other planes or with other solids."""
    parts = parts or roof.parts()
    faces = [face for part in parts for face in part.faces]
    return roof_type(planes or roof.planes, faces, [part.solid for part in parts], settings or RoofTypeSettings())


@pytest.mark.parametrize("kind", list(TYPES))
@pytest.mark.parametrize("turn_deg", [0.0, 200.0])
@pytest.mark.parametrize("with_footprint", [True, False])
def test_an_exact_roof_has_its_type(exact_roof: ExactRoofs, kind: str, turn_deg: float, with_footprint: bool) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, with_footprint=with_footprint, density=6.0)
    assert type_of(roof) is TYPES[kind]


def test_two_pent_roofs_that_fall_towards_one_another_are_a_butterfly(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("gable", with_footprint=True)
    # the same faces on planes turned upside down meet in a valley
    valley = [type(p)(a=-p.a, b=-p.b, c=p.c, n_points=1, rmse_m=0.0) for p in roof.planes]
    assert type_of(roof, valley) is RoofType.BUTTERFLY


@pytest.mark.parametrize("shape", list(RoofShape))
def test_the_truth_of_every_shape_has_its_type(shape: RoofShape) -> None:
    random = np.random.default_rng([17, *str(shape).encode()])
    for _ in range(8):
        size = random_dimensions(shape, random)
        building = placed(shape, size, azimuth_deg=float(random.uniform(0.0, 360.0)))
        truth = truth_record(building, (0.0, 0.0, 0.0))
        found = roof_type(truth.planes, truth.faces, truth.solids, RoofTypeSettings())
        assert found is ROOF_TYPES[shape], size


def with_lifted_plane(roof: Any, lift_m: float, settings: RoofTypeSettings | None = None) -> RoofType:
    """The type of an exact roof whose last plane is drawn higher: there are walls along its borders."""
    planes = [*roof.planes[:-1], dataclasses.replace(roof.planes[-1], c=roof.planes[-1].c + lift_m)]
    return type_of(roof, planes, settings, solid_parts(roof.drawn(), planes, 0.0))


@pytest.mark.parametrize("kind", ["hip", "gable"])
def test_planes_meet_across_a_sliver_of_wall_and_not_across_a_step(exact_roof: ExactRoofs, kind: str) -> None:
    roof = exact_roof(kind, with_footprint=True)
    for lift_m in (0.0, 0.05, 0.3, -0.3):
        assert with_lifted_plane(roof, lift_m) is TYPES[kind]
    # three sides of a hip roof still meet
    apart = RoofType.HIP if kind == "hip" else RoofType.COMBINATION
    assert with_lifted_plane(roof, 1.5) is apart
    assert with_lifted_plane(roof, 0.3, RoofTypeSettings(sliver_height_m=0.1)) is apart


def test_a_flat_top_between_steep_sides_is_a_mansard() -> None:
    size = random_dimensions(RoofShape.MANSARD, np.random.default_rng(5), area_m2=220.0)
    mansard = dataclasses.replace(size, second_pitch_deg=0.0, pitch_deg=65.0, break_share=0.2)
    truth = truth_record(placed(RoofShape.MANSARD, mansard, azimuth_deg=20.0), (0.0, 0.0, 0.0))
    assert roof_type(truth.planes, truth.faces, truth.solids, RoofTypeSettings()) is RoofType.MANSARD


def test_a_roof_without_faces_has_no_type() -> None:
    assert roof_type([], [], [], RoofTypeSettings()) is RoofType.NONE
