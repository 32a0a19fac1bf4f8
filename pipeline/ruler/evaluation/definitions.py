"""All measures by name, collected from the modules that measure."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from pipeline.ruler.evaluation import (
    board_scores,
    delivery,
    detection_scores,
    face_scores,
    footprints,
    form_scores,
    ground_scores,
    residual_scores,
    roof_types,
    surface,
    validity_scores,
    wireframe_scores,
)
from pipeline.ruler.evaluation.measure import Definition

_MODULES = (
    delivery,
    residual_scores,
    surface,
    face_scores,
    wireframe_scores,
    board_scores,
    roof_types,
    footprints,
    form_scores,
    detection_scores,
    ground_scores,
    validity_scores,
)

DEFINITIONS: Mapping[str, Definition] = MappingProxyType(
    {definition.name: definition for module in _MODULES for definition in module.DEFINITIONS}
)
"""Definitions by name, in the order of the chapters."""
