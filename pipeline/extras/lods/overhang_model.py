"""LoD2.3: the model of a building with overhangs."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipeline.building.drawing import Building, DrawnModel
from pipeline.extras.lods.facades import Walls
from pipeline.extras.lods.overhangs import UndrawableError, floor_m2, overhanging_solids
from pipeline.extras.lods.wider_eaves import wider_parts
from pipeline.methods import OVERHANGS
from pipeline.model import Decision, DecisionKind, NoOverhang, Outcome, Overhangs, OverhangSource, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.footprint_in_mm import footprint_in_mm
from pipeline.roof.solid import renumbered, united

_LEAST_BEYOND_M2 = 0.05
"""Area of walls beyond a footprint that rounding makes; more is a fault."""


def overhangs_of(building: Building, model: DrawnModel, walls: Walls | None) -> Overhangs:
    """The model in LoD2.3 beside a valid one, or why there is none; how it ended is added to the decisions."""
    solids: tuple[Solid, ...] = ()
    source = reason = None
    detail = ""
    try:
        source, drawn = _with_overhangs(building, model, walls)
    except UndrawableError as error:
        reason, detail = error.reason, f"{error.reason}: {error}"
    else:
        used = sorted({face.plane for part in model.parts for face in part.faces})
        solids = tuple(renumbered(solid, {plane: k for k, plane in enumerate(used)}) for solid in drawn)
    planes = [face.plane for solid in solids for face in solid.faces if face.plane >= 0]
    building.decisions.append(
        Decision(
            kind=DecisionKind.LEVEL,
            name=OVERHANGS,
            outcome=Outcome.CHOSEN if solids else Outcome.UNDRAWABLE,
            detail=detail,
            n_faces=len(planes) if solids else None,
            n_planes=len(set(planes)) if solids else None,
        )
    )
    return Overhangs(solids=solids, source=source, reason=reason)


def _with_overhangs(
    building: Building, model: DrawnModel, walls: Walls | None
) -> tuple[OverhangSource, Sequence[Solid]]:
    """Solids with overhangs for the parts of a model, and where the overhangs come from.

    Raises UndrawableError where there are none or they cannot be drawn.
    """
    settings, ground_z_m, facades = building.settings.roof, building.candidate.ground_z_m, building.roof.facades
    if model.lod != "2.2":
        raise UndrawableError(NoOverhang.NO_LOD22, "the model is a block")
    parts, least_m = model.parts, settings.min_overhang_m
    if walls is None:
        source, given_m = OverhangSource.GIVEN, settings.beyond_footprint_m
        if facades is None or given_m <= 0.0:
            raise UndrawableError(NoOverhang.FOOTPRINT_GIVEN, "beyond_footprint_m is 0")
        if given_m < least_m:
            raise UndrawableError(NoOverhang.OVERHANG_TOO_SMALL, f"{given_m:.3f} m, less than {least_m:g} m")
        walls_mm = footprint_in_mm(united([part.footprint for part in parts]))
        parts = wider_parts(parts, model.planes, facades, given_m, ground_z_m)
    else:
        source = OverhangSource.USUAL if math.isnan(walls.overhang_m) else OverhangSource.SEEN
        if source is OverhangSource.USUAL and settings.usual_overhang_m <= 0.0:
            raise UndrawableError(NoOverhang.NO_WALL_SEEN, "usual_overhang_m is 0")
        if source is OverhangSource.USUAL and walls.widest_m <= 0.0:
            raise UndrawableError(NoOverhang.NO_OPEN_GROUND, "no line has open ground before it")
        if walls.counted_m <= 0.0:
            raise UndrawableError(NoOverhang.OVERHANG_TOO_SMALL, f"{walls.widest_m:.3f} m, less than {least_m:g} m")
        walls_mm = walls.overhung_mm
    solids = overhanging_solids(
        parts, model.planes, walls_mm, settings.overhang_thickness_m, ground_z_m + settings.min_clearance_m,
        lambda solid: not check_solid(solid),
    )  # fmt: skip
    if source is OverhangSource.GIVEN:
        beyond_m2 = math.fsum(map(floor_m2, solids)) - math.fsum(floor_m2(part.solid) for part in model.parts)
        if beyond_m2 > _LEAST_BEYOND_M2:
            raise UndrawableError(NoOverhang.TOO_LOW, f"{beyond_m2:.2f} m2 of walls would be beyond the footprint")
    return source, solids
