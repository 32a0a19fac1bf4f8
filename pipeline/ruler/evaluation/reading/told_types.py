"""The roof type that a file says a building has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.model import RoofType

ATTRIBUTES = ("roof_type", "rf_roof_type", "b3_dak_type", "roofType", "roof:shape")
"""Attributes that tell a roof type, the first one counts: this program, roofer, 3DBAG, CityGML, OpenStreetMap."""

ROOF_TYPE_OF_WORD: Mapping[str, RoofType] = {
    **{kind.value: kind for kind in RoofType},
    "horizontal": RoofType.FLAT,
    "multiple horizontal": RoofType.FLAT,
    "1000": RoofType.FLAT,
    "1010": RoofType.PENT,
    "1030": RoofType.GABLE,
    "1040": RoofType.HIP,
    "1050": RoofType.HIP,
    "1060": RoofType.COMBINATION,
    "1070": RoofType.HIP,
    "1130": RoofType.COMBINATION,
    "monopitch": RoofType.PENT,
    "skillion": RoofType.PENT,
    "gabled": RoofType.GABLE,
    "hipped": RoofType.HIP,
    "half-hipped": RoofType.HIP,
    "pyramidal": RoofType.HIP,
    "mansard": RoofType.COMBINATION,
    "gambrel": RoofType.COMBINATION,
}
"""What the values mean: words, and codes of CityGML's list of roof types. `slanted` says too little to be one."""


def told_roof_type(attributes: Mapping[str, Any]) -> RoofType:
    """The type that the attributes tell; unknown where they tell none, or one that has no like here."""
    for name in ATTRIBUTES:
        value = attributes.get(name)
        if value is not None:
            return ROOF_TYPE_OF_WORD.get(str(value).strip().lower(), RoofType.UNKNOWN)
    return RoofType.UNKNOWN
