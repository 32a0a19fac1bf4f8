"""The record of a building at the levels of detail that are asked for, of which LoD2.2 is not the only one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

from pipeline.building.drawing import Building, DrawnModel
from pipeline.building.record import record_of
from pipeline.extras.lods.lower_lods import lower_lods
from pipeline.methods import MAIN_ROOF
from pipeline.model import BuildingResult, Decision, DecisionKind, LodModel, Outcome
from pipeline.quality.validity import check_solid
from pipeline.roof.solid import LodParts, renumbered


def at_levels(building: Building, model: DrawnModel) -> BuildingResult | None:
    """The record of a model in LoD2.2 at the levels of the settings; None where the finest of them is not valid."""
    settings, lods = building.settings, building.settings.record_lods
    models = lower_lods(
        model,
        building.roof.points,
        building.candidate.ground_z_m,
        settings.roof,
        lods,
        lambda solid: not check_solid(solid),
        building.roof.limit_mm,
    )
    building.decisions.extend(_levels(lods, models))
    if not models or models[0].lod != lods[-1]:
        return None
    finest, *coarser = models
    if finest is not model:  # level parts say nothing about the roof's type, and nothing competed with them
        own_type = record_of(building, model).roof_type
        model = DrawnModel(lod=finest.lod, parts=finest.parts, planes=finest.planes, roof_type=own_type)
    used = sorted({face.plane for part in model.parts for face in part.faces})
    number = {plane: k for k, plane in enumerate(used)}
    delivered = tuple(_lod_model(one, number) for one in coarser)
    return dataclasses.replace(record_of(building, model), coarser=delivered)


def _levels(lods: Sequence[str], models: Sequence[LodParts]) -> Iterator[Decision]:
    """Which of the levels of detail that were asked for were reached, the finest first."""
    reached = {model.lod: model for model in models}
    for lod in reversed(lods):
        faces = [face.plane for part in reached[lod].parts for face in part.faces] if lod in reached else None
        yield Decision(
            kind=DecisionKind.LEVEL,
            name=lod,
            outcome=Outcome.UNDRAWABLE if faces is None else Outcome.CHOSEN,
            detail="no form of its solids is valid" if faces is None else "",
            n_faces=None if faces is None else len(faces),
            n_planes=None if faces is None else len(set(faces)),
        )


def _lod_model(model: LodParts, number: dict[int, int]) -> LodModel:
    """A coarser model as it is delivered; `number` is that of each plane in the record, which LoD2.0 shares."""
    solids, planes = tuple(part.solid for part in model.parts), tuple(model.planes)
    if model.lod == MAIN_ROOF:
        solids = tuple(renumbered(solid, number) for solid in solids)
        planes = tuple(model.planes[plane] for plane in number)
    return LodModel(lod=model.lod, planes=planes, solids=solids)
