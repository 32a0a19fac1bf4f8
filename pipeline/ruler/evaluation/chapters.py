"""The figures of an evaluation for readers: chapters of lines with label, value, interval and denominator.

Terminal, Markdown and page all show these texts: a figure reads the same everywhere.
"""

from __future__ import annotations

import dataclasses
import math

from pipeline.report.table import CountTable
from pipeline.ruler.evaluation.counted_models import count_tables
from pipeline.ruler.evaluation.definitions import DEFINITIONS
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.measure import Better, Definition, Group, Measure

TITLES = {
    Group.DELIVERY: "What was delivered",
    Group.RESIDUALS: "Points against the models",
    Group.SURFACE: "Roof surfaces against the truth",
    Group.FACES: "Roof faces",
    Group.WIREFRAMES: "Roof edges and corners",
    Group.ROOF_TYPES: "Roof types",
    Group.FOOTPRINTS: "Footprints",
    Group.FORM: "Form of outlines",
    Group.DETECTION: "Detection of buildings",
    Group.GROUND: "Ground filter",
    Group.VALIDITY: "Validity of the solids",
}
"""Titles of the chapters."""
SUBSETS = {"all": "all", "good": "without defects", "hard": "with defects"}
"""Subsets of buildings in their order, with their labels; others follow under their own name."""
NOTHING = "-"
"""Shown for a missing figure."""
_UNITS = {
    "share": (100.0, 1, " %"),
    "count": (1.0, 0, ""),
    "m": (1.0, 3, " m"),
    "m2": (1.0, 1, " m²"),
    "m3": (1.0, 1, " m³"),
    "deg": (1.0, 1, "°"),
}
"""Factor, most decimals and sign of each unit; others have three decimals and their own name."""
_DECIMALS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Line:
    """One measure of one subset, ready to print."""

    definition: Definition
    measure: Measure
    value: str
    """`93.4 %`, `0.052 m`; a dash for a missing figure."""
    interval: str
    """`92.9 to 94.0 %`; empty without one, or if resampling did not change the figure."""
    n: str
    """Denominator with separated thousands."""

    @property
    def label(self) -> str:
        """A few words."""
        return self.definition.label

    @property
    def subset(self) -> str:
        """Label of the subset."""
        return SUBSETS.get(self.measure.subset, self.measure.subset)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chapter:
    """The measures of one group."""

    group: Group
    title: str
    lines: tuple[Line, ...]
    """In the order of the measures; the subsets of one measure follow one another."""
    tables: tuple[CountTable, ...]
    """Counts behind the figures."""

    @property
    def subsets(self) -> tuple[str, ...]:
        """Labels of the subsets that occur, in their order."""
        found = {line.measure.subset for line in self.lines}
        ordered = [name for name in SUBSETS if name in found] + sorted(found - SUBSETS.keys())
        return tuple(SUBSETS.get(name, name) for name in ordered)

    @property
    def measures(self) -> dict[str, dict[str, Line]]:
        """Lines by name of the measure and label of the subset."""
        found: dict[str, dict[str, Line]] = {}
        for line in self.lines:
            found.setdefault(line.definition.name, {})[line.subset] = line
        return found


def definition_of(name: str) -> Definition:
    """The definition of a measure."""
    if name not in DEFINITIONS:
        raise KeyError(f"measure {name!r} has no definition: add it to DEFINITIONS of the module that measures it")
    return DEFINITIONS[name]


def chapters(evaluation: Evaluation) -> tuple[Chapter, ...]:
    """The measures of an evaluation by chapter, in the order of `Group`.

    Chapters without measures are left out, and subsets without anything in them.
    """
    by_group: dict[Group, dict[str, list[Measure]]] = {group: {} for group in Group}
    filled = {measure.subset for measure in evaluation.measures if measure.n > 0} | {"all"}
    for measure in evaluation.measures:
        if measure.subset not in filled:
            continue
        group = definition_of(measure.name).group
        by_group[group].setdefault(measure.name, []).append(measure)
    tables = count_tables(evaluation.tables)
    return tuple(
        Chapter(
            group=group,
            title=TITLES[group],
            lines=tuple(
                printed(measure, DEFINITIONS[name]) for name, measures in named.items() for measure in measures
            ),
            tables=tables.get(group, ()),
        )
        for group, named in by_group.items()
        if named or group in tables
    )


def printed(measure: Measure, definition: Definition) -> Line:
    """A measure with its texts: never more digits than the interval supports."""
    unit, signed = definition.unit, definition.better is Better.ZERO
    decimals = supported_decimals(measure.low, measure.high, unit)
    interval = ""
    if measure.low < measure.high:
        low, high = (number_text(end, unit, decimals, signed=signed) for end in (measure.low, measure.high))
        interval = f"{low} to {high}{unit_sign(unit)}"
    value = NOTHING
    if math.isfinite(measure.value):
        value = number_text(measure.value, unit, decimals, signed=signed) + unit_sign(unit)
    return Line(definition=definition, measure=measure, value=value, interval=interval, n=f"{measure.n:,}")


def unit_sign(unit: str) -> str:
    """What follows a figure of a unit, with its space."""
    return _UNITS[unit][2] if unit in _UNITS else (f" {unit}" if unit else "")


def supported_decimals(low: float, high: float, unit: str) -> int:
    """Decimals of a printed figure: those of its unit, and at most two digits of half its interval (nan without one).

    >>> supported_decimals(0.90, 0.96, "share"), supported_decimals(0.5, 0.9, "share")
    (1, 0)
    >>> supported_decimals(0.051, 0.055, "m"), supported_decimals(0.4, 0.9, "m")
    (3, 2)
    """
    factor, most, _ = _UNITS.get(unit, (1.0, _DECIMALS, ""))
    half = factor * (high - low) / 2.0
    if not math.isfinite(half) or half <= 0.0:
        return most
    return min(most, max(0, 1 - math.floor(math.log10(half))))


def number_text(value: float, unit: str, decimals: int, *, signed: bool = False) -> str:
    """A figure without the sign of its unit; only whole shares are printed as 0 or 100 %.

    >>> number_text(0.99996, "share", 1), number_text(1.0, "share", 1), number_text(12345.0, "count", 0)
    ('> 99.9', '100.0', '12,345')
    """
    shown = _UNITS.get(unit, (1.0, _DECIMALS, ""))[0] * value
    text = f"{shown:{'+' if signed else ''},.{decimals}f}"
    if unit == "share" and not signed:
        step = 10.0**-decimals
        if value < 1.0 and float(text) >= 100.0:
            return f"> {100.0 - step:.{decimals}f}"
        if value > 0.0 and float(text) == 0.0:
            return f"< {step:.{decimals}f}"
    return text if float(text.replace(",", "")) != 0.0 else text.lstrip("+-")
