"""Roof types, and the outcome of a building after Hofmann, Maas and Streilein (2003)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.model import BoolArray, FloatArray, RoofType
from pipeline.ruler.evaluation.bootstrap import Sums, share
from pipeline.ruler.evaluation.building_matching import Matching
from pipeline.ruler.evaluation.face_scores import FaceScore, FaceVerdict
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Columns, Subset, measured_all
from pipeline.ruler.roof_families import family_of

_TYPES = tuple(RoofType)
_PAPER_TYPES = (RoofType.FLAT, RoofType.PENT, RoofType.GABLE, RoofType.HIP, RoofType.COMBINATION)


class Outcome(StrEnum):
    """Quality of a reconstruction."""

    CORRECT = "correct"
    """All roof faces to be found and only those, and the right one of the paper's five types."""
    PASSABLE = "passable"
    """At least half of the roof faces."""
    FALSE = "false"
    """The rest."""


def score_roof_types(
    models: Sequence[RoofModel], reference: Reference, matching: Matching, faces: FaceScore
) -> Columns:
    """Columns of the reference buildings in their order; empty against a reference without faces.

    `shape`, where conditions are known; `true_type`; `model`: index of the model that stands for it, -1 for none;
    `model_type`: its roof type, none without a model; `faces_to_find` and `faces_found` of these, groups as one;
    `faces_wrong`: model faces of at least 10 m2 that match nothing and lie most on it; `outcome`. A building without
    faces to be found is correct if its type is right and no face is wrong, else false.
    """
    if not reference.has_faces:
        return {}
    count, model = len(reference.buildings), matching.model_of
    true_type = np.array([building.roof_type for building in reference.buildings], object)
    model_type = np.array([*(one.roof_type for one in models), RoofType.NONE], object)[model]
    first = np.unique(faces.true["unit"], return_index=True)[1]
    of_unit, wanted = faces.true["building"][first], faces.true["to_be_found"][first]
    wrong = (faces.made["verdict"] == FaceVerdict.WRONG) & (faces.made["building"] >= 0)
    known = [reference.conditions.get(building.building_id) for building in reference.buildings]
    counts = {
        "faces_to_find": np.bincount(of_unit[wanted], minlength=count),
        "faces_found": np.bincount(of_unit[wanted & faces.true["found"][first]], minlength=count),
        "faces_wrong": np.bincount(faces.made["building"][wrong], minlength=count),
    }
    type_right = (model >= 0) & (_families(true_type) == _families(model_type))
    return {
        "shape": np.array([one.shape if one else None for one in known], object),
        "true_type": true_type,
        "model": model,
        "model_type": model_type,
        **counts,
        "outcome": np.array(
            [
                outcome(*numbers, type_right=right)
                for *numbers, right in zip(*(column.tolist() for column in (*counts.values(), type_right)), strict=True)
            ],
            object,
        ),
    }


def _families(types: NDArray[np.object_]) -> NDArray[np.object_]:
    """The types (n,) as the paper names them."""
    return np.array([family_of(one) for one in types], object)


def outcome(faces_to_find: int, faces_found: int, wrong_faces: int, *, type_right: bool) -> Outcome:
    """The verdict on a building.

    >>> outcome(4, 4, 0, type_right=True).value, outcome(4, 2, 3, type_right=False).value
    ('correct', 'passable')
    """
    if faces_found == faces_to_find and wrong_faces == 0 and type_right:
        return Outcome.CORRECT
    return Outcome.PASSABLE if 0 < faces_to_find <= 2 * faces_found else Outcome.FALSE


def confusion(rows: Columns, subset: Subset) -> dict[tuple[RoofType, RoofType], int]:
    """Buildings by true type and the model's type (none where not found), in the order of the types."""
    counts = Counter(zip(rows["true_type"][subset.buildings], rows["model_type"][subset.buildings], strict=True))
    return {(t, m): counts[t, m] for t in _TYPES for m in _TYPES if (t, m) in counts}


def outcome_tables(rows: Columns, subset: Subset) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The table of the paper for a subset: one row per true type of its five and for all; and one row per known shape.

    The five types of the paper always have a row, others only with buildings.
    """
    counted = {name: column[subset.buildings] for name, column in rows.items()}

    def row(key: str, name: str, chosen: BoolArray) -> dict[str, Any]:
        counts = {one.value: int((counted["outcome"][chosen] == one).sum()) for one in Outcome}
        return {"subset": subset.name, key: name, **counts}

    families = _families(counted["true_type"])
    found = set(families)
    kinds = (*_PAPER_TYPES, *(kind for kind in _TYPES if kind in found and kind not in _PAPER_TYPES))
    by_type = [row("true_type", kind.value, families == kind) for kind in kinds]
    by_type.append(row("true_type", "all", np.ones(len(counted["model"]), np.bool_)))
    shapes = sorted({shape for shape in counted["shape"] if shape is not None})
    return by_type, [row("shape", shape, counted["shape"] == shape) for shape in shapes]


def measures(rows: Columns, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings; none without rows."""
    if not rows or not len(rows["model"]):
        return []
    counted = {name: column[subset.buildings] for name, column in rows.items()}
    n, model = len(counted["model"]), counted["model"] >= 0
    columns: dict[str, FloatArray] = {"buildings": np.ones(n), "modelled": model.astype(np.float64)}
    columns |= {one.value: (counted["outcome"] == one).astype(np.float64) for one in Outcome}
    columns["right"] = (model & (counted["true_type"] == counted["model_type"])).astype(np.float64)
    places = [[_TYPES.index(kind) for kind in counted[name]] for name in ("true_type", "model_type")]
    columns["pairs"] = np.zeros((n, len(_TYPES) ** 2))
    columns["pairs"][np.arange(n), np.array(places[0], int) * len(_TYPES) + np.array(places[1], int)] = 1.0
    return measured_all(
        columns,
        subset,
        [
            *((f"roof_types.{one}", share(one.value, "buildings"), n) for one in Outcome),
            ("roof_types.accuracy", share("right", "buildings"), n),
            ("roof_types.accuracy_found", share("right", "modelled"), float(model.sum())),
            ("roof_types.kappa", _kappa, n),
        ],
    )


def _kappa(sums: Sums) -> FloatArray:
    """(p_o - p_e) / (1 - p_e) from summed confusion matrices; 1 where all is of one type and right."""
    matrix = sums["pairs"].reshape(-1, len(_TYPES), len(_TYPES))
    count = matrix.sum(axis=(1, 2))
    agreed = np.trace(matrix, axis1=1, axis2=2) / count
    expected = (matrix.sum(axis=1) * matrix.sum(axis=2)).sum(axis=1) / count**2
    return np.where(count > 0.0, np.where(expected < 1.0, (agreed - expected) / (1.0 - expected), 1.0), np.nan)


_OF_ALL = "share of all reference buildings "

DEFINITIONS = (
    defined(
        "roof_types.correct",
        "outcome correct",
        f"{_OF_ALL}of which all faces to be found are found, no model face >= 10 m2 is wrong, and the type is right",
    ),
    defined(
        "roof_types.passable",
        "outcome passable",
        f"{_OF_ALL}that are not correct, of which at least half of the faces to be found are found",
        Better.NEITHER,
    ),
    defined("roof_types.false", "outcome false", f"{_OF_ALL}that are neither correct nor passable", Better.LOWER),
    defined(
        "roof_types.accuracy",
        "roof type right",
        f"{_OF_ALL}for which a model of the same type stands (footprint IoU >= 0.5)",
    ),
    defined(
        "roof_types.accuracy_found", "roof type right, of found", "the same as share of the buildings with a model"
    ),
    defined(
        "roof_types.kappa",
        "kappa of roof types",
        "Cohen's (p_o - p_e) / (1 - p_e) of the confusion matrix true x model type, none where not found",
        Better.HIGHER,
        "",
    ),
)
"""The measures."""
