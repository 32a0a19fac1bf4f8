"""Footprints of models against those of the reference: overlap and area."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import FloatArray
from pipeline.ruler.evaluation.bootstrap import ratio, share
from pipeline.ruler.evaluation.matching import MIN_SHARE, Geometries, Matching, sound_polygons
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Subset, measured, measured_median

LIMITS = (0.5, 0.8, 0.9)
"""Limits of the shares of buildings by IoU."""
_ROUNDING = 1e-9
"""Numerical guard for comparisons of shares."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FootprintRow:
    """One reference building."""

    building: int
    """Its index."""
    building_id: str
    """Its name."""
    model: int
    """Index of the model that stands for it; -1 if it was not found."""
    model_id: str | None
    """Name of that model."""
    iou: float
    """Intersection over union with that model; 0 if it was not found."""
    iou_together: float
    """The same with the union of all models that share at least half of either with it; 0 without any."""
    models_over: int
    """Number of those models."""
    area_m2: float
    """Area of the reference footprint."""
    model_area_m2: float
    """Area of the model that stands for it; nan if it was not found."""
    area_bias: float
    """Model area / reference area - 1; nan if it was not found."""
    offset_m: float
    """Shift of the outline that explains the difference of areas, positive outwards; nan if it was not found."""


def score_footprints(models: Sequence[RoofModel], reference: Reference, matching: Matching) -> tuple[FootprintRow, ...]:
    """One row per reference building, in their order.

    The offset is the difference of the areas over the mean of both perimeters. It is exact for an outline whose edges
    were all moved by one distance, since the area grows by the perimeter half way.
    """
    true = sound_polygons([building.footprint for building in reference.buildings])
    made = sound_polygons([model.footprint for model in models])
    true_m, made_m = shapely.length(true), shapely.length(made)
    pairs = matching.overlaps
    least = np.minimum(matching.reference_m2[pairs.first], matching.model_m2[pairs.second])
    counted = pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * least
    first, second = pairs.first[counted], pairs.second[counted]
    rows = []
    for k, building in enumerate(reference.buildings):
        low, high = np.searchsorted(first, [k, k + 1])
        m = int(matching.model_of[k])
        area, model_area = float(matching.reference_m2[k]), float(matching.model_m2[m]) if m >= 0 else math.nan
        rows.append(
            FootprintRow(
                building=k,
                building_id=building.building_id,
                model=m,
                model_id=models[m].building_id if m >= 0 else None,
                iou=float(matching.iou[k]),
                iou_together=_iou(true[k], made[second[low:high]]),
                models_over=int(high - low),
                area_m2=area,
                model_area_m2=model_area,
                area_bias=model_area / area - 1.0,
                offset_m=2.0 * (model_area - area) / float(true_m[k] + made_m[m]) if m >= 0 else math.nan,
            )
        )
    return tuple(rows)


def _iou(footprint: shapely.Geometry, others: Geometries) -> float:
    together = shapely.union_all(others)
    union = shapely.area(shapely.union(footprint, together))
    return float(shapely.area(shapely.intersection(footprint, together)) / union) if union > 0.0 else 0.0


def measures(rows: Sequence[FootprintRow], subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings."""
    counted = [row for row in rows if subset.buildings[row.building]]
    found = [row for row in counted if row.model >= 0]
    iou = np.array([row.iou for row in counted])
    iou_found = np.array([row.iou for row in found])
    figures = [
        measured_median("footprints.iou_median", iou, subset),
        _mean("footprints.iou_mean", iou, subset),
        measured_median("footprints.iou_median_found", iou_found, subset),
        _mean("footprints.iou_mean_found", iou_found, subset),
        measured_median("footprints.iou_together_median", np.array([row.iou_together for row in counted]), subset),
        _mean("footprints.iou_together_mean", np.array([row.iou_together for row in counted]), subset),
        measured_median("footprints.area_bias_median", np.array([row.area_bias for row in found]), subset),
        measured_median("footprints.offset_median", np.array([row.offset_m for row in found]), subset),
    ]
    figures += [
        measured(
            f"footprints.iou_from_{round(100 * limit)}",
            {"reaches": (iou >= limit - _ROUNDING).astype(np.float64), "buildings": np.ones(len(iou))},
            share("reaches", "buildings"),
            n=len(iou),
            subset=subset,
        )
        for limit in LIMITS
    ]
    return figures


def _mean(name: str, values: FloatArray, subset: Subset) -> Measure:
    columns = {"value": values, "count": np.ones(len(values))}
    return measured(name, columns, ratio("value", "count"), n=len(values), subset=subset)


_IOU = "IoU = common area / area of the union, with the model that stands for the building"
_ALL = "over all reference buildings, 0 where not found (IoU < 0.5)"
_TOGETHER = (
    "IoU with the union of all models that share at least half of either area with the building (a building that was "
    "split is whole again), "
)

DEFINITIONS = (
    defined("footprints.iou_median", "footprint IoU, median of all", f"median {_ALL}; {_IOU}"),
    defined("footprints.iou_mean", "footprint IoU, mean of all", f"mean {_ALL}; {_IOU}"),
    defined("footprints.iou_median_found", "footprint IoU, median of found", f"median over found buildings; {_IOU}"),
    defined("footprints.iou_mean_found", "footprint IoU, mean of found", f"mean over found buildings; {_IOU}"),
    defined(
        "footprints.iou_together_median",
        "footprint IoU with all models, median",
        _TOGETHER + "median over all, 0 without any",
    ),
    defined(
        "footprints.iou_together_mean",
        "footprint IoU with all models, mean",
        _TOGETHER + "mean over all, 0 without any",
    ),
    defined(
        "footprints.area_bias_median",
        "footprint area bias, median",
        "median over found buildings of model area / reference area - 1",
        Better.ZERO,
        "",
    ),
    defined(
        "footprints.offset_median",
        "outline offset from areas, median",
        "median over found buildings of (model area - reference area) / mean of both perimeters; positive outwards",
        Better.ZERO,
        "m",
    ),
    *(
        defined(
            f"footprints.iou_from_{round(100 * limit)}",
            f"footprint IoU >= {limit:g}",
            f"share of all reference buildings with IoU >= {limit:g}; {_IOU}",
        )
        for limit in LIMITS
    ),
)
"""The measures."""
