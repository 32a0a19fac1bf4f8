"""Boxes on roofs: chimneys become closed boxes of their own, and crowns, wires, aerials and walls do not."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate
from faces_by_hand import level, plane
from numpy.typing import NDArray

from pipeline.extras.superstructures.boxes import box_solid
from pipeline.extras.superstructures.finding import FoundBox, RoofModel, found_boxes
from pipeline.methods import ReconstructSettings
from pipeline.model import FaceKind, Plane, RoofFace
from pipeline.quality.residuals import surface_of
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.roof_settings import RoofSettings

Points = NDArray[np.float64]

PLANES = (plane(0.0, 0.7, 5.0), plane(0.0, -0.7, 10.6))
"""A gable of 12 m by 8 m whose ridge is at 7.8 m."""
FACES = (
    RoofFace(plane=0, polygon=shapely.Polygon([(0, 0, 5), (12, 0, 5), (12, 4, 7.8), (0, 4, 7.8)])),
    RoofFace(plane=1, polygon=shapely.Polygon([(0, 4, 7.8), (12, 4, 7.8), (12, 8, 5), (0, 8, 5)])),
)
CHIMNEY, TOP_Z_M = (3.0, 1.5, 3.7, 2.3), 7.6
"""Smallest and largest x and y of a chimney; its roof lies at 6.05 to 6.61 m."""


def roof_z(xy: Points) -> Points:
    return np.minimum(5.0 + 0.7 * xy[:, 1], 10.6 - 0.7 * xy[:, 1])


def strewn(seed: int = 0, per_m2: float = 20.0) -> Points:
    """Points of the bare roof."""
    random = np.random.default_rng(seed)
    xy = random.uniform((0, 0), (12, 8), (round(96 * per_m2), 2))
    return np.column_stack([xy, roof_z(xy) + random.normal(0, 0.02, len(xy))])


def chimney(points: Points, box: Sequence[float] = CHIMNEY, top_z_m: float = TOP_Z_M) -> Points:
    """The points with those within a box lifted to its top."""
    lifted = points.copy()
    inside = (points[:, :2] >= box[:2]).all(axis=1) & (points[:, :2] <= box[2:]).all(axis=1)
    lifted[inside, 2] = top_z_m + np.random.default_rng(1).normal(0, 0.02, inside.sum())
    return lifted


def model(faces: Sequence[RoofFace] = FACES, planes: Sequence[Plane] = PLANES, spacing_m: float = 0.22) -> RoofModel:
    return RoofModel(
        surface=surface_of(faces, planes),
        faces=faces,
        planes=planes,
        outline=shapely.box(0, 0, 12, 8),
        spacing_m=spacing_m,
        noise_m=0.02,
    )


def boxes_on(points: Points, split: NDArray[np.bool_] | None = None, roof: RoofModel | None = None) -> list[FoundBox]:
    return found_boxes(points, np.zeros(len(points), bool) if split is None else split, roof or model())


def extent(box: FoundBox) -> Points:
    return np.concatenate([box.corners.min(axis=0), box.corners.max(axis=0)])


@pytest.mark.parametrize("seed", range(5))
def test_a_chimney_is_found_with_its_top_and_about_its_sides(seed: int) -> None:
    (box,) = boxes_on(chimney(strewn(seed)))
    assert box.top_z_m == pytest.approx(TOP_Z_M, abs=0.03)
    assert extent(box) == pytest.approx(np.array(CHIMNEY), abs=0.25)


def test_four_points_are_enough_and_three_are_not() -> None:
    bare = strewn()
    x0, y0, x1, y1 = CHIMNEY
    around = ~((bare[:, :2] > (x0, y0)) & (bare[:, :2] < (x1, y1))).all(axis=1)
    corners = np.array([(3.2, 1.7), (3.5, 1.7), (3.5, 2.0), (3.2, 2.0)])
    four = np.column_stack([corners, np.full(4, TOP_Z_M)])
    assert len(boxes_on(np.vstack([bare[around], four]))) == 1
    assert boxes_on(np.vstack([bare[around], four[:3]])) == []


def test_nothing_stands_on_a_bare_roof() -> None:
    assert boxes_on(strewn()) == []


def test_a_crown_has_no_level_top() -> None:
    points = strewn()
    x, y = points[:, 0] - 11.0, points[:, 1] - 7.0
    crown = x**2 + y**2 < 4.0
    random = np.random.default_rng(2)
    points[crown, 2] += 1.0 + np.sqrt(4.0 - x[crown] ** 2 - y[crown] ** 2) * random.uniform(0.3, 1.0, crown.sum())
    assert boxes_on(points) == []


@pytest.mark.parametrize("has_returns", [True, False])
def test_a_wire_and_the_rods_of_an_aerial_are_not_boxes(*, has_returns: bool) -> None:
    bare = strewn()
    wire = np.abs(bare[:, 1] - 3.0) < 0.12
    rod = (np.abs(bare[:, 0] - 9.0) < 0.5) & (np.abs(bare[:, 1] - 6.0) < 0.12)
    above = np.vstack([bare[wire] * (1, 1, 0) + (0, 0, 9.5), bare[rod] * (1, 1, 0) + (0, 0, 9.0)])
    through = np.vstack([above, bare])
    split = np.arange(len(through)) < len(above)
    assert boxes_on(through, split & has_returns) == []


def test_what_most_pulses_pass_through_is_not_a_box() -> None:
    bare = strewn()
    inside = (bare[:, :2] >= CHIMNEY[:2]).all(axis=1) & (bare[:, :2] <= CHIMNEY[2:]).all(axis=1)
    above = bare[inside] * (1, 1, 0) + (0, 0, TOP_Z_M)
    assert boxes_on(np.vstack([above, bare])) == []


def test_a_mast_is_too_high_for_its_width() -> None:
    assert boxes_on(chimney(strewn(), top_z_m=12.5)) == []


def test_the_edge_of_a_higher_roof_beyond_its_face_is_not_a_box() -> None:
    lower = RoofFace(plane=0, polygon=shapely.Polygon([(0, 0, 3), (6, 0, 3), (6, 8, 3), (0, 8, 3)]))
    upper = RoofFace(plane=1, polygon=shapely.Polygon([(6, 0, 5), (12, 0, 5), (12, 8, 5), (6, 8, 5)]))
    points = strewn()
    points[:, 2] = np.where(points[:, 0] > 5.7, 5.0, 3.0)
    assert boxes_on(points, roof=model((lower, upper), (level(3.0), level(5.0)))) == []


def test_a_survey_that_does_not_resolve_a_box_has_none() -> None:
    points = chimney(strewn())
    assert boxes_on(points, roof=model(spacing_m=1.2)) == []


def box_at(x0: float, y0: float, x1: float, y1: float, top_z_m: float) -> FoundBox:
    return FoundBox(corners=np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), top_z_m=top_z_m)


@pytest.mark.parametrize(("y0", "n_feet"), [(1.5, 1), (3.6, 2)])
def test_the_foot_follows_the_roof_across_the_ridge_too(y0: float, n_feet: int) -> None:
    solid = box_solid(box_at(3.0, y0, 3.7, y0 + 0.8, 8.6), FACES, PLANES)
    assert solid is not None
    assert check_solid(solid) == ()
    feet = [face for face in solid.faces if face.kind is FaceKind.CLOSURE]
    assert len(feet) == n_feet
    corners = solid.vertices[[k for face in feet for k in face.rings[0]]]
    above = corners[:, 2] - roof_z(corners)
    assert ((above > 0.0) & (above < 0.01)).all()
    (top,) = (face for face in solid.faces if face.kind is FaceKind.ROOF)
    assert set(solid.vertices[list(top.rings[0]), 2]) == {8.6}


def test_across_a_step_a_box_stands_on_the_higher_side() -> None:
    lower = RoofFace(plane=0, polygon=shapely.Polygon([(0, 0, 3), (6, 0, 3), (6, 8, 3), (0, 8, 3)]))
    upper = RoofFace(plane=1, polygon=shapely.Polygon([(6, 0, 5), (12, 0, 5), (12, 8, 5), (6, 8, 5)]))
    planes = (level(3.0), level(5.0))
    solid = box_solid(box_at(5.5, 2.0, 6.5, 3.0, 6.0), (lower, upper), planes)
    assert solid is not None
    assert check_solid(solid) == ()
    assert solid.vertices[:, 2].min() == pytest.approx(5.0, abs=0.01)
    assert box_solid(box_at(5.5, 2.0, 6.5, 3.0, 5.1), (lower, upper), planes) is None
    at_the_outline = box_solid(box_at(5.5, 7.4, 6.5, 8.2, 6.0), (lower, upper), planes)
    assert at_the_outline is not None
    assert at_the_outline.vertices[:, 1].max() == 8.0


def test_a_box_ends_at_the_outline() -> None:
    solid = box_solid(box_at(11.5, 1.5, 12.4, 2.3, 8.0), FACES, PLANES)
    assert solid is not None
    assert solid.vertices[:, 0].max() == 12.0


def test_boxes_come_with_the_setting_and_change_nothing_else() -> None:
    points = np.round(chimney(strewn()), 3)
    house = candidate(points, footprint=shapely.box(0, 0, 12, 8))
    plain = reconstruct_building(house, "arrangement", ReconstructSettings())
    boxed = reconstruct_building(house, "arrangement", ReconstructSettings(roof=RoofSettings(superstructures=True)))
    assert plain.boxes is None
    assert boxed.boxes is not None
    assert len(boxed.boxes) == 1
    assert check_solid(boxed.boxes[0]) == ()
    assert boxed.roof_type == plain.roof_type == "gable"
    assert dataclasses.replace(boxed, boxes=None, solids=()) == dataclasses.replace(plain, solids=())
