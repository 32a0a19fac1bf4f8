"""All measures by name, collected from the modules that measure."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from pipeline.ruler.evaluation import (
    delivery,
    detection,
    faces,
    footprints,
    ground,
    residuals,
    roof_types,
    surface,
    validity,
    wireframes,
)
from pipeline.ruler.evaluation.measure import Definition

_MODULES = (delivery, residuals, surface, faces, wireframes, roof_types, footprints, detection, ground, validity)

DEFINITIONS: Mapping[str, Definition] = MappingProxyType(
    {definition.name: definition for module in _MODULES for definition in module.DEFINITIONS}
)
"""Definitions by name, in the order of the chapters."""
