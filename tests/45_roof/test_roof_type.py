"""Roof types of exact roofs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from pipeline.model import RoofType
from pipeline.roof.roof_type import RoofTypeSettings, roof_type

ExactRoofs = Callable[..., Any]

TYPES = {
    "flat": RoofType.FLAT,
    "pent": RoofType.PENT,
    "gable": RoofType.GABLE,
    "hip": RoofType.HIP,
    "l": RoofType.COMBINATION,
    "stepped": RoofType.FLAT,
    "tower": RoofType.FLAT,
}


@pytest.mark.parametrize("kind", list(TYPES))
@pytest.mark.parametrize("turn_deg", [0.0, 200.0])
@pytest.mark.parametrize("with_footprint", [True, False])
def test_an_exact_roof_has_its_type(exact_roof: ExactRoofs, kind: str, turn_deg: float, with_footprint: bool) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, with_footprint=with_footprint, density=6.0)
    parts = roof.parts()
    faces = [face for part in parts for face in part.faces]
    assert roof_type(roof.planes, faces, [part.solid for part in parts], RoofTypeSettings()) is TYPES[kind]


def test_two_pent_roofs_that_fall_towards_one_another_are_no_gable(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("gable", with_footprint=True)
    parts = roof.parts()
    faces = [face for part in parts for face in part.faces]
    # the same faces on planes turned upside down meet in a valley
    valley = [type(p)(a=-p.a, b=-p.b, c=p.c, n_points=1, rmse_m=0.0) for p in roof.planes]
    assert roof_type(valley, faces, [part.solid for part in parts], RoofTypeSettings()) is RoofType.COMBINATION


def test_without_faces_there_is_no_type() -> None:
    assert roof_type([], [], [], RoofTypeSettings()) is RoofType.NONE
