"""Fit and reliability of the confidence: candidates by hand, weights that are known, classes that say what is what."""

import dataclasses
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely

from benchmarks.calibration_data import Candidates, is_building, points_of
from benchmarks.detection_confidence import Weights, calibration_error, fitted, kinds_of
from pipeline.model import FloatArray

TRUE = Weights(per_log_flatness=4.0, at_flatness_1=-14.0, most=0.97, per_log_rough=-0.7, at_no_rough=-1.5)


def candidates(count: int, seed: int) -> Candidates:
    """As many models as rejected objects, right as often as the true weights say."""
    random = np.random.default_rng(seed)
    is_model = np.arange(count) % 2 == 0
    figure = np.where(is_model, random.uniform(2.0, 7.0, count), random.uniform(0.0, 4.0, count))
    some = Candidates(
        survey=np.full(count, "d0.8_last"),
        is_real=random.random(count) < 0.3,
        is_model=is_model,
        is_block=np.zeros(count, bool),
        figure=figure,
        right=np.zeros(count, bool),
    )
    right = random.random(count) < TRUE.confidence(some)
    return dataclasses.replace(some, right=right)


def test_the_fit_finds_the_weights_by_which_candidates_are_right() -> None:
    found = fitted(candidates(40_000, 1))
    assert found.per_log_flatness == pytest.approx(TRUE.per_log_flatness, rel=0.1)
    assert found.at_flatness_1 == pytest.approx(TRUE.at_flatness_1, rel=0.1)
    assert found.most == pytest.approx(TRUE.most, abs=0.01)
    assert found.per_log_rough == pytest.approx(TRUE.per_log_rough, abs=0.1)
    assert found.at_no_rough == pytest.approx(TRUE.at_no_rough, abs=0.2)


def test_confidence_that_is_right_as_often_as_it_says_has_nearly_no_error_and_any_other_has() -> None:
    some = candidates(20_000, 2)
    p = TRUE.confidence(some)
    assert calibration_error(p, some.right) < 0.02
    assert calibration_error(np.full(len(some), some.right.mean() + 0.1), some.right) == pytest.approx(0.1)
    assert calibration_error(1.0 - p, some.right) > 0.3


def test_simulated_surveys_are_grouped_by_returns_and_density() -> None:
    names = ["d0.3_five", "d0.8_last", "d1.5_first_z0.45", "d30_first_and_last", "d4_five_feet"]
    some = Candidates(
        survey=np.array(names),
        is_real=np.zeros(5, bool),
        is_model=np.ones(5, bool),
        is_block=np.zeros(5, bool),
        figure=np.zeros(5),
        right=np.ones(5, bool),
    )
    kinds = {name.removeprefix("simulated, "): chosen.tolist() for name, chosen in kinds_of(some).items()}
    assert kinds["many returns"] == [True, False, False, False, False]
    assert kinds["one return"] == [False, True, True, False, False]
    assert kinds["first and last"] == [False, False, False, True, False]
    assert kinds["under 2 per m2"] == [True, True, True, False, False]
    assert kinds["in feet"] == [False, False, False, False, True]
    assert kinds["simulated"] == [True, True, True, True, False]


def points(classes: list[int], went_on: float) -> FloatArray:
    """Points 5 m above the floor, all last returns, a share of which counts as gone on."""
    count = len(classes)
    return np.column_stack(
        [
            np.zeros(count),
            np.zeros(count),
            np.full(count, 5.0),
            classes,
            np.ones(count),
            np.arange(count) < went_on * count,
        ]
    ).astype(float)


@pytest.mark.parametrize(
    ("classes", "went_on", "expected"),
    [
        ([6] * 8 + [1] * 2, 0.0, True),
        ([6] * 5 + [5] * 5, 0.0, None),
        ([5] * 8 + [6] * 2, 0.0, False),
        ([1] * 10, 0.5, False),
        ([1] * 10, 0.1, None),
        ([26] * 10, 0.0, False),
    ],
)
def test_classes_say_what_is_a_building_and_where_they_do_not(
    classes: list[int], went_on: float, expected: bool | None
) -> None:
    assert is_building(points(classes, went_on), 0.0) is expected
    assert is_building(points(classes, went_on), 4.0) is None  # all of it is too low


def test_points_of_an_outline_are_those_of_all_its_files(tmp_path: Path) -> None:
    for name, x0 in (("west", 0.0), ("east", 10.0)):
        las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
        las.header.scales = [0.001] * 3
        las.x, las.y, las.z = x0 + np.arange(10.0), np.zeros(10), np.full(10, 3.0)
        las.classification = np.full(10, 6, np.uint8)
        las.return_number, las.number_of_returns = np.ones(10, np.uint8), np.full(10, 2, np.uint8)
        las.write(tmp_path / f"{name}.las")
    _, look = points_of([tmp_path / "west.las", tmp_path / "east.las"])
    found = look(shapely.box(7.5, -1.0, 12.5, 1.0))
    assert found[:, 0].tolist() == [8.0, 9.0, 10.0, 11.0, 12.0]
    assert (found[:, 3:] == [6.0, 0.0, 1.0]).all()
