"""From coarse to refined clusters of facets: weights, centres and membership (Hofmann et al. 2003, sections 4.1, 4.2).

A facet weighs as much as there are facets of its cluster close to it; the weighted mean is the cluster's centre, and
each facet belongs to the centre nearest to it. What close and near mean depends on the slope: the same noise of the
heights turns a gentle plane much further than a steep one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import ClusterMembershipSettings
from pipeline.model import BoolArray, FloatArray, LabelArray, Reason
from pipeline.segmentation.facet_geometry import kept_clusters


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefinedClusters:
    """Clusters with their centres."""

    labels: LabelArray
    """(m,) int32, cluster of every facet, -1 for none."""
    centres: FloatArray
    """(k, 3) float64, weighted mean slope and orientation in degrees, O-distance in metres."""


def spreads(slope_deg: float, spacing_m: float, settings: ClusterMembershipSettings) -> tuple[float, float, float]:
    """Standard deviations of slope and orientation (degrees) and O-distance (metres) that height noise gives facets.

    They are those of a cluster of a mean slope. The gradient of an equilateral facet with side s, the mean point
    spacing, over points with height noise sigma has the standard deviation sqrt(2) sigma / s in every direction. Along
    the slope it turns the plane by cos^2(slope) of that, across it by 1 / tan(slope).
    """
    slope = math.radians(min(max(slope_deg, 0.0), 90.0))
    gradient = math.sqrt(2.0) * settings.height_noise_m / spacing_m
    across = gradient / max(math.tan(slope), 1e-9)
    turn = min(math.degrees(across), 180.0)
    return math.degrees(math.cos(slope) ** 2 * gradient), turn, settings.typical_o_range_m / 4.0


def refine_clusters(
    parameters: FloatArray, coarse: Sequence[LabelArray], spacing_m: float, settings: ClusterMembershipSettings
) -> RefinedClusters:
    """Centres of coarse clusters, and the facets that belong to them.

    Clusters with members enough whose O-distance has a small deviation (section 4.1) remain, in the order of `coarse`.

    Parameters
    ----------
    parameters : (m, 3) float64
        Slope and orientation in degrees, O-distance in metres.
    coarse : sequence of (k,) int32
        Facets of each coarse cluster, at least one; they may overlap.

    Raises
    ------
    BuildingError
        Reason ``too_complex`` beyond ``membership_work_limit``.
    """
    parameters = np.ascontiguousarray(parameters)
    work = sum(len(own) * min(len(own), settings.weight_sample) for own in coarse) + len(parameters) * len(coarse)
    if work > settings.membership_work_limit:
        raise BuildingError(
            Reason.TOO_COMPLEX,
            f"the refinement of {len(coarse)} clusters of {len(parameters)} facets takes {work} comparisons, "
            f"membership_work_limit is {settings.membership_work_limit}",
        )
    centres = np.empty((len(coarse), 3))
    scales = np.empty((len(coarse), 3))
    deviations = np.empty(len(coarse))
    for k, own in enumerate(coarse):
        members = parameters[own]
        mean = _weighted_mean(members, np.ones(len(members)))
        close = settings.close_spreads * np.array(spreads(float(mean[0]), spacing_m, settings))
        weights = _close_points(members, close, settings.weight_sample)
        centres[k] = _weighted_mean(members, weights)
        scales[k] = spreads(float(centres[k, 0]), spacing_m, settings)
        deviations[k] = members[:, 2].std()
    # the search in O-distance is widened by the standard deviation of the mean cluster
    if len(coarse):
        scales[:, 2] += float(deviations.mean()) / settings.member_spreads
    labels = _nearest_centre(parameters, centres, scales, settings.member_spreads)
    counts = np.bincount(labels[labels >= 0], minlength=len(coarse))
    kept = counts >= settings.min_members
    for k in np.flatnonzero(kept).tolist():
        kept[k] = parameters[labels == k, 2].std() < settings.max_o_deviation_m
    labels, centres = kept_clusters(labels, centres, kept)
    return RefinedClusters(labels=labels, centres=centres)


def may_be_roof(centres: FloatArray, settings: ClusterMembershipSettings) -> BoolArray:
    """The preliminary step of section 4.2: (k,) bool, False for ground and walls by the centres of their clusters."""
    ground = (centres[:, 2] < 0.0) & (centres[:, 0] < settings.ground_below_deg)
    return np.asarray(~ground & (centres[:, 0] <= settings.wall_above_deg))


@kernel
def _turn(a_deg: float, b_deg: float) -> float:
    """Angle between two orientations, 0 to 180."""
    turn = abs(a_deg - b_deg)
    return min(turn, 360.0 - turn)


@kernel
def _weighted_mean(members: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean of the parameters, orientation on the circle; equal weights where all are 0."""
    total = weights.sum()
    mean = np.zeros(3)
    east = 0.0
    north = 0.0
    for i in range(len(members)):
        weight = weights[i] / total if total > 0.0 else 1.0 / len(members)
        mean[0] += weight * members[i, 0]
        mean[2] += weight * members[i, 2]
        east += weight * math.sin(math.radians(members[i, 1]))
        north += weight * math.cos(math.radians(members[i, 1]))
    mean[1] = math.degrees(math.atan2(east, north)) % 360.0 % 360.0
    return mean


@kernel
def _close_points(members: FloatArray, close: FloatArray, sample: int) -> FloatArray:
    """For each member the number of other members within the distances in all three parameters.

    Beyond `sample` members, evenly spread ones are counted against.
    """
    n = len(members)
    weights = np.zeros(n)
    counted = min(n, sample)
    for i in range(n):
        for q in range(counted):
            j = q * n // counted
            if j == i:
                continue
            if (
                abs(members[i, 0] - members[j, 0]) <= close[0]
                and _turn(members[i, 1], members[j, 1]) <= close[1]
                and abs(members[i, 2] - members[j, 2]) <= close[2]
            ):
                weights[i] += 1.0
    return weights


@kernel
def _nearest_centre(parameters: FloatArray, centres: FloatArray, scales: FloatArray, most: float) -> LabelArray:
    """The centre with the highest membership, which falls with the distance in all three parameters; -1 beyond `most`.

    Distances are in standard deviations; of equal ones the lower centre.
    """
    labels = np.full(len(parameters), -1, np.int32)
    for i in range(len(parameters)):
        least = np.inf
        for k in range(len(centres)):
            slope = abs(parameters[i, 0] - centres[k, 0]) / scales[k, 0]
            turn = _turn(parameters[i, 1], centres[k, 1]) / scales[k, 1]
            distance = abs(parameters[i, 2] - centres[k, 2]) / scales[k, 2]
            if max(slope, turn, distance) > most:
                continue
            square = slope * slope + turn * turn + distance * distance
            if square < least:
                least = square
                labels[i] = k
    return labels
