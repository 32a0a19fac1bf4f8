"""Buildings that touch become blocks; their faces, points and conditions go with them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely

from pipeline.model import RoofType
from pipeline.ruler.evaluation.blocks import BLOCK_SHAPE, joined_reference
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import Conditions, Reference, ReferencePoints


def house(name: str, x: float, block: str | None, roof_type: RoofType = RoofType.PENT) -> RoofModel:
    """A pent roof of 8 x 6 m in two surfaces of one group."""
    halves = (shapely.box(x, 0, x + 4, 6), shapely.box(x + 4, 0, x + 8, 6))
    return RoofModel(
        building_id=name,
        footprint=shapely.box(x, 0, x + 8, 6),
        roof_type=roof_type,
        surfaces=tuple(
            RoofSurface(polygon=half, coefficients=(0.0, 0.2, 4.0), plane_id=k, group=0)
            for k, half in enumerate(halves)
        ),
        source_id=block,
    )


def points() -> ReferencePoints:
    return ReferencePoints(
        name="t",
        xyz=np.array([(1.0, 1, 4), (9, 1, 4), (13, 1, 4), (21, 1, 4), (50, 1, 0), (9, 0, 2)]),
        classification=np.array([6, 6, 6, 6, 2, 6], np.int32),
        building=np.array([0, 1, 1, 2, -1, 1], np.int32),
        face=np.array([0, 0, 1, 0, -1, -1], np.int32),
        is_roof=np.array([True, True, True, True, False, False]),
        last=np.ones(6, np.bool_),
    )


def conditions(good: bool, shape: str = "pent") -> Conditions:
    return Conditions(
        shape=shape, good=good, defects=() if good else ("dormers",), pitch_deg=11.0, terrain_slope_deg=2.0
    )


REFERENCE = Reference(
    name="row",
    kind="truth",
    buildings=(house("a", 0, "row"), house("b", 8, "row"), house("c", 20, None, RoofType.GABLE)),
    has_faces=True,
    outlines="truth",
    tiles=(points,),
    conditions={"a": conditions(True), "b": conditions(False, "flat"), "c": conditions(True)},
    face_points={("a", 0): 5, ("a", 1): 6, ("b", 0): 7, ("b", 1): 8, ("c", 0): 9},
)


def test_houses_of_a_row_become_one_block_and_others_stay() -> None:
    joined = joined_reference(REFERENCE)
    assert [building.building_id for building in joined.buildings] == ["a", "c"]
    block = joined.buildings[0]
    assert block.footprint.equals(shapely.box(0, 0, 16, 6))
    assert block.roof_type is RoofType.PENT
    assert joined.buildings[1] is REFERENCE.buildings[2]
    assert "3 true buildings were joined to 2" in joined.notes[-1]


def test_faces_keep_apart_under_new_numbers() -> None:
    block = joined_reference(REFERENCE).buildings[0]
    assert [s.plane_id for s in block.surfaces] == [0, 1, 2, 3]


def lifted(model: RoofModel, up_m: float) -> RoofModel:
    surfaces = tuple(dataclasses.replace(s, coefficients=(0.0, 0.2, 4.0 + up_m)) for s in model.surfaces)
    return dataclasses.replace(model, surfaces=surfaces)


def block_of(parts: tuple[RoofModel, ...]) -> RoofModel:
    reference = Reference(name="r", kind="truth", buildings=parts, has_faces=True, outlines="truth", tiles=())
    return joined_reference(reference).buildings[0]


@pytest.mark.parametrize(("up_m", "groups"), [(0.0, [0, 0, 0, 0]), (0.5, [0, 0, 2, 2])])
def test_faces_of_one_plane_that_touch_are_one_face_of_the_block(up_m: float, groups: list[int]) -> None:
    """The points do not show where one roof ends and the next begins, unless there is a step."""
    parts = (house("a", 0, "row"), lifted(house("b", 8, "row"), up_m))
    assert [surface.group for surface in block_of(parts).surfaces] == groups


def test_faces_of_one_plane_that_are_apart_stay_apart() -> None:
    alone = [dataclasses.replace(s, group=-1) for s in house("a", 0, "row").surfaces[:1]]
    far = [dataclasses.replace(s, group=-1) for s in house("b", 9, "row").surfaces[:1]]
    parts = tuple(
        dataclasses.replace(house(name, x, "row"), surfaces=tuple(surfaces))
        for name, x, surfaces in (("a", 0, alone), ("b", 9, far))
    )
    assert [surface.group for surface in block_of(parts).surfaces] == [-1, -1]


def test_points_follow_their_buildings_and_faces() -> None:
    joined = joined_reference(REFERENCE)
    (tile,) = joined.points()
    assert tile.building.tolist() == [0, 0, 0, 1, -1, 0]
    assert tile.face.tolist() == [0, 2, 3, 0, -1, -1]
    assert joined.face_points == {("a", 0): 5, ("a", 1): 6, ("a", 2): 7, ("a", 3): 8, ("c", 0): 9}


def test_a_block_is_as_hard_as_its_hardest_house() -> None:
    joined = joined_reference(REFERENCE).conditions
    assert joined["a"].good is False
    assert joined["a"].defects == ("dormers",)
    assert joined["a"].shape == BLOCK_SHAPE
    assert joined["c"] == REFERENCE.conditions["c"]


def test_unlike_roofs_of_a_block_are_a_combination() -> None:
    parts = (house("a", 0, "row"), house("b", 8, "row", RoofType.FLAT))
    assert block_of(parts).roof_type is RoofType.COMBINATION


def test_a_reference_without_blocks_is_left_as_it_is() -> None:
    alone = Reference(
        name="r", kind="truth", buildings=REFERENCE.buildings[1:], has_faces=True, outlines="truth", tiles=()
    )
    assert joined_reference(alone) is alone
