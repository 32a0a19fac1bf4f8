"""Whether a model's own points support it: the rule that makes a valid model `doubtful`."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from pipeline.model import BuildingResult, Candidate, Doubt, Reason
from pipeline.quality.detection import confidence_of
from pipeline.quality.level_sides import level_side_share
from pipeline.quality.unseen_sides import unseen_beside_m2, unseen_left_out_m2

if TYPE_CHECKING:
    from pipeline.quality.settings import SupportSettings

NOT_OF_FORM = frozenset({Reason.NOT_SEEN, Reason.UNCERTAIN})
"""Doubts that no other form of the roof would answer."""
NOT_OF_ROOF = NOT_OF_FORM | {Reason.SCATTERED}
"""Doubts that hold for coarser models, too."""


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


def support_of(record: BuildingResult, candidate: Candidate) -> Support:
    """What the points say of the delivered model of a candidate."""
    quality, n_faces = record.quality, len(record.faces)
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
    )


def doubt_of(support: Support, settings: SupportSettings) -> Doubt | None:
    """Why the points do not support a model, the gravest reason first; None where they do.

    A figure that is nan raises no doubt.
    """
    scatter, most = support.scatter_m, settings.max_scatter_m
    if scatter > most:
        words = f"its roof returns scatter by {scatter:.3f} m, more than {most:g} m"
        return Doubt.of(Reason.SCATTERED, words, "scatter_m", scatter, most)
    share, least = support.share_on_roof, settings.min_share_on_roof
    if share < least:
        words = f"{share:.0%} of its roof returns lie within 0.2 m of the roof, less than {least:.0%}"
        return Doubt.of(Reason.POOR_FIT, words, "share_on_roof", share, least)
    unseen, most = support.unseen_share, settings.max_unseen_share
    if unseen > most:
        words = f"{unseen:.0%} of its roof has no point on the roof nearby, more than {most:.0%}"
        return Doubt.of(Reason.NOT_SEEN, words, "unseen_share", unseen, most)
    beside, most = support.beside_share, settings.max_beside_share
    if beside > most:
        words = f"{beside:.0%} of what may be its roof lies beside the model, without any point, more than {most:.0%}"
        return Doubt.of(Reason.NOT_SEEN, words, "beside_share", beside, most)
    returns, least = support.returns_per_face, settings.min_returns_per_face
    if returns < least:
        words = f"{returns:.1f} roof returns per roof face, less than {least:g}"
        return Doubt.of(Reason.TOO_MANY_FACES, words, "returns_per_face", returns, least)
    confidence, least = support.confidence, settings.min_confidence
    if confidence < least:
        words = f"the confidence that it is a building is {confidence:.3f}, less than {least:g}"
        return Doubt.of(Reason.UNCERTAIN, words, "detection_confidence", confidence, least)
    level, most = support.level_side_share, settings.max_level_side_share
    if level > most:
        words = f"the ground is as high as a level roof along {level:.0%} of its outline, more than {most:.0%}: "
        return Doubt.of(Reason.UNCERTAIN, words + "it may be a deck or a terrace", "level_side_share", level, most)
    return None
