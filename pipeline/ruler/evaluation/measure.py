"""A measure: a figure with its interval, its denominator, and its subset of buildings."""

from __future__ import annotations

import dataclasses
from enum import StrEnum


class Better(StrEnum):
    """The better direction of a measure."""

    HIGHER = "higher"
    LOWER = "lower"
    ZERO = "zero"
    NEITHER = "neither"


class Group(StrEnum):
    """Chapters of a report, in their order."""

    DELIVERY = "delivery"
    RESIDUALS = "residuals"
    SURFACE = "surface"
    FACES = "faces"
    WIREFRAMES = "wireframes"
    ROOF_TYPES = "roof_types"
    FOOTPRINTS = "footprints"
    FORM = "form"
    DETECTION = "detection"
    GROUND = "ground"
    VALIDITY = "validity"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Definition:
    """One measure, defined once for tables, pages and docs."""

    name: str
    """Dotted, stable: `faces.completeness_10m2`."""
    group: Group
    label: str
    unit: str
    """m, m2, share (0 to 1), count, or empty."""
    better: Better
    formula: str
    """Its computation, one line of Markdown."""


def defined(name: str, label: str, formula: str, better: Better = Better.HIGHER, unit: str = "share") -> Definition:
    """A definition in the chapter that its name begins with."""
    group = Group(name.partition(".")[0])
    return Definition(name=name, group=group, label=label, unit=unit, better=better, formula=formula)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measure:
    """A measured figure."""

    name: str
    value: float
    """The figure; nan if the denominator is zero."""
    low: float = float("nan")
    """Lower end of the 95 % bootstrap interval; nan without one."""
    high: float = float("nan")
    n: int
    """Denominator: buildings, faces, points, cells."""
    subset: str = "all"
    """all, good (buildings without defects), or hard (with)."""
