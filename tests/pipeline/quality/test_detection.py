"""The confidence that an object is a building."""

import math

import pytest

from pipeline.model import Reason
from pipeline.quality.detection import MOST, confidence_of_rejected, detection_confidence


def test_a_smoother_roof_with_larger_planes_raises_the_confidence() -> None:
    base = detection_confidence(0.1, 10.0)
    assert detection_confidence(0.05, 10.0) > base
    assert detection_confidence(0.1, 20.0) > base


def test_a_plain_house_is_nearly_sure_and_a_crown_is_not() -> None:
    assert detection_confidence(0.03, 40.0) > 0.97
    assert detection_confidence(0.25, 6.0) < 0.1


def test_a_gable_of_two_first_echoes_per_square_metre_is_likely_a_building() -> None:
    assert detection_confidence(0.1, 25.0) > 0.7


def test_a_model_that_is_as_large_and_as_rough_in_proportion_has_the_same_confidence() -> None:
    assert detection_confidence(0.1, 9.0) == pytest.approx(detection_confidence(0.2, 36.0))


def test_nothing_flat_is_surer_than_what_is_known_of_decks_and_bridges() -> None:
    assert detection_confidence(0.001, 1e6) == pytest.approx(MOST)


def test_the_example_of_the_docs_is_right() -> None:
    assert detection_confidence(0.08, 16.0) == pytest.approx(0.840, abs=1e-3)


def test_scatter_below_what_a_scanner_measures_shows_nothing_more() -> None:
    assert detection_confidence(0.0, 5.0) == detection_confidence(0.02, 5.0) < MOST


@pytest.mark.parametrize("figures", [(math.nan, 20.0), (0.1, math.nan), (0.1, 0.0)])
def test_without_a_figure_the_confidence_is_not_known(figures: tuple[float, float]) -> None:
    assert math.isnan(detection_confidence(*figures))


def test_the_more_of_a_rejected_object_is_rough_the_surer_it_is_not_a_building() -> None:
    few, many = (confidence_of_rejected(Reason.VEGETATION, 3, rough) for rough in (2, 200))
    assert 0.0 < many < few < 0.5


@pytest.mark.parametrize("reason", [Reason.STRIPS_DISAGREE, Reason.TOO_FEW_POINTS, Reason.OVERRIDDEN])
def test_a_rejected_object_whose_form_was_not_judged_has_no_confidence(reason: Reason) -> None:
    assert math.isnan(confidence_of_rejected(reason, 5, 5))
    assert math.isnan(confidence_of_rejected(Reason.TOO_SMALL, 0, 0))


def test_noise_that_the_ground_has_beyond_the_usual_is_no_scatter_of_a_roof() -> None:
    quiet = detection_confidence(0.15, 16.0)
    assert detection_confidence(0.15, 16.0, 0.1) == quiet  # the fit knows such surveys
    noisy = detection_confidence(0.15, 16.0, 0.15)
    assert noisy == pytest.approx(detection_confidence(0.1, 16.0))
    assert noisy > quiet
    # crowns on rough ground: no more than 0.15 m is believed, and no more than the object itself scatters
    assert detection_confidence(0.3, 16.0, 0.5) == detection_confidence(0.3, 16.0, 0.15)
    assert detection_confidence(0.09, 16.0, 0.5) == detection_confidence(0.09, 16.0)
