"""The models of an evaluation in figures of their own, which need no reference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from pipeline.model import RoofType
from pipeline.report.statistics import QUANTILES
from pipeline.report.table import CountTable, count_table, quantile_table, statistics_tables
from pipeline.ruler.evaluation.evaluate import Evaluation, has_roof_types
from pipeline.ruler.evaluation.models import RoofModel

TITLE = "The models"
"""Title of these figures."""


def model_figures(evaluation: Evaluation) -> tuple[CountTable, ...]:
    """The figures of a run's records, else roof types, if there are any, and sizes of the models of another program."""
    if evaluation.statistics is not None:
        return tuple(statistics_tables(evaluation.statistics))
    models = evaluation.models.models
    tables = [_sizes(models)]
    if models and has_roof_types(evaluation.models):
        types = Counter(model.roof_type for model in models)
        tables.insert(
            0, count_table("Roof types", "type", {kind.value: types[kind] for kind in RoofType if types[kind]})
        )
    return tuple(tables)


def _sizes(models: Sequence[RoofModel]) -> CountTable:
    """Quantiles of areas and numbers of faces."""
    figures = {
        "footprint, m2": [model.footprint.area for model in models],
        "roof, m2": [sum(surface.area_m2 for surface in model.surfaces) for model in models],
        "roof faces": [len(model.surfaces) for model in models],
    }
    return quantile_table(
        "Over the models",
        {
            label: {name: float(np.quantile(values, share)) if values else None for name, share in QUANTILES}
            | {"n": len(values)}
            for label, values in figures.items()
        },
    )
