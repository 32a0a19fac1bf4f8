"""The confidence of a detection: how probably an object that was found in the points alone is a building."""

from __future__ import annotations

import math

from pipeline.model import BuildingResult

# Not settings: fitted by logistic regression to the surveys that docs/reference/records.md names;
# benchmarks/detection_confidence.py and benchmarks/trust.py measure how reliable the result is.
PER_LOG_NOISE = -2.06
"""Log-odds per e-fold of the scatter about the roof: crowns are rough."""
PER_SHARE_WITHIN = 4.82
"""Log-odds of a roof whose returns all lie within 0.2 m of planes: crowns are not planar."""
PER_LOG_PLANE_AREA = 2.77
"""Log-odds per e-fold of the plan area per roof plane: a crown takes many small planes."""
AT_ONE = -15.65
"""Log-odds of no share, 1 m of scatter and planes of 1 m2."""
LEAST_NOISE_M = 0.005
"""Less scatter shows nothing more."""


def detection_confidence(noise_m: float, share_within: float, plane_area_m2: float) -> float:
    """Probability from 0 to 1 that an object with a model of planes is a building; nan if a figure is not known.

    Logistic in the share of roof returns within 0.2 m of the roof, and in the logarithms of their scatter and of the
    plan area per roof plane. These mean the same in every survey, however many returns a pulse has.
    """
    if math.isnan(noise_m) or math.isnan(share_within) or not plane_area_m2 > 0.0:
        return math.nan
    odds = AT_ONE + PER_LOG_NOISE * math.log(max(LEAST_NOISE_M, noise_m))
    odds += PER_SHARE_WITHIN * share_within + PER_LOG_PLANE_AREA * math.log(plane_area_m2)
    return 1.0 / (1.0 + math.exp(-odds))


def confidence_of(record: BuildingResult) -> float:
    """The same of a delivered model; nan for a block and without a model."""
    if record.footprint is None or not record.planes:
        return math.nan
    quality = record.quality
    return detection_confidence(quality.noise_m, quality.share_within, record.footprint.area / len(record.planes))
