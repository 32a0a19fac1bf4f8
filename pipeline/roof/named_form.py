"""Forms that can be drawn, with the names under which a building's decisions list them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Generic, TypeVar

from pipeline.model import LabelArray, Plane
from pipeline.roof.partition import RoofPartition

Drawn_co = TypeVar("Drawn_co", covariant=True)

ARRANGEMENT, TEMPLATES, TRACED, PRIMITIVE, BLOCK = "arrangement", "templates", "traced", "primitive", "block"
CURVED = "curved"
"""Faces of least cost, simple shapes, traced borders, a whole form of a method, one level block, facets of a curve."""

SIMPLER = "within a simpler outline"
"""Detail of a form."""
MOST_TEMPLATE_POINTS = 500
"""With more points the arrangement has all it needs, and trying the cuts of templates takes time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RankedFaces:
    """Roof faces that competed with others for the same points."""

    partition: RoofPartition
    """A coverage of the outline, labels are indices of `planes`."""
    planes: tuple[Plane, ...]
    """In local metres."""
    labels: LabelArray
    """(n,) int32, plane of every point; -1 for none."""
    bic_margin: float = math.nan
    """By how much their criterion is below that of the others, negative where it is above; nan without others."""


@dataclasses.dataclass(frozen=True)
class NamedForm(Generic[Drawn_co]):
    """Draws a form when it is called."""

    name: str
    """One of the names above."""
    draw: Callable[[], Drawn_co]
    detail: str = ""
    """How this one differs from others of its name."""
    is_last_resort: bool = False
    """Whether it is drawn only where no other is valid: its outline is that of the points, zigzag and all."""

    def __call__(self) -> Drawn_co:
        """Draw it."""
        return self.draw()
