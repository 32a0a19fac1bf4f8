"""The confidence that an object is a building."""

import math

import pytest

from pipeline.quality.detection import detection_confidence


def test_more_points_a_smoother_roof_and_fewer_pulses_that_go_on_raise_the_confidence() -> None:
    base = detection_confidence(20, 0.8, 0.1)
    assert detection_confidence(40, 0.8, 0.1) > base
    assert detection_confidence(20, 0.9, 0.1) > base
    assert detection_confidence(20, 0.8, 0.05) > base


def test_a_plain_house_is_nearly_sure_and_a_pierced_crown_is_not() -> None:
    assert detection_confidence(500, 0.95, 0.01) > 0.99
    assert detection_confidence(20, 0.3, 0.35) < 0.1


def test_few_points_without_a_pulse_that_goes_on_are_not_sure() -> None:
    assert detection_confidence(10, 0.8, 0.0) == pytest.approx(0.964, abs=1e-3)  # the example of docs/reference


@pytest.mark.parametrize("figures", [(0, 0.9, 0.1), (10, math.nan, 0.1), (10, 0.9, math.nan)])
def test_without_a_figure_the_confidence_is_not_known(figures: tuple[int, float, float]) -> None:
    assert math.isnan(detection_confidence(*figures))
