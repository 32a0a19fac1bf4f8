"""Dormers and superstructures stand on the roof, apart from one another, and the roof with them is still a roof."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely

from pipeline.synthetic.drawn_additions import can_have_dormers, random_dormers, random_superstructures
from pipeline.synthetic.random_dimensions import random_dimensions
from pipeline.synthetic.roofs import ROOFS, Addition, AdditionKind, RoofDimensions, RoofFaces, RoofShape


def rectangle(one: Addition) -> shapely.Polygon:
    return shapely.box(
        one.u_m - one.length_m / 2, one.v_m - one.width_m / 2, one.u_m + one.length_m / 2, one.v_m + one.width_m / 2
    )


def outline(roof: RoofFaces) -> shapely.Geometry:
    plan = roof.vertices[:, :2]
    return shapely.union_all(
        [shapely.Polygon(plan[list(face[0])], [plan[list(hole)] for hole in face[1:]]) for face in roof.faces]
    )


@pytest.mark.parametrize("shape", [shape for shape in RoofShape if can_have_dormers(shape)])
def test_dormers_stand_apart_and_make_faces_of_their_own(shape: RoofShape) -> None:
    found = 0
    for seed in range(8):
        random = np.random.default_rng([seed, 0xD0])
        size = random_dimensions(shape, random, area_m2=450.0)
        dormers = random_dormers(shape, size, random)
        found += len(dormers)
        assert len(dormers) <= 4
        assert len({one.kind for one in dormers}) <= 1
        for number, one in enumerate(dormers):
            assert all(rectangle(one).distance(rectangle(other)) > 1.0 for other in dormers[:number])
        bare, full = ROOFS[shape](size), ROOFS[shape](dataclasses.replace(size, additions=dormers))
        if dormers:
            more = len(dormers) * (2 if dormers[0].kind is AdditionKind.GABLE_DORMER else 1)
            assert len(full.faces) >= len(bare.faces) + more
        assert outline(full).symmetric_difference(outline(bare)).area < 0.01
    assert found > 0


@pytest.mark.parametrize("shape", list(RoofShape))
def test_superstructures_stand_inside_the_outline_and_beside_the_dormers(shape: RoofShape) -> None:
    for seed in range(4):
        random = np.random.default_rng([seed, 0xB0])
        size = random_dimensions(shape, random, area_m2=450.0)
        dormers = random_dormers(shape, size, random) if can_have_dormers(shape) else ()
        boxes = random_superstructures(shape, size, random, besides=dormers)
        assert 1 <= len(boxes) <= 3
        for one in boxes:
            assert one.kind is AdditionKind.BOX
            assert outline(ROOFS[shape](size)).contains(rectangle(one))
            assert all(rectangle(one).distance(rectangle(other)) > 1.0 for other in dormers)
        full = ROOFS[shape](dataclasses.replace(size, additions=dormers + boxes))
        assert full.vertices[:, 2].max() > 0.6


def test_a_roof_without_room_for_a_dormer_gets_none() -> None:
    tiny = RoofDimensions(length_m=4.0, width_m=4.0, pitch_deg=30.0)
    assert random_dormers(RoofShape.GABLE, tiny, np.random.default_rng(1)) == ()
    low = RoofDimensions(length_m=20.0, width_m=12.0, pitch_deg=10.0)
    assert random_dormers(RoofShape.GABLE, low, np.random.default_rng(1)) == ()
