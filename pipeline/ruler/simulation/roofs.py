"""The parametric roofs: the roof type of each shape in the records, and the function that makes its faces."""

from __future__ import annotations

import functools
from collections.abc import Callable

from pipeline.model import RoofType
from pipeline.ruler.simulation.additions import addition_parts
from pipeline.ruler.simulation.envelope import envelope
from pipeline.ruler.simulation.roof_dimensions import (
    Addition,
    AdditionKind,
    BrokenForm,
    CurvedForm,
    FaceRings,
    FlatPart,
    RoofDimensions,
    RoofFaces,
    RoofShape,
)
from pipeline.ruler.simulation.roof_parts import PARTS
from pipeline.ruler.simulation.simple_roofs import flat, gable, hip, l_shape, pent

__all__ = [
    "ROOFS",
    "ROOF_TYPES",
    "Addition",
    "AdditionKind",
    "BrokenForm",
    "CurvedForm",
    "FaceRings",
    "FlatPart",
    "RoofDimensions",
    "RoofFaces",
    "RoofShape",
]

ROOF_TYPES: dict[RoofShape | BrokenForm | CurvedForm, RoofType] = {
    RoofShape.FLAT: RoofType.FLAT,
    RoofShape.PENT: RoofType.PENT,
    RoofShape.GABLE: RoofType.GABLE,
    RoofShape.HIP: RoofType.HIP,
    RoofShape.L_SHAPE: RoofType.L_SHAPE,
    RoofShape.HALF_HIP: RoofType.HALF_HIP,
    RoofShape.BENT_HIP: RoofType.HIP,
    RoofShape.PYRAMID: RoofType.PYRAMID,
    RoofShape.UNEQUAL_GABLE: RoofType.GABLE,
    RoofShape.MANSARD: RoofType.MANSARD,
    RoofShape.GAMBREL: RoofType.GAMBREL,
    RoofShape.T_SHAPE: RoofType.T_SHAPE,
    RoofShape.U_SHAPE: RoofType.COMBINATION,
    RoofShape.CROSS: RoofType.CROSS,
    RoofShape.COURTYARD: RoofType.COMBINATION,
    RoofShape.MULTI_LEVEL_FLAT: RoofType.FLAT,
    BrokenForm.MANSARD: RoofType.MANSARD,
    BrokenForm.GAMBREL: RoofType.GAMBREL,
    BrokenForm.KICKED_HIP: RoofType.HIP,
    BrokenForm.KICKED_GABLE: RoofType.GABLE,
    BrokenForm.JERKINHEAD: RoofType.HALF_HIP,
    BrokenForm.CROSS_GABLE: RoofType.CROSS,
    BrokenForm.HEXAGONAL_PYRAMID: RoofType.PYRAMID,
    BrokenForm.SAWTOOTH: RoofType.SAWTOOTH,
    BrokenForm.BUTTERFLY: RoofType.BUTTERFLY,
    BrokenForm.GABLE_DORMERS: RoofType.GABLE,
    BrokenForm.SHED_DORMERS: RoofType.GABLE,
    BrokenForm.HIPPED_DORMERS: RoofType.GABLE,
    BrokenForm.PARAPET: RoofType.FLAT,
    BrokenForm.PARAPET_GABLE: RoofType.GABLE,
    CurvedForm.SHALLOW_BARREL: RoofType.BARREL,
    CurvedForm.BARREL: RoofType.BARREL,
    CurvedForm.HALF_BARREL: RoofType.BARREL,
    CurvedForm.ELLIPTIC_BARREL: RoofType.BARREL,
    CurvedForm.CONE: RoofType.CONE,
    CurvedForm.DOME: RoofType.DOME,
    CurvedForm.CAP: RoofType.DOME,
    CurvedForm.SQUARE_CAP: RoofType.DOME,
}
"""The roof type of every shape in the records, with any additions."""


_BARE: dict[RoofShape, Callable[[RoofDimensions], RoofFaces]] = {
    RoofShape.FLAT: flat,
    RoofShape.PENT: pent,
    RoofShape.GABLE: gable,
    RoofShape.HIP: hip,
    RoofShape.L_SHAPE: l_shape,
}


def _maker(shape: RoofShape) -> Callable[[RoofDimensions], RoofFaces]:
    """The function that makes a roof of a shape with its additions."""
    parts = PARTS[shape]

    @functools.lru_cache(maxsize=256)  # a layout makes the same roof while it draws additions and places it
    def make(size: RoofDimensions) -> RoofFaces:
        bare = _BARE[shape](size) if shape in _BARE else envelope(parts(size))
        if not size.additions:
            return bare
        return envelope([*parts(size), *addition_parts(bare, size.additions)])

    return make


ROOFS: dict[RoofShape, Callable[[RoofDimensions], RoofFaces]] = {shape: _maker(shape) for shape in RoofShape}
"""The function of every shape. It raises ValueError if the dimensions give no such roof."""
