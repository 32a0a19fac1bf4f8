"""Whether a model's own points support it: the rule that makes a valid model `doubtful`."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from pipeline.model import BuildingResult, Doubt, Reason
from pipeline.quality.detection import confidence_of

if TYPE_CHECKING:
    from pipeline.quality.settings import SupportSettings


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
    confidence: float = math.nan
    """Probability that it is a building; nan where it is known to be one."""


def support_of(record: BuildingResult, *, is_known: bool) -> Support:
    """What the points say of a delivered model; `is_known` says that it is certainly of a building."""
    quality, n_faces = record.quality, len(record.faces)
    area_m2 = math.fsum(face.polygon.area for face in record.faces)
    return Support(
        share_on_roof=quality.share_within,
        scatter_m=quality.noise_m,
        unseen_share=quality.unexplained_m2 / area_m2 if area_m2 > 0.0 else math.nan,
        returns_per_face=record.n_points * (1.0 - quality.share_below_roof) / n_faces if n_faces else math.nan,
        confidence=math.nan if is_known else confidence_of(record),
    )


def doubt_of(support: Support, settings: SupportSettings) -> Doubt | None:
    """Why the points do not support a model, the gravest reason first; None where they do.

    A figure that is nan raises no doubt.
    """
    scatter, most = support.scatter_m, settings.max_scatter_m
    if scatter > most:
        words = f"its roof returns scatter by {scatter:.2f} m, more than {most:g} m"
        return Doubt.of(Reason.SCATTERED, words, "scatter_m", scatter, most)
    share, least = support.share_on_roof, settings.min_share_on_roof
    if share < least:
        words = f"{share:.0%} of its roof returns lie within 0.2 m of the roof, less than {least:.0%}"
        return Doubt.of(Reason.POOR_FIT, words, "share_on_roof", share, least)
    unseen, most = support.unseen_share, settings.max_unseen_share
    if unseen > most:
        words = f"{unseen:.0%} of its roof has no point on the roof nearby, more than {most:.0%}"
        return Doubt.of(Reason.NOT_SEEN, words, "unseen_share", unseen, most)
    returns, least = support.returns_per_face, settings.min_returns_per_face
    if returns < least:
        words = f"{returns:.1f} roof returns per roof face, less than {least:g}"
        return Doubt.of(Reason.TOO_MANY_FACES, words, "returns_per_face", returns, least)
    confidence, least = support.confidence, settings.min_confidence
    if confidence < least:
        words = f"the confidence that it is a building is {confidence:.2f}, less than {least:g}"
        return Doubt.of(Reason.UNCERTAIN, words, "detection_confidence", confidence, least)
    return None
