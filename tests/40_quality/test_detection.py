"""The confidence that an object is a building."""

import math

import pytest

from pipeline.quality.detection import detection_confidence


def test_a_smoother_roof_on_its_points_with_larger_planes_raises_the_confidence() -> None:
    base = detection_confidence(0.1, 0.8, 10.0)
    assert detection_confidence(0.05, 0.8, 10.0) > base
    assert detection_confidence(0.1, 0.9, 10.0) > base
    assert detection_confidence(0.1, 0.8, 20.0) > base


def test_a_plain_house_is_nearly_sure_and_a_crown_is_not() -> None:
    assert detection_confidence(0.03, 0.95, 40.0) > 0.99
    assert detection_confidence(0.25, 0.5, 6.0) < 0.1


def test_the_example_of_the_docs_is_right() -> None:
    assert detection_confidence(0.05, 0.9, 20.0) == pytest.approx(0.959, abs=1e-3)


def test_scatter_below_what_a_scanner_measures_shows_nothing_more() -> None:
    assert detection_confidence(0.0, 0.9, 20.0) == detection_confidence(0.005, 0.9, 20.0) < 1.0


@pytest.mark.parametrize(
    "figures", [(math.nan, 0.9, 20.0), (0.1, math.nan, 20.0), (0.1, 0.9, math.nan), (0.1, 0.9, 0.0)]
)
def test_without_a_figure_the_confidence_is_not_known(figures: tuple[float, float, float]) -> None:
    assert math.isnan(detection_confidence(*figures))
