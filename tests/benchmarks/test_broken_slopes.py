"""Faces of models beside true ones, drawn by hand."""

import dataclasses

import pytest
import shapely

from benchmarks.broken_slopes import Judged, judged, line
from pipeline.model import RoofType
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface

RIGHT, LEFT = shapely.box(0.0, 0.0, 10.0, 3.0), shapely.box(0.0, 3.0, 10.0, 6.0)
TRUE = RoofModel(
    building_id="gambrel-0",
    footprint=shapely.box(0.0, 0.0, 10.0, 6.0),
    roof_type=RoofType.GABLE,
    surfaces=(
        RoofSurface(polygon=RIGHT, coefficients=(0.0, 0.5, 0.0)),
        RoofSurface(polygon=LEFT, coefficients=(0.0, -0.5, 3.0)),
    ),
)


def judged_as(*surfaces: RoofSurface, per_m2: float = 8.0) -> Judged:
    return next(judged([dataclasses.replace(TRUE, building_id="m", surfaces=surfaces)], [TRUE], per_m2))


def test_the_true_faces_are_all_right() -> None:
    found = judged_as(*TRUE.surfaces)
    assert (found.form, found.wanted, found.right, found.wrong, found.roof_type) == ("gambrel", 2, 2, 0, "gable")
    assert found.is_right
    assert not found.is_named


def test_one_face_over_both_is_missed_and_wrong() -> None:
    found = judged_as(RoofSurface(polygon=TRUE.footprint, coefficients=(0.0, 0.0, 0.75)))
    assert (found.right, found.wrong, found.is_right) == (0, 1, False)


@pytest.mark.parametrize(
    ("coefficients", "is_right"),
    [((0.0, 0.58, -0.12), True), ((0.0, 0.65, -0.225), False), ((0.0, 0.5, 0.16), True), ((0.0, 0.5, 0.18), False)],
)
def test_normals_agree_within_five_degrees_and_offsets_within_fifteen_centimetres(
    coefficients: tuple[float, float, float], *, is_right: bool
) -> None:
    assert judged_as(RoofSurface(polygon=RIGHT, coefficients=coefficients), TRUE.surfaces[1]).is_right == is_right


def test_a_face_of_a_few_points_or_narrower_than_two_spacings_does_not_count() -> None:
    extra = RoofSurface(polygon=shapely.box(0.0, 0.0, 10.0, 0.6), coefficients=(0.0, 0.0, 5.0))
    assert judged_as(*TRUE.surfaces, extra).wrong == 0
    assert judged_as(*TRUE.surfaces, extra, per_m2=30.0).wrong == 1


def test_a_building_without_a_model_has_nothing_right() -> None:
    found = next(judged([], [TRUE], 8.0))
    assert (found.wanted, found.right, found.roof_type) == (2, 0, "none")
    assert line("all", [found, judged_as(*TRUE.surfaces)])[1:4] == ["2", "0.500", "0.500"]
