"""Buildings that touch become blocks; their faces, points and conditions go with them."""

import dataclasses

import numpy as np
import pytest
import shapely
from roofs_by_hand import conditions, lifted, points_of, reference

from pipeline.model import RoofType
from pipeline.ruler.evaluation.block_scores import BLOCK_SHAPE, joined_reference
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import ReferencePoints


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
    xyz = np.array([(1.0, 1, 4), (9, 1, 4), (13, 1, 4), (21, 1, 4), (50, 1, 0), (9, 0, 2)])
    building, face = [0, 1, 1, 2, -1, 1], [0, 0, 1, 0, -1, -1]
    return points_of(xyz, [6, 6, 6, 6, 2, 6], building=building, face=face, is_roof=[True] * 4 + [False] * 2)


TRUTH = reference(
    (house("a", 0, "row"), house("b", 8, "row"), house("c", 20, None, RoofType.GABLE)),
    conditions={"a": conditions(good=True), "b": conditions(good=False, shape="flat"), "c": conditions(good=True)},
    face_points={("a", 0): 5, ("a", 1): 6, ("b", 0): 7, ("b", 1): 8, ("c", 0): 9},
)
REFERENCE = dataclasses.replace(TRUTH, tiles=(points,))


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


def block_of(*parts: RoofModel) -> RoofModel:
    return joined_reference(reference(parts)).buildings[0]


@pytest.mark.parametrize(("up_m", "groups"), [(0.0, [0, 0, 0, 0]), (0.5, [0, 0, 2, 2])])
def test_faces_of_one_plane_that_touch_are_one_face_of_the_block(up_m: float, groups: list[int]) -> None:
    """The points do not show where one roof ends and the next begins, unless there is a step."""
    second = house("b", 8, "row")
    second = dataclasses.replace(second, surfaces=tuple(lifted(surface, up_m) for surface in second.surfaces))
    assert [surface.group for surface in block_of(house("a", 0, "row"), second).surfaces] == groups


def test_faces_of_one_plane_that_are_apart_stay_apart() -> None:
    houses = (house("a", 0, "row"), house("b", 9, "row"))
    parts = [dataclasses.replace(one, surfaces=(dataclasses.replace(one.surfaces[0], group=-1),)) for one in houses]
    assert [surface.group for surface in block_of(*parts).surfaces] == [-1, -1]


def test_points_follow_their_buildings_and_faces() -> None:
    joined = joined_reference(REFERENCE)
    (tile,) = joined.points()
    assert tile.building.tolist() == [0, 0, 0, 1, -1, 0]
    assert tile.face.tolist() == [0, 2, 3, 0, -1, -1]
    assert joined.face_points == {("a", 0): 5, ("a", 1): 6, ("a", 2): 7, ("a", 3): 8, ("c", 0): 9}


def test_a_block_is_as_hard_as_its_hardest_house() -> None:
    joined = joined_reference(REFERENCE).conditions
    assert joined["a"].good is False
    assert joined["a"].defects == ("wet_spot",)
    assert joined["a"].shape == BLOCK_SHAPE
    assert joined["c"] == REFERENCE.conditions["c"]


def test_unlike_roofs_of_a_block_are_a_combination() -> None:
    block = block_of(house("a", 0, "row"), house("b", 8, "row", RoofType.FLAT))
    assert block.roof_type is RoofType.COMBINATION


def test_a_reference_without_blocks_is_left_as_it_is() -> None:
    alone = reference(REFERENCE.buildings[1:])
    assert joined_reference(alone) is alone
