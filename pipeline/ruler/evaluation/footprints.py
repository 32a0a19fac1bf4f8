"""Footprints of models against those of the reference: overlap and area."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.ruler.evaluation.bootstrap import ratio, share
from pipeline.ruler.evaluation.building_matching import MIN_SHARE, Geometries, Matching, sound_polygons
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Columns, Subset, measured, measured_all, measured_median

LIMITS = (0.5, 0.8, 0.9)
"""Limits of the shares of buildings by IoU."""
_ROUNDING = 1e-9
"""Numerical guard for comparisons of shares."""


def score_footprints(models: Sequence[RoofModel], reference: Reference, matching: Matching) -> Columns:
    """Columns of the reference buildings in their order.

    `model`: index of the model that stands for it, -1 if it was not found; `model_id`; `iou` with that model, 0 without
    one; `iou_together`: the same with the union of all models that share at least half of either with it, and
    `models_over`, their number; `area_m2`; `area_bias`: model area / reference area - 1; `outline_offset_m`: shift of
    the outline that explains the difference of areas, positive outwards. The last two are nan if it was not found.

    The offset is the difference of the areas over the mean of both perimeters. It is exact for an outline whose edges
    were all moved by one distance, since the area grows by the perimeter half way.
    """
    true = sound_polygons([building.footprint for building in reference.buildings])
    made = sound_polygons([model.footprint for model in models])
    pairs, model = matching.overlaps, matching.model_of
    least = np.minimum(matching.reference_m2[pairs.first], matching.model_m2[pairs.second])
    counted = pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * least
    ends = np.searchsorted(pairs.first[counted], np.arange(len(true) + 1))
    over = np.split(pairs.second[counted], ends[1:-1]) if len(true) else []
    area_m2, model_m2 = matching.reference_m2, np.append(matching.model_m2, np.nan)[model]
    perimeters_m = shapely.length(true) + np.append(shapely.length(made), np.nan)[model]
    return {
        "model": model,
        "model_id": np.array([*(one.building_id for one in models), None], object)[model],
        "iou": matching.iou,
        "iou_together": np.array([_iou(one, made[some]) for one, some in zip(true, over, strict=True)], np.float64),
        "models_over": np.diff(ends),
        "area_m2": area_m2,
        "area_bias": model_m2 / area_m2 - 1.0,
        "outline_offset_m": 2.0 * (model_m2 - area_m2) / perimeters_m,
    }


def _iou(footprint: shapely.Geometry, others: Geometries) -> float:
    together = shapely.union_all(others)
    union = shapely.area(shapely.union(footprint, together))
    return float(shapely.area(shapely.intersection(footprint, together)) / union) if union > 0.0 else 0.0


def measures(rows: Columns, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings."""
    found = subset.buildings & (rows["model"] >= 0)
    figures: list[Measure] = []
    for name, column, chosen in (
        ("iou{}", "iou", subset.buildings),
        ("iou{}_found", "iou", found),
        ("iou_together{}", "iou_together", subset.buildings),
    ):
        values = rows[column][chosen]
        columns = {"value": values, "count": np.ones(len(values))}
        mean = f"footprints.{name.format('_mean')}"
        figures += [
            measured_median(f"footprints.{name.format('_median')}", values, subset),
            measured(mean, columns, ratio("value", "count"), n=len(values), subset=subset),
        ]
    figures += [
        measured_median("footprints.area_bias_median", rows["area_bias"][found], subset),
        measured_median("footprints.offset_median", rows["outline_offset_m"][found], subset),
    ]
    iou = rows["iou"][subset.buildings]
    columns = {"buildings": np.ones(len(iou))}
    columns |= {str(limit): (iou >= limit - _ROUNDING).astype(np.float64) for limit in LIMITS}
    shares = [
        (f"footprints.iou_from_{round(100 * limit)}", share(str(limit), "buildings"), len(iou)) for limit in LIMITS
    ]
    return figures + measured_all(columns, subset, shares)


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
