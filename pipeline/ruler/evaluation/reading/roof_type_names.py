"""Roof types by the names and codes of files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.model import RoofType

ATTRIBUTES = ("roof_type", "rf_roof_type", "b3_dak_type", "roofType", "roof:shape")
"""Attributes with a roof type, the first one counts: this program, roofer, 3DBAG, CityGML, OpenStreetMap."""

ROOF_TYPE_OF_WORD: Mapping[str, RoofType] = {
    **{kind.value: kind for kind in RoofType},
    "horizontal": RoofType.FLAT,
    "multiple horizontal": RoofType.FLAT,
    "1000": RoofType.FLAT,
    "1010": RoofType.PENT,
    "1030": RoofType.GABLE,
    "1040": RoofType.HIP,
    "1050": RoofType.HALF_HIP,
    "1060": RoofType.MANSARD,
    "1070": RoofType.PYRAMID,
    "1080": RoofType.CONE,
    "1090": RoofType.DOME,
    "1110": RoofType.BARREL,
    "1130": RoofType.COMBINATION,
    "monopitch": RoofType.PENT,
    "skillion": RoofType.PENT,
    "gabled": RoofType.GABLE,
    "hipped": RoofType.HIP,
    "half-hipped": RoofType.HALF_HIP,
    "pyramidal": RoofType.PYRAMID,
    "round": RoofType.BARREL,
}
"""Meanings of the values: words, and codes of the list of roof types of CityGML. `slanted` is too vague."""


def named_roof_type(attributes: Mapping[str, Any]) -> RoofType:
    """The roof type in the attributes; unknown if there is none, or none that exists here."""
    for name in ATTRIBUTES:
        value = attributes.get(name)
        if value is not None:
            return ROOF_TYPE_OF_WORD.get(str(value).strip().lower(), RoofType.UNKNOWN)
    return RoofType.UNKNOWN
