"""Whether a model's own points support it: the rule that makes a valid model `doubtful`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from pipeline.model import BuildingResult, Candidate, Doubt, Reason
from pipeline.quality.detection import confidence_of
from pipeline.quality.roof_returns import TOLERANCE_M
from pipeline.quality.unseen_sides import level_side_share, unseen_beside_m2, unseen_left_out_m2

if TYPE_CHECKING:
    from pipeline.quality.support_settings import SupportSettings

NOT_OF_FORM = frozenset({Reason.NOT_SEEN, Reason.UNCERTAIN})
"""Doubts that no other form of the roof would answer."""
NOT_OF_ROOF = NOT_OF_FORM | {Reason.SCATTERED}
"""Doubts that hold for coarser models, too."""
_MOST_GROUND_NOISE_M = 0.2
"""Ground that is noisier has plants on it: no more noise of the survey is believed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Support:
    """What the points say of a model with a roof; nan where they say nothing."""

    share_on_roof: float
    """Share of the roof returns within 0.2 m of the model."""
    scatter_m: float
    """Robust standard deviation of the roof returns about the model, metres."""
    unseen_share: float
    """Share of the roof's plan area without a point on the roof nearby."""
    returns_per_face: float
    """Roof returns over roof faces."""
    beside_share: float = math.nan
    """Area without any point beside the roof, over the same and the roof's plan area. In a given footprint it is what
    the model leaves out of it."""
    confidence: float = math.nan
    """Probability that it is a building; nan where it is known to be one."""
    level_side_share: float = math.nan
    """Share of the outline where a level face ends at ground as high; nan where it is known to be a building."""
    ground_noise_m: float = math.nan
    """Noise of the survey by the ground nearby, metres."""


def support_of(record: BuildingResult, candidate: Candidate) -> Support:
    """What the points say of the delivered model of a candidate."""
    quality, n_faces = record.quality, 1 if record.roof_type.is_curved else len(record.faces)
    area_m2 = math.fsum(face.polygon.area for face in record.faces)
    beside_m2, level_share = 0.0, math.nan
    if candidate.footprint is not None and record.footprint is not None and area_m2 > 0.0:
        beside_m2 = unseen_left_out_m2(
            candidate.footprint, record.footprint, candidate.elsewhere, record.n_points / area_m2
        )
    elif record.footprint is not None:
        spacing_m = quality.point_spacing_m
        beside_m2 = unseen_beside_m2(record.footprint, record.faces, record.planes, candidate.voids, spacing_m)
        if not candidate.is_known:
            level_share = level_side_share(record.footprint, record.faces, record.planes, candidate.ground)
    return Support(
        share_on_roof=quality.share_within,
        scatter_m=quality.noise_m,
        unseen_share=quality.unexplained_m2 / area_m2 if area_m2 > 0.0 else math.nan,
        beside_share=beside_m2 / (area_m2 + beside_m2) if area_m2 > 0.0 else math.nan,
        returns_per_face=record.n_points * (1.0 - quality.share_below_roof) / n_faces if n_faces else math.nan,
        confidence=math.nan if candidate.is_known else confidence_of(record),
        level_side_share=level_share,
        ground_noise_m=candidate.ground_noise_m,
    )


def doubt_of(support: Support, settings: SupportSettings) -> Doubt | None:
    """Why the points do not support a model, the gravest reason first; None where they do.

    A figure that is nan raises no doubt.
    """
    for test in _tests_of(support, settings):
        missed = test.value > test.threshold if test.is_most else test.value < test.threshold
        if missed:
            words = f"{test.words}, {'more' if test.is_most else 'less'} than {test.threshold:{test.form}}{test.more}"
            return Doubt.of(test.reason, words, test.name, test.value, test.threshold)
    return None


class _Test(NamedTuple):
    """One figure with its threshold."""

    reason: Reason
    name: str
    """The figure's, in the record of decisions."""
    value: float
    threshold: float
    is_most: bool
    """The threshold is the most that is allowed, else the least."""
    words: str
    """The figure in words."""
    form: str = "g"
    """How the threshold is written."""
    more: str = ""
    """What is said after it."""


def _tests_of(support: Support, settings: SupportSettings) -> Iterator[_Test]:
    """All tests of a model, the gravest first."""
    most_m, least = noise_limits(support.ground_noise_m, settings)
    is_noisy = most_m > settings.max_scatter_m
    noise = f", {settings.max_scatter_noises:g} times the noise of the ground nearby" if is_noisy else ""
    scatter, share, level = support.scatter_m, support.share_on_roof, support.level_side_share
    unseen, beside = support.unseen_share, support.beside_share
    yield _Test(
        Reason.SCATTERED, "scatter_m", scatter, most_m, True, f"its roof returns scatter by {scatter:.3f} m", ".3g",
        f" m{noise}",
    )  # fmt: skip
    words = f"{share:.0%} of its roof returns lie within 0.2 m of the roof"
    yield _Test(Reason.POOR_FIT, "share_on_roof", share, least, False, words, ".0%")
    words = f"{unseen:.0%} of its roof has no point on the roof nearby"
    yield _Test(Reason.NOT_SEEN, "unseen_share", unseen, settings.max_unseen_share, True, words, ".0%")
    words = f"{beside:.0%} of what may be its roof lies beside the model, without any point"
    yield _Test(Reason.NOT_SEEN, "beside_share", beside, settings.max_beside_share, True, words, ".0%")
    words = f"{support.returns_per_face:.1f} roof returns per roof face"
    yield _Test(
        Reason.TOO_MANY_FACES, "returns_per_face", support.returns_per_face, settings.min_returns_per_face, False, words
    )
    words = f"the confidence that it is a building is {support.confidence:.3f}"
    yield _Test(
        Reason.UNCERTAIN, "detection_confidence", support.confidence, settings.min_confidence, False, words
    )  # fmt: skip
    words = f"the ground is as high as a level roof along {level:.0%} of its outline"
    yield _Test(
        Reason.UNCERTAIN, "level_side_share", level, settings.max_level_side_share, True, words, ".0%",
        ": it may be a deck or a terrace",
    )  # fmt: skip


def noise_limits(ground_noise_m: float, settings: SupportSettings) -> tuple[float, float]:
    """The largest scatter, metres, and the least share within 0.2 m, where the ground nearby has some noise.

    Of normal residuals that scatter more, fewer lie within 0.2 m: the least share falls as theirs.
    """
    usual_m = settings.max_scatter_m
    noise_m = 0.0 if math.isnan(ground_noise_m) else min(ground_noise_m, _MOST_GROUND_NOISE_M)
    most_m = max(usual_m, settings.max_scatter_noises * noise_m)
    if not most_m > usual_m:
        return usual_m, settings.min_share_on_roof
    within, usual = (math.erf(TOLERANCE_M / (math.sqrt(2.0) * scatter_m)) for scatter_m in (most_m, max(usual_m, 1e-9)))
    return most_m, settings.min_share_on_roof * within / usual
