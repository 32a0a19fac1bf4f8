"""Forms that can be drawn, with the names under which a building's decisions list them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Generic, TypeVar

Drawn_co = TypeVar("Drawn_co", covariant=True)

ARRANGEMENT, TEMPLATES, TRACED, PRIMITIVE, BLOCK = "arrangement", "templates", "traced", "primitive", "block"
"""Faces of least cost, simple shapes, traced borders, a whole form of a method, one level block."""


@dataclasses.dataclass(frozen=True)
class NamedForm(Generic[Drawn_co]):
    """Draws a form when it is called."""

    name: str
    """One of the names above."""
    draw: Callable[[], Drawn_co]
    detail: str = ""
    """How this one differs from others of its name."""

    def __call__(self) -> Drawn_co:
        """Draw it."""
        return self.draw()
