"""The confidence of a detection: how probably an object that was found in the points alone is a building."""

from __future__ import annotations

import math

from pipeline.model import BuildingResult, Reason

# Not settings: benchmarks/detection_confidence.py fits them to the surveys that docs/reference/records.md names, and
# measures how reliable they are on others.
PER_LOG_FLATNESS = 5.58
"""Log-odds per e-fold of the flatness: how wide a roof's planes are over how much their points scatter."""
AT_FLATNESS_1 = -20.02
"""Log-odds of planes as wide as their points scatter."""
MOST = 0.978
"""Confidence in the flattest object: decks, bridges and what else is flat look the same by it."""
LEAST_NOISE_M = 0.02
"""Less scatter shows nothing more."""
USUAL_NOISE_M, MOST_NOISE_M = 0.1, 0.15
"""The weights are fitted to surveys whose ground is at most so noisy as the first. What it has beyond that, up to the
second, does not count as scatter: noisier ground has plants on it, and crowns stand around it."""

_OF_CURVE = 5
"""Planes as which a curved surface counts, the fewest that show one: crowns resemble domes."""

PER_LOG_ROUGH = -0.69
"""Log-odds of a rejected object per e-fold of its rough places: the more there are, the surer it is not a roof."""
AT_NO_ROUGH = -1.77
"""Log-odds of a rejected object without a rough place."""
_NOT_JUDGED = frozenset({Reason.STRIPS_DISAGREE, Reason.OVERRIDDEN, Reason.TOO_FEW_POINTS})
"""Reasons that say nothing about the form of an object."""


def detection_confidence(noise_m: float, plane_area_m2: float, ground_noise_m: float = math.nan) -> float:
    """Probability from 0 to 1 that an object with a model of planes is a building; nan if a figure is not known.

    A roof has few, wide planes on which its points lie; a crown takes many small planes, and scatters about them. The
    flatness is the width of a plane (the root of the plan area per roof plane) over the scatter. It is a ratio of two
    lengths that every survey shows, however dense it is and however many returns a pulse has. Where the ground nearby
    shows a noisier survey, the variance that it has beyond the usual one is taken off that of the scatter.
    """
    if math.isnan(noise_m) or not plane_area_m2 > 0.0:
        return math.nan
    of_survey_m = 0.0 if math.isnan(ground_noise_m) else min(ground_noise_m, noise_m, MOST_NOISE_M)
    excess_m2 = max(0.0, of_survey_m**2 - USUAL_NOISE_M**2)
    scatter_m = max(LEAST_NOISE_M, math.sqrt(noise_m**2 - excess_m2))
    flatness = math.sqrt(plane_area_m2) / scatter_m
    return MOST * _probability(AT_FLATNESS_1 + PER_LOG_FLATNESS * math.log(flatness))


def confidence_of(record: BuildingResult) -> float:
    """The same of a delivered model, and of the model that a block replaced; nan for other blocks, or without one."""
    if record.footprint is None or not record.planes or not math.isnan(record.replaced_confidence):
        return record.replaced_confidence
    count = len(record.planes)
    plane_area_m2 = record.footprint.area / (min(count, _OF_CURVE) if record.roof_type.is_curved else count)
    return detection_confidence(record.quality.noise_m, plane_area_m2, record.ground_noise_m)


def confidence_of_rejected(reason: Reason, planar: int, rough: int) -> float:
    """Probability that a rejected object is a building after all, by its numbers of planar and of rough places.

    nan if no place could be judged, or if the reason is not about its form.
    """
    if reason in _NOT_JUDGED or planar + rough == 0:
        return math.nan
    return _probability(AT_NO_ROUGH + PER_LOG_ROUGH * math.log(1 + rough))


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))
