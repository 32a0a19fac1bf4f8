"""Maps of an evaluation: reference buildings by their outcome, roof faces found, missed and wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from pipeline.model import BoolArray, FloatArray, Status
from pipeline.report.maps import BAD, DOUBTFUL, FAIR, GOOD, MISSING, UNJUDGED, Entry, Map, draw_map
from pipeline.ruler.evaluation.counted_models import flags, visible_share
from pipeline.ruler.evaluation.evaluate import Evaluation

SHARES = ((0.95, "#3f86b5"), (0.9, "#8bb8d0"), (0.75, "#e3c15c"), (0.5, "#de8a3e"), (-1.0, "#c2401f"))
"""Least share of points within 0.2 m, and colour."""


def maps(evaluation: Evaluation) -> list[Map]:
    """The maps of an evaluation, in the order of the page."""
    buildings, faces = evaluation.tables.get("buildings"), evaluation.tables.get("true_faces")
    made = []
    if evaluation.reference is None or buildings is None:
        made.append(draw_map("Models by status", _status_layers(evaluation)))
    else:
        footprints = {one.building_id: one.footprint for one in evaluation.reference.buildings}
        geometries = [footprints.get(name) for name in buildings["building_id"].to_pylist()]
        false = _false_models(evaluation)
        if "outcome" in buildings.column_names and evaluation.reference.has_faces:
            made.append(draw_map("Buildings by outcome", [*_outcome_layers(buildings, geometries), false]))
        shares = visible_share(buildings)
        if shares is not None:
            layers = [*_share_layers(buildings, shares, geometries), false]
            made.append(draw_map("Buildings by share of points within 0.2 m", layers))
        if not made:
            made.append(draw_map("Buildings found", [*_found_layers(buildings, geometries), false]))
    if faces is not None and "geometry" in faces.column_names:
        made.append(draw_map("Roof faces", _face_layers(faces, evaluation.tables.get("model_faces"))))
    return [one for one in made if one is not None]


def _layer(label: str, colour: str, geometries: Sequence[Any], chosen: Any, *, hatched: bool = False) -> Entry:
    """The chosen geometries."""
    picked = [geometry for geometry, is_so in zip(geometries, chosen, strict=True) if is_so]
    return Entry(label, colour, len(picked), hatched, picked)


def _missing(buildings: pa.Table) -> BoolArray:
    """Whether no model stands for each building, and none lies over it."""
    missing = ~_found(buildings)
    return missing & ~flags(buildings, "models_over") if "models_over" in buildings.column_names else missing


def _found(buildings: pa.Table) -> BoolArray:
    """Whether a model stands for each building."""
    found: BoolArray = buildings["model_id"].is_valid().to_numpy()
    return found


def _torn(buildings: pa.Table, geometries: Sequence[Any]) -> Entry:
    """Buildings under models of which none stands for them, hatched over the colour of what these models found."""
    chosen = ~_found(buildings) & ~_missing(buildings) & ~_cut(buildings)
    return _layer("wrongly divided or joined: no model stands for it", MISSING, geometries, chosen, hatched=True)


def _cut(buildings: pa.Table) -> BoolArray:
    """Whether the end of the data cuts each building."""
    known = "touches_data_edge" in buildings.column_names
    return flags(buildings, "touches_data_edge") if known else np.zeros(buildings.num_rows, bool)


def _outcome_layers(buildings: pa.Table, geometries: Sequence[Any]) -> list[Entry]:
    """Correct, passable, false, not found, not judged."""
    missing = _missing(buildings)
    outcomes = np.array(buildings["outcome"].to_pylist(), object)
    unjudged = _cut(buildings) | (~buildings["outcome"].is_valid().to_numpy() & ~missing)
    layers = [
        _layer("not judged (cut by the edge of the data)", UNJUDGED, geometries, unjudged),
        *(
            _layer(name, colour, geometries, (outcomes == name) & ~unjudged & ~missing)
            for name, colour in (("correct", GOOD), ("passable", FAIR), ("false", BAD))
        ),
        _layer("not found", MISSING, geometries, missing & ~unjudged),
    ]
    return [*layers, _torn(buildings, geometries)]


def _share_layers(buildings: pa.Table, shares: FloatArray, geometries: Sequence[Any]) -> list[Entry]:
    """Classes of the share (n,) of top-visible points within 0.2 m."""
    missing, unjudged = _missing(buildings), np.isnan(shares) | _cut(buildings)
    layers = [_layer("not judged (no points, or cut by the edge of the data)", UNJUDGED, geometries, unjudged)]
    judged = ~unjudged & ~missing
    upper = math.inf
    for least, colour in SHARES:
        label = f"at least {100.0 * least:.0f} %" if least > 0.0 else f"less than {100.0 * upper:.0f} %"
        layers.append(_layer(label, colour, geometries, judged & (shares >= least) & (shares < upper)))
        upper = least
    return [*layers, _layer("not found", MISSING, geometries, ~unjudged & missing), _torn(buildings, geometries)]


def _found_layers(buildings: pa.Table, geometries: Sequence[Any]) -> list[Entry]:
    layers = [
        _layer("found", GOOD, geometries, _found(buildings)),
        _layer("not found", MISSING, geometries, _missing(buildings)),
    ]
    return [*layers, _torn(buildings, geometries)]


def _false_models(evaluation: Evaluation) -> Entry:
    """Models where no building is, hatched."""
    table = evaluation.tables.get("models")
    chosen = set()
    if table is not None and "role" in table.column_names:
        roles = zip(table["model_id"].to_pylist(), table["role"].to_pylist(), strict=True)
        chosen = {name for name, role in roles if role == "false"}
    models = evaluation.models.models
    is_false = [model.building_id in chosen for model in models]
    return _layer("model without a building", BAD, [m.footprint for m in models], is_false, hatched=True)


def _status_layers(evaluation: Evaluation) -> list[Entry]:
    """The models alone: ok, doubtful, fallback, failed."""
    models, failed = evaluation.models.models, evaluation.models.failed
    footprints = [model.footprint for model in models]
    of_status = [
        _layer(label, colour, footprints, [model.status is status for model in models])
        for status, label, colour in (
            (Status.OK, "model", GOOD),
            (Status.DOUBTFUL, "doubtful model", DOUBTFUL),
            (Status.FALLBACK, "fallback (a block)", FAIR),
        )
    ]
    return [
        *of_status,
        _layer("no model", MISSING, [one.footprint for one in failed], [not one.footprint.is_empty for one in failed]),
    ]


def _face_layers(faces: pa.Table, model_faces: pa.Table | None) -> list[Entry]:
    """Found, missed, not to be found; wrong ones of the models hatched over them."""
    geometries = shapely.from_wkb(np.array(faces["geometry"].to_pylist(), dtype=object))
    found = flags(faces, "found")
    wanted = flags(faces, "to_be_found") if "to_be_found" in faces.column_names else np.ones(len(found), bool)
    layers = [
        _layer("too small, too sparse or cut: need not be found", UNJUDGED, geometries, ~wanted & ~found),
        _layer("found, though it need not be", "#8bb8d0", geometries, ~wanted & found),
        _layer("found", GOOD, geometries, wanted & found),
        _layer("missed", FAIR, geometries, wanted & ~found),
    ]
    if model_faces is not None and {"wrong", "geometry"} <= set(model_faces.column_names):
        made = shapely.from_wkb(np.array(model_faces["geometry"].to_pylist(), dtype=object))
        wrong = flags(model_faces, "wrong")
        layers.append(_layer("modelled face that matches none", BAD, made, wrong, hatched=True))
    return layers
