"""The rule that makes a valid model doubtful."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.errors import SettingsError
from pipeline.methods import ReconstructSettings
from pipeline.model import DecisionKind, Outcome, Reason, Status
from pipeline.quality.detection import confidence_of
from pipeline.quality.support import Support, doubt_of, noise_limits
from pipeline.quality.support_settings import SupportSettings
from pipeline.recipe import reconstruct_building
from pipeline.settings import RunSettings

GOOD = Support(share_on_roof=0.95, scatter_m=0.04, unseen_share=0.02, returns_per_face=40.0)


@pytest.mark.parametrize(
    ("figures", "reason", "words"),
    [
        (
            {"share_on_roof": 0.69},
            Reason.POOR_FIT,
            "69% of its roof returns lie within 0.2 m of the roof, less than 70%",
        ),
        ({"scatter_m": 0.16}, Reason.SCATTERED, "its roof returns scatter by 0.160 m, more than 0.15 m"),
        ({"unseen_share": 0.61}, Reason.NOT_SEEN, "61% of its roof has no point on the roof nearby, more than 60%"),
        (
            {"beside_share": 0.21},
            Reason.NOT_SEEN,
            "21% of what may be its roof lies beside the model, without any point, more than 20%",
        ),
        (
            {"level_side_share": 0.25},
            Reason.UNCERTAIN,
            "the ground is as high as a level roof along 25% of its outline, more than 10%: it may be a deck",
        ),
        ({"returns_per_face": 1.9}, Reason.TOO_MANY_FACES, "1.9 roof returns per roof face, less than 2"),
        ({"share_on_roof": 0.3, "scatter_m": 0.5}, Reason.SCATTERED, "its roof returns scatter by 0.500 m"),
    ],
)
def test_the_gravest_threshold_that_is_missed_is_named(figures: dict[str, float], reason: Reason, words: str) -> None:
    doubt = doubt_of(dataclasses.replace(GOOD, **figures), SupportSettings())
    assert doubt is not None
    assert doubt.reason is reason
    assert doubt.words.startswith(words)
    assert doubt.check.value == figures[doubt.check.name]


def test_a_model_on_its_points_and_one_without_figures_raise_no_doubt() -> None:
    unknown = Support(share_on_roof=math.nan, scatter_m=math.nan, unseen_share=math.nan, returns_per_face=math.nan)
    exact = Support(share_on_roof=0.7, scatter_m=0.15, unseen_share=0.6, returns_per_face=2.0)
    assert [doubt_of(one, SupportSettings()) for one in (GOOD, unknown, exact)] == [None, None, None]


def crown(seed: int) -> np.ndarray:
    """The upper side of a crown of 8 m, rough by some decimetres, 4 points per m2."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-4.0, 4.0, (2, 256))
    z = 8.0 + 3.0 * np.sqrt(np.maximum(0.0, 1.0 - (x * x + y * y) / 20.0)) - rng.exponential(0.6, 256)
    return np.column_stack((x, y, z))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_crown_is_doubtful_and_says_why(seed: int) -> None:
    result = reconstruct_building(candidate(crown(seed)), "arrangement", ReconstructSettings())
    assert result.status in {Status.DOUBTFUL, Status.FALLBACK}
    assert result.reason in {Reason.SCATTERED, Reason.POOR_FIT}
    assert result.reason_detail
    assert result.solids
    assert confidence_of(result) < 0.5  # of a block, too: that of the model that it replaced
    if result.status is Status.DOUBTFUL:
        last = result.decisions[-1]
        assert (last.kind, last.outcome) == (DecisionKind.CHECK, Outcome.MISSED)


@pytest.mark.parametrize(
    ("ground_noise_m", "scatter_m", "share"),
    [(math.nan, 0.15, 0.7), (0.1, 0.15, 0.7), (0.16, 0.24, 0.51), (0.5, 0.3, 0.423)],
)
def test_the_noise_of_the_ground_nearby_moves_the_limits_up_to_a_limit_of_its_own(
    ground_noise_m: float, scatter_m: float, share: float
) -> None:
    assert noise_limits(ground_noise_m, SupportSettings()) == pytest.approx((scatter_m, share), abs=1e-3)
    assert noise_limits(ground_noise_m, SupportSettings(max_scatter_noises=0.0)) == (0.15, 0.7)


@pytest.mark.parametrize("known", [True, False])
def test_a_roof_in_a_noisy_survey_is_ok_where_the_ground_is_as_noisy(known: bool) -> None:
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0, 12, 960), rng.uniform(0, 8, 960)
    points = np.column_stack((x, y, 5.0 + 0.5 * np.minimum(y, 8.0 - y) + rng.normal(0, 0.165, 960)))
    smooth = candidate(points, footprint=shapely.box(0, 0, 12, 8) if known else None)
    on_smooth = reconstruct_building(smooth, "arrangement", ReconstructSettings())
    assert (on_smooth.status, on_smooth.reason) == (Status.DOUBTFUL, Reason.SCATTERED)
    noisy = dataclasses.replace(smooth, ground_noise_m=0.16)
    on_noisy = reconstruct_building(noisy, "arrangement", ReconstructSettings())
    assert (on_noisy.status, on_noisy.reason_detail) == (Status.OK, "")
    assert confidence_of(on_noisy) > max(0.5, confidence_of(on_smooth))


def test_the_words_of_a_doubt_say_that_the_limit_is_that_of_a_noisy_survey() -> None:
    doubt = doubt_of(dataclasses.replace(GOOD, scatter_m=0.4, ground_noise_m=0.16), SupportSettings())
    assert doubt is not None
    words = "its roof returns scatter by 0.400 m, more than 0.24 m, 1.5 times the noise of the ground nearby"
    assert doubt.words == words


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_crown_is_doubtful_in_a_noisy_survey_too(seed: int) -> None:
    noisy = dataclasses.replace(candidate(crown(seed)), ground_noise_m=0.2)
    assert reconstruct_building(noisy, "arrangement", ReconstructSettings()).status is not Status.OK


@pytest.mark.parametrize("noise_m", [0.02, 0.1])
def test_a_gable_with_a_dormer_and_a_chimney_is_ok(noise_m: float) -> None:
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0, 12, 960), rng.uniform(0, 8, 960)
    z = 5.0 + 0.7 * np.minimum(y, 8.0 - y) + rng.normal(0, noise_m, 960)
    z[(abs(x - 3.0) < 1.0) & (y < 2.5) & (y > 1.0)] = 7.2
    z[(abs(x - 9.0) < 0.3) & (abs(y - 4.0) < 0.3)] = 9.0
    result = reconstruct_building(
        candidate(np.column_stack((x, y, z)), footprint=shapely.box(0, 0, 12, 8)), "arrangement", ReconstructSettings()
    )
    assert (result.status, result.reason, result.reason_detail) == (Status.OK, None, "")


@pytest.mark.parametrize("lods", [("1.2",), ("1.3",), ("1.2", "1.3")])
def test_a_coarser_model_is_judged_by_the_roof_that_it_comes_from(lods: tuple[str, ...]) -> None:
    result = reconstruct_building(candidate(crown(1)), "arrangement", ReconstructSettings(lods=lods))
    assert (result.status, result.reason, result.lod) == (Status.DOUBTFUL, Reason.SCATTERED, lods[-1])
    assert confidence_of(result) < 0.1


@pytest.mark.parametrize("lods", [("1.2",), ("1.3",)])
def test_a_coarser_model_need_not_lie_on_its_points(lods: tuple[str, ...]) -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 12, 960), rng.uniform(0, 8, 960)
    points = np.column_stack((x, y, 5.0 + 0.7 * np.minimum(y, 8.0 - y) + rng.normal(0, 0.02, 960)))
    result = reconstruct_building(candidate(points), "arrangement", ReconstructSettings(lods=lods))
    assert (result.status, result.lod) == (Status.OK, lods[-1])
    assert result.quality.share_within < 0.5


@pytest.mark.parametrize(("seen_m", "status"), [(5.0, Status.DOUBTFUL), (10.5, Status.OK)])
def test_what_a_model_leaves_out_of_a_given_footprint_is_not_seen(seen_m: float, status: Status) -> None:
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0, seen_m, 600), rng.uniform(0, 8, 600)
    points = np.column_stack((x, y, 5.0 + rng.normal(0, 0.02, 600)))
    given = candidate(points, footprint=shapely.box(0, 0, 12, 8))
    result = reconstruct_building(given, "arrangement", ReconstructSettings())
    assert result.status is status
    if status is Status.DOUBTFUL:
        assert result.reason is Reason.NOT_SEEN
        # where other points lie, of a yard or of the ground, no roof is missing
        x, y = np.meshgrid(np.arange(seen_m + 1.5, 11.0), np.arange(1.5, 7.0))
        yard = np.column_stack((x.ravel(), y.ravel(), 0.0 * x.ravel()))
        result = reconstruct_building(dataclasses.replace(given, elsewhere=yard), "arrangement", ReconstructSettings())
        assert result.status is Status.OK


def test_thresholds_are_settings() -> None:
    settings = RunSettings.from_mapping(
        {"support": {"min_share_on_roof": 0.2, "max_scatter_m": 5.0, "min_confidence": 0.0}}
    )
    assert reconstruct_building(candidate(crown(1)), "arrangement", settings.building).status is Status.OK
    assert settings.settings_hash != RunSettings().settings_hash
    with pytest.raises(SettingsError, match="min_share_on_roof"):
        RunSettings.from_mapping({"support": {"min_share_on_roof": 2.0}})
