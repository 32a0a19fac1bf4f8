"""The confidence of a detection: how probably an object that was found in the points alone is a building."""

from __future__ import annotations

import math

# Not settings: fitted by logistic regression to the buildings of the tiles that docs/reference/records.md names, over
# which benchmarks/detection_confidence.py measures how reliable the result is.
PER_LOG_POINT = 0.53
"""Log-odds per e-fold of the number of points: few points may lie level by chance."""
PER_SHARE_WITHIN = 3.9
"""Log-odds of a roof whose points all lie within 0.2 m of planes: crowns are not planar."""
PER_SHARE_THROUGH = -16.0
"""Log-odds of an object through which all pulses go: they go through leaves and not through roofs."""
PRIOR_POINTS, PRIOR_THROUGH = 5, 1
"""Few points show a share badly: so many are added, and so many pulses of theirs go on."""


def detection_confidence(n_points: int, share_within: float, through_share: float) -> float:
    """Probability from 0 to 1 that an object with a model is a building; nan if a figure is not known.

    Logistic in the logarithm of the number of points, in the share of points within 0.2 m of the roof, and in the
    share of points whose pulse went on to a later return.
    """
    if n_points < 1 or math.isnan(share_within) or math.isnan(through_share):
        return math.nan
    through = (through_share * n_points + PRIOR_THROUGH) / (n_points + PRIOR_POINTS)
    odds = PER_LOG_POINT * math.log(n_points) + PER_SHARE_WITHIN * share_within + PER_SHARE_THROUGH * through
    return 1.0 / (1.0 + math.exp(-odds))
