"""Roof types, and the outcome of a building after Hofmann, Maas and Streilein (2003)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from pipeline.model import FloatArray, RoofType
from pipeline.ruler.evaluation.bootstrap import Sums, share
from pipeline.ruler.evaluation.faces import FaceScore, FaceVerdict
from pipeline.ruler.evaluation.matching import Matching
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Subset, measured

_TYPES = tuple(RoofType)
_PAPER_TYPES = (RoofType.FLAT, RoofType.PENT, RoofType.GABLE, RoofType.HIP, RoofType.COMBINATION)


class Outcome(StrEnum):
    """Quality of a reconstruction."""

    CORRECT = "correct"
    """All roof faces to be found and only those, and the right type."""
    PASSABLE = "passable"
    """At least half of the roof faces."""
    FALSE = "false"
    """The rest."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofTypeRow:
    """One reference building."""

    building: int
    """Its index."""
    building_id: str
    """Its name."""
    shape: str | None
    """Parametric shape, where conditions are known."""
    true_type: RoofType
    """Its roof type."""
    model: int
    """Index of the model that stands for it; -1 for none."""
    model_type: RoofType
    """Roof type of that model; none without a model."""
    faces_to_find: int
    """Its faces to be found, groups as one."""
    faces_found: int
    """Found ones of these."""
    wrong_faces: int
    """Model faces of at least 10 m2 that match nothing and lie most on it."""
    outcome: Outcome
    """The paper's verdict."""

    @property
    def type_right(self) -> bool:
        """Whether a model stands for it and says the right type."""
        return self.model >= 0 and self.true_type == self.model_type


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutcomeRow:
    """One row of the paper's tables."""

    subset: str
    """all, good or hard."""
    kind: str
    """type or shape: what `name` is."""
    name: str
    """A roof type or shape; all."""
    correct: int
    """Buildings."""
    passable: int
    """Buildings."""
    false: int
    """Buildings."""

    @property
    def total(self) -> int:
        """All of the row."""
        return self.correct + self.passable + self.false


def score_roof_types(
    models: Sequence[RoofModel], reference: Reference, matching: Matching, faces: FaceScore
) -> tuple[RoofTypeRow, ...]:
    """One row per reference building, in their order; none against a reference without faces.

    A building without faces to be found is correct if its type is right and no face is wrong, else false.
    """
    if not reference.has_faces:
        return ()
    count = len(reference.buildings)
    wanted, found, wrong = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64)
    for row in {row.unit: row for row in faces.reference}.values():
        wanted[row.building] += row.to_be_found
        found[row.building] += row.to_be_found and row.found
    for face in faces.models:
        if face.verdict is FaceVerdict.WRONG and face.building >= 0:
            wrong[face.building] += 1
    rows = []
    for k, building in enumerate(reference.buildings):
        m = int(matching.model_of[k])
        model_type = models[m].roof_type if m >= 0 else RoofType.NONE
        conditions = reference.conditions.get(building.building_id)
        rows.append(
            RoofTypeRow(
                building=k,
                building_id=building.building_id,
                shape=conditions.shape if conditions else None,
                true_type=building.roof_type,
                model=m,
                model_type=model_type,
                faces_to_find=int(wanted[k]),
                faces_found=int(found[k]),
                wrong_faces=int(wrong[k]),
                outcome=outcome(
                    int(wanted[k]), int(found[k]), int(wrong[k]), type_right=m >= 0 and model_type == building.roof_type
                ),
            )
        )
    return tuple(rows)


def outcome(faces_to_find: int, faces_found: int, wrong_faces: int, *, type_right: bool) -> Outcome:
    """The verdict on a building.

    >>> outcome(4, 4, 0, type_right=True).value, outcome(4, 2, 3, type_right=False).value
    ('correct', 'passable')
    """
    if faces_found == faces_to_find and wrong_faces == 0 and type_right:
        return Outcome.CORRECT
    return Outcome.PASSABLE if 0 < faces_to_find <= 2 * faces_found else Outcome.FALSE


def confusion(rows: Sequence[RoofTypeRow], subset: Subset) -> dict[tuple[RoofType, RoofType], int]:
    """Buildings by true type and the model's type (none where not found), in the order of the types."""
    counts: dict[tuple[RoofType, RoofType], int] = {}
    for row in rows:
        if subset.buildings[row.building]:
            pair = row.true_type, row.model_type
            counts[pair] = counts.get(pair, 0) + 1
    return {(t, m): counts[t, m] for t in _TYPES for m in _TYPES if (t, m) in counts}


def outcome_table(rows: Sequence[RoofTypeRow], subset: Subset) -> tuple[OutcomeRow, ...]:
    """The table of the paper for a subset: one row per true type, one for all, then one per known shape.

    The five types of the paper always have a row, others only with buildings.
    """
    counted = [row for row in rows if subset.buildings[row.building]]
    others = [kind for kind in _TYPES if kind not in _PAPER_TYPES and any(row.true_type is kind for row in counted)]
    table = [
        _outcomes(subset, "type", kind.value, [row for row in counted if row.true_type is kind])
        for kind in (*_PAPER_TYPES, *others)
    ]
    table.append(_outcomes(subset, "type", "all", counted))
    shapes = sorted({row.shape for row in counted if row.shape is not None})
    table += [_outcomes(subset, "shape", shape, [row for row in counted if row.shape == shape]) for shape in shapes]
    return tuple(table)


def _outcomes(subset: Subset, kind: str, name: str, rows: Sequence[RoofTypeRow]) -> OutcomeRow:
    correct, passable, false = (sum(row.outcome is one for row in rows) for one in Outcome)
    return OutcomeRow(subset=subset.name, kind=kind, name=name, correct=correct, passable=passable, false=false)


def measures(rows: Sequence[RoofTypeRow], subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings; none without rows."""
    if not rows:
        return []
    counted = [row for row in rows if subset.buildings[row.building]]
    columns: dict[str, FloatArray] = {"buildings": np.ones(len(counted))}
    columns |= {one.value: np.array([row.outcome is one for row in counted], np.float64) for one in Outcome}
    columns["right"] = np.array([row.type_right for row in counted], np.float64)
    columns["modelled"] = np.array([row.model >= 0 for row in counted], np.float64)
    pairs = np.zeros((len(counted), len(_TYPES) ** 2))
    for place, row in enumerate(counted):
        pairs[place, _TYPES.index(row.true_type) * len(_TYPES) + _TYPES.index(row.model_type)] = 1.0
    columns["pairs"] = pairs
    n, found = len(counted), float(columns["modelled"].sum())
    return [
        *(
            measured(f"roof_types.{one.value}", columns, share(one.value, "buildings"), n=n, subset=subset)
            for one in Outcome
        ),
        measured("roof_types.accuracy", columns, share("right", "buildings"), n=n, subset=subset),
        measured("roof_types.accuracy_found", columns, share("right", "modelled"), n=found, subset=subset),
        measured("roof_types.kappa", columns, _kappa, n=n, subset=subset),
    ]


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
