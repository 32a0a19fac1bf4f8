"""Delivered models, blocks and gaps per reference building, and models where no building is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from pipeline.model import FloatArray, IntArray, Status
from pipeline.ruler.evaluation.bootstrap import share
from pipeline.ruler.evaluation.matching import MIN_SHARE, Matching, excused_models
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import MODELS_ALONE, Subset, measured, summed_over_units, total

_ROUNDING = 1e-9


class Delivered(StrEnum):
    """The delivery for a reference building."""

    LOD2 = "lod2"
    """A model that is ok, with a level of detail of 2 or more."""
    BLOCK = "block"
    """A fallback, or a model of level of detail 1."""
    NOTHING = "nothing"
    """No model stands for it."""


class Stands(StrEnum):
    """Place of a model."""

    FOR_BUILDING = "for_building"
    """It stands for one reference building."""
    PART = "part"
    """It stands for no building, and at least half of it lies on reference buildings."""
    JOINS = "joins"
    """It covers at least half of several reference buildings, and half of it lies on them or it stands for one."""
    FALSE = "false"
    """Less than half of it lies on reference buildings, and the reference is complete there."""
    LEFT_OUT = "left_out"
    """It stands for no building, and lies on one that the data edge cuts, at that edge, or outside the reference."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeliveryRow:
    """One reference building."""

    building: int
    """Its index."""
    building_id: str
    """Its name."""
    model: int
    """Index of the model that stands for it; -1 for none."""
    delivered: Delivered
    """Its delivery."""
    parts: int
    """Number of models that are parts (`Stands.PART`) and lie mostly on it."""
    joined: bool
    """Whether a model covers at least half of it and of another building."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeliveredModel:
    """One model."""

    model: int
    """Its index."""
    model_id: str
    """Its name."""
    status: Status
    """ok or fallback."""
    building: int
    """Index of the reference building that it stands for, else of the one with the largest common area; -1 for none."""
    share_on_reference: float
    """Share of its footprint on reference buildings; for a part of a division that of all parts together."""
    covers: int
    """Number of reference buildings that it covers by at least half."""
    stands: Stands
    """Its place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Delivery:
    """The delivery."""

    buildings: tuple[DeliveryRow, ...]
    """One per reference building."""
    models: tuple[DeliveredModel, ...]
    """One per model."""


def score_delivery(models: Sequence[RoofModel], reference: Reference, matching: Matching) -> Delivery:
    """The delivery for each reference building and the place of each model, in their orders."""
    pairs = matching.overlaps
    cut = np.array([building.touches_data_edge for building in reference.buildings], np.bool_)
    covering = pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * matching.reference_m2[pairs.first]
    covers = np.bincount(pairs.second[covering], minlength=len(models))
    excused = excused_models(models, reference)
    rows = []
    for k, model in enumerate(models):
        own = int(matching.reference_of[k])
        mostly = int(matching.mostly_on[k])
        on, inside = float(matching.share_on_reference[k]), float(matching.share_in_extent[k])
        lies_on = on >= MIN_SHARE - _ROUNDING
        if covers[k] > 1 and (own >= 0 or lies_on):
            stands = Stands.JOINS
        elif own >= 0:
            stands = Stands.FOR_BUILDING
        elif covers[k] <= 1 and (cut[mostly] if mostly >= 0 else excused[k]):
            stands = Stands.LEFT_OUT
        elif lies_on:
            stands = Stands.PART
        elif reference.extent is not None and (inside >= MIN_SHARE - _ROUNDING or covers[k] > 1):
            stands = Stands.FALSE
        else:
            stands = Stands.LEFT_OUT
        rows.append(
            DeliveredModel(
                model=k,
                model_id=model.building_id,
                status=model.status,
                building=own if own >= 0 else mostly,
                share_on_reference=on,
                covers=int(covers[k]),
                stands=stands,
            )
        )
    joined = np.zeros(len(reference.buildings), np.bool_)
    joined[pairs.first[covering][covers[pairs.second[covering]] > 1]] = True
    on_building = np.array([row.building for row in rows if row.stands is Stands.PART], np.int64)
    parts = np.bincount(on_building, minlength=len(reference.buildings))
    buildings = tuple(
        DeliveryRow(
            building=k,
            building_id=building.building_id,
            model=int(matching.model_of[k]),
            delivered=_delivered(models[matching.model_of[k]]) if matching.model_of[k] >= 0 else Delivered.NOTHING,
            parts=int(parts[k]),
            joined=bool(joined[k]),
        )
        for k, building in enumerate(reference.buildings)
    )
    return Delivery(buildings=buildings, models=tuple(rows))


def of_delivered_models(delivery: Delivery, models: Sequence[RoofModel], whole_of: IntArray) -> Delivery:
    """The same with a row per delivered model: parts of a division stand where their whole does (`WholeModels`)."""
    rows = [
        dataclasses.replace(delivery.models[whole], model=k, model_id=model.building_id, status=model.status)
        for k, (model, whole) in enumerate(zip(models, whole_of.tolist(), strict=True))
    ]
    return dataclasses.replace(delivery, models=tuple(rows))


def _delivered(model: RoofModel) -> Delivered:
    detailed = model.status.has_roof and not model.lod.startswith(("0", "1"))
    return Delivered.LOD2 if detailed else Delivered.BLOCK


def measures(delivery: Delivery, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings. False models count in the subset `all` only."""
    buildings = delivery.buildings
    judged = [row for row in delivery.models if row.stands is not Stands.LEFT_OUT]
    # A false model is a unit of its own, even if a corner of it touches a building.
    place = [row.building for row in buildings]
    place += [-1 if row.stands is Stands.FALSE else row.building for row in judged]
    unit = [0] * len(buildings) + [row.model for row in judged]
    first, second = np.zeros(len(buildings)), np.zeros(len(judged))

    def of_buildings(values: list[bool]) -> FloatArray:
        return np.concatenate([np.array(values, np.float64), second])

    def of_models(values: list[bool]) -> FloatArray:
        return np.concatenate([first, np.array(values, np.float64)])

    columns = summed_over_units(
        subset,
        np.array(place, np.int64),
        np.array(unit, np.int64),
        {kind.value: of_buildings([row.delivered is kind for row in buildings]) for kind in Delivered}
        | {
            "buildings": of_buildings([True] * len(buildings)),
            "split": of_buildings([row.parts + (row.model >= 0) > 1 for row in buildings]),
            "joined": of_buildings([row.joined for row in buildings]),
            "models": of_models([True] * len(judged)),
            "standing": of_models([row.stands is not Stands.FALSE for row in judged]),
        }
        | {kind.name: of_models([row.stands is kind for row in judged]) for kind in Stands},
    )
    n_buildings, n_models = float(columns["buildings"].sum()), float(columns["models"].sum())
    shares = [
        ("delivery.lod2", Delivered.LOD2.value),
        ("delivery.block", Delivered.BLOCK.value),
        ("delivery.nothing", Delivered.NOTHING.value),
        ("delivery.split", "split"),
        ("delivery.joined", "joined"),
    ]
    counts = [
        ("delivery.false_models", Stands.FALSE.name),
        ("delivery.part_models", Stands.PART.name),
        ("delivery.joining_models", Stands.JOINS.name),
    ]
    return [
        *(measured(name, columns, share(column, "buildings"), n=n_buildings, subset=subset) for name, column in shares),
        measured("delivery.correctness", columns, share("standing", "models"), n=n_models, subset=subset),
        *(measured(name, columns, total(column), n=n_models, subset=subset) for name, column in counts),
    ]


def record_measures(models: ModelSet) -> list[Measure]:
    """Shares of the records of a run, without any reference."""
    status = [model.status for model in models.models] + [Status.FAILED] * len(models.failed)
    columns = {"records": np.ones(len(status))}
    columns |= {kind.value: np.array([one is kind for one in status], np.float64) for kind in Status}
    return [
        measured(
            f"delivery.records_{kind.value}", columns, share(kind.value, "records"), n=len(status), subset=MODELS_ALONE
        )
        for kind in Status
    ]


_OF_ALL = "share of all reference buildings "
_FOR = (
    "(footprint IoU >= 0.5, one to one; models that divide a block into its houses, each with an IoU >= 0.8 to one or "
    "several of them, stand as one)"
)

DEFINITIONS = (
    defined(
        "delivery.lod2",
        "buildings with an LoD2 model",
        f"{_OF_ALL}for which a model of status ok or doubtful and level of detail >= 2 stands {_FOR}",
        Better.HIGHER,
    ),
    defined(
        "delivery.block",
        "buildings with a block only",
        f"{_OF_ALL}for which a fallback or LoD1 model stands {_FOR}",
        Better.LOWER,
    ),
    defined(
        "delivery.nothing", "buildings without a model", f"{_OF_ALL}for which no model stands {_FOR}", Better.LOWER
    ),
    defined(
        "delivery.split",
        "buildings split",
        f"{_OF_ALL}with several models: the one that stands for it, if any, and those that stand for none, lie on "
        "reference buildings by at least half, and on this one most",
        Better.LOWER,
    ),
    defined(
        "delivery.joined",
        "buildings joined with others",
        f"{_OF_ALL}at least half covered by a model that covers at least half of another one too",
        Better.LOWER,
    ),
    defined(
        "delivery.correctness",
        "models that stand on buildings",
        "1 - false models / models, without those at the data edge or where the reference says nothing",
        Better.HIGHER,
    ),
    defined(
        "delivery.false_models",
        "models where no building is",
        "models of which less than half lies on reference buildings, that stand for none, half in the extent of the "
        "reference or over several buildings, and not at the data edge",
        Better.LOWER,
        "count",
    ),
    defined(
        "delivery.part_models",
        "models that are parts of buildings",
        "models that stand for no building, of which at least half lies on reference buildings",
        Better.LOWER,
        "count",
    ),
    defined(
        "delivery.joining_models",
        "models that join buildings",
        "models that cover at least half of each of several reference buildings, and lie on such by at least half or "
        "stand for one",
        Better.LOWER,
        "count",
    ),
    defined("delivery.records_ok", "records ok", "records of status ok / all records of the run", Better.HIGHER),
    defined("delivery.records_doubtful", "records in doubt", "records of status doubtful / all records", Better.LOWER),
    defined(
        "delivery.records_fallback", "records with a block", "records of status fallback / all records", Better.LOWER
    ),
    defined(
        "delivery.records_failed", "records without a model", "records of status failed / all records", Better.LOWER
    ),
)
"""The measures."""
