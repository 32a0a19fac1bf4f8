"""Delivered models, blocks and gaps per reference building, and models where no building is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from pipeline.model import BoolArray, FloatArray, IntArray, Status
from pipeline.ruler.evaluation.bootstrap import share
from pipeline.ruler.evaluation.building_matching import MIN_SHARE, Matching, excused_models
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import MODELS_ALONE, Columns, Subset, measured_all, summed_over_units, total

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
class Delivery:
    """The delivery: columns of all reference buildings and of all models, in their orders."""

    buildings: Columns
    """`model`: index of the model that stands for it, -1 for none; `delivered`; `parts`: models that are parts
    (`Stands.PART`) and lie mostly on it; `joined`: whether a model covers at least half of it and of another one."""
    models: Columns
    """`building`: index of the one that it stands for, else of the one with the largest common area, -1 for none;
    `on_reference`: share of its footprint on reference buildings, for a part of a division that of all parts together;
    `covers`: number of buildings that it covers by at least half; `stands`."""


def score_delivery(models: Sequence[RoofModel], reference: Reference, matching: Matching) -> Delivery:
    """The delivery for each reference building and the place of each model."""
    count, pairs, own, mostly = len(reference.buildings), matching.overlaps, matching.reference_of, matching.mostly_on
    cut = np.array([*(building.touches_data_edge for building in reference.buildings), False], np.bool_)
    covering = pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * matching.reference_m2[pairs.first]
    covers = np.bincount(pairs.second[covering], minlength=len(models))
    lies_on = matching.share_on_reference >= MIN_SHARE - _ROUNDING
    inside = matching.share_in_extent >= MIN_SHARE - _ROUNDING
    excused = np.where(mostly >= 0, cut[mostly], excused_models(models, reference))
    stands = np.select(
        [
            (covers > 1) & ((own >= 0) | lies_on),
            own >= 0,
            (covers <= 1) & excused,
            lies_on,
            np.full(len(models), reference.extent is not None) & (inside | (covers > 1)),
        ],
        [Stands.JOINS, Stands.FOR_BUILDING, Stands.LEFT_OUT, Stands.PART, Stands.FALSE],
        Stands.LEFT_OUT,
    )
    building = np.where(own >= 0, own, mostly)
    joined = np.zeros(count, np.bool_)
    joined[pairs.first[covering][covers[pairs.second[covering]] > 1]] = True
    delivered = np.array([*map(_delivered, models), Delivered.NOTHING])[matching.model_of]
    parts = np.bincount(building[stands == Stands.PART], minlength=count)
    return Delivery(
        buildings={"model": matching.model_of, "delivered": delivered, "parts": parts, "joined": joined},
        models={"building": building, "on_reference": matching.share_on_reference, "covers": covers, "stands": stands},
    )


def of_delivered_models(delivery: Delivery, whole_of: IntArray) -> Delivery:
    """The same with a row per delivered model: parts of a division stand where their whole does (`WholeModels`)."""
    return dataclasses.replace(delivery, models={name: column[whole_of] for name, column in delivery.models.items()})


def _delivered(model: RoofModel) -> Delivered:
    detailed = model.status.has_roof and not model.lod.startswith(("0", "1"))
    return Delivered.LOD2 if detailed else Delivered.BLOCK


def measures(delivery: Delivery, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings. False models count in the subset `all` only."""
    buildings, stands = delivery.buildings, delivery.models["stands"]
    count, judged = len(buildings["model"]), np.flatnonzero(stands != Stands.LEFT_OUT)
    stands = stands[judged]
    # A false model is a unit of its own, even if a corner of it touches a building.
    place = np.where(stands == Stands.FALSE, -1, delivery.models["building"][judged])

    def of_buildings(values: BoolArray) -> FloatArray:
        return np.concatenate([values.astype(np.float64), np.zeros(len(judged))])

    def of_models(values: BoolArray) -> FloatArray:
        return np.concatenate([np.zeros(count), values.astype(np.float64)])

    columns = summed_over_units(
        subset,
        np.concatenate([np.arange(count), place]),
        np.concatenate([np.zeros(count, np.int64), judged]),
        {kind.value: of_buildings(buildings["delivered"] == kind) for kind in Delivered}
        | {
            "buildings": of_buildings(np.ones(count, np.bool_)),
            "split": of_buildings(buildings["parts"] + (buildings["model"] >= 0) > 1),
            "joined": of_buildings(buildings["joined"]),
            "models": of_models(np.ones(len(judged), np.bool_)),
            "standing": of_models(stands != Stands.FALSE),
        }
        | {f"{kind}_models": of_models(stands == kind) for kind in Stands},
    )
    n_buildings, n_models = float(columns["buildings"].sum()), float(columns["models"].sum())
    of_all = (*(kind.value for kind in Delivered), "split", "joined")
    counts = (("false_models", Stands.FALSE), ("part_models", Stands.PART), ("joining_models", Stands.JOINS))
    return measured_all(
        columns,
        subset,
        [
            *((f"delivery.{name}", share(name, "buildings"), n_buildings) for name in of_all),
            ("delivery.correctness", share("standing", "models"), n_models),
            *((f"delivery.{name}", total(f"{kind}_models"), n_models) for name, kind in counts),
        ],
    )


def record_measures(models: ModelSet) -> list[Measure]:
    """Shares of the records of a run, without any reference."""
    status = [model.status for model in models.models] + [Status.FAILED] * len(models.failed)
    columns = {"records": np.ones(len(status))}
    columns |= {kind.value: np.array([one is kind for one in status], np.float64) for kind in Status}
    figures = [(f"delivery.records_{kind}", share(kind.value, "records"), len(status)) for kind in Status]
    return measured_all(columns, MODELS_ALONE, figures)


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
