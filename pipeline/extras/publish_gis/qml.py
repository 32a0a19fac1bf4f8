"""Styles for QGIS, as QML: how a layer of a published run is drawn, with a legend that explains itself.

A style is a small document of our own making: one renderer, one fill per class. QGIS completes what is not stated.
Colours of statuses are those of the page about a run.
"""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from pipeline.model import Reason, Status

_VERSION = "3.22.0"
"""Oldest QGIS that was tried."""
_POLYGONS = "2"
"""QGIS's number of layers of polygons."""
_LINE = "70,70,70,255"
_GREY_LINE = "110,110,110,255"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Style:
    """A style of one layer."""

    layer: str
    """The layer."""
    name: str
    """Its name in QGIS, at most 30 characters."""
    description: str
    """A sentence for people."""
    qml: str
    """The document."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fill:
    """How the polygons of a class are filled."""

    colour: tuple[int, int, int, int]
    """Red, green, blue and opacity, 0 to 255."""
    pattern: str = "solid"
    """QGIS's name of a brush."""
    line: str = _LINE
    """The outline's colour, as QGIS writes it."""

    def element(self, name: str) -> ET.Element:
        """The symbol with this fill."""
        symbol = ET.Element("symbol", {"name": name, "type": "fill", "alpha": "1", "clip_to_extent": "1"})
        layer = ET.SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1", "locked": "0", "pass": "0"})
        options = ET.SubElement(layer, "Option", {"type": "Map"})
        values = {
            "color": ",".join(str(part) for part in self.colour),
            "style": self.pattern,
            "outline_color": self.line,
            "outline_style": "solid",
            "outline_width": "0.2",
            "outline_width_unit": "MM",
        }
        for key, value in values.items():
            ET.SubElement(options, "Option", {"name": key, "type": "QString", "value": value})
        return symbol


@dataclasses.dataclass(frozen=True, kw_only=True)
class Category:
    """The rows with one value of a column."""

    value: str
    """The value; empty for all others."""
    label: str
    """Its line in the legend."""
    fill: Fill
    """Its fill."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Range:
    """The rows whose value lies in a range."""

    lower: float
    """Smallest value."""
    upper: float
    """Largest value; of two ranges that hold a value, the first counts."""
    label: str
    """Its line in the legend."""
    fill: Fill
    """Its fill."""


def categorized(column: str, categories: Sequence[Category]) -> str:
    """The document of a layer that is drawn by the values of a column."""
    renderer = ET.Element("renderer-v2", {"type": "categorizedSymbol", "attr": column, "symbollevels": "0"})
    listed = ET.SubElement(renderer, "categories")
    for number, one in enumerate(categories):
        ET.SubElement(
            listed,
            "category",
            {"value": one.value, "type": "string", "label": one.label, "symbol": str(number), "render": "true"},
        )
    return _document(renderer, [one.fill for one in categories])


def graduated(column: str, ranges: Sequence[Range]) -> str:
    """The document of a layer that is drawn by ranges of a column; rows without a value are not drawn."""
    renderer = ET.Element(
        "renderer-v2",
        {"type": "graduatedSymbol", "attr": column, "graduatedMethod": "GraduatedColor", "symbollevels": "0"},
    )
    listed = ET.SubElement(renderer, "ranges")
    for number, one in enumerate(ranges):
        bounds = {"lower": repr(one.lower), "upper": repr(one.upper)}
        ET.SubElement(listed, "range", {**bounds, "label": one.label, "symbol": str(number), "render": "true"})
    return _document(renderer, [one.fill for one in ranges])


def _document(renderer: ET.Element, fills: Sequence[Fill]) -> str:
    """The document around a renderer, whose classes name the fills by number."""
    symbols = ET.SubElement(renderer, "symbols")
    symbols.extend(fill.element(str(number)) for number, fill in enumerate(fills))
    root = ET.Element("qgis", {"version": _VERSION, "styleCategories": "Symbology"})
    root.append(renderer)
    ET.SubElement(root, "layerGeometryType").text = _POLYGONS
    ET.indent(root, " ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _grey(level: int, pattern: str = "solid") -> Fill:
    return Fill(colour=(level, level, level, 255), pattern=pattern, line=_GREY_LINE)


STATUS_CLASSES = (
    Category(value=Status.OK.value, label="delivered: a closed, valid model", fill=Fill(colour=(63, 134, 181, 255))),
    Category(
        value=Status.DOUBTFUL.value,
        label="doubtful: the points do not support the model",
        fill=Fill(colour=(216, 96, 60, 255)),
    ),
    Category(
        value=Status.FALLBACK.value,
        label="fallback block: the roof could not be delivered",
        fill=Fill(colour=(227, 178, 60, 255)),
    ),
    Category(value=Status.FAILED.value, label="failed: no model", fill=Fill(colour=(141, 79, 168, 255))),
)
"""Statuses of buildings."""

DISTANCE_CLASSES = (
    Range(lower=0.95, upper=1.0, label="95 % or more within 0.2 m", fill=Fill(colour=(44, 123, 182, 255))),
    Range(lower=0.9, upper=0.95, label="90 to 95 %", fill=Fill(colour=(128, 191, 213, 255))),
    Range(lower=0.75, upper=0.9, label="75 to 90 %", fill=Fill(colour=(255, 238, 170, 255))),
    Range(lower=0.5, upper=0.75, label="50 to 75 %", fill=Fill(colour=(253, 174, 97, 255))),
    Range(lower=0.0, upper=0.5, label="under 50 %", fill=Fill(colour=(202, 54, 47, 255))),
)
"""Shares of the roof returns near the model, as on the page of the service: a chimney has few of them. The largest come
first, so that a value between two ranges is in the upper one, as there."""

SLOPE_CLASSES = (
    Range(lower=0.0, upper=5.0, label="flat: up to 5 degrees", fill=Fill(colour=(247, 241, 221, 255))),
    Range(lower=5.0, upper=20.0, label="5 to 20 degrees", fill=Fill(colour=(250, 210, 140, 255))),
    Range(lower=20.0, upper=35.0, label="20 to 35 degrees", fill=Fill(colour=(243, 160, 88, 255))),
    Range(lower=35.0, upper=50.0, label="35 to 50 degrees", fill=Fill(colour=(216, 97, 62, 255))),
    Range(lower=50.0, upper=90.0, label="steep: more than 50 degrees", fill=Fill(colour=(141, 40, 56, 255))),
)
"""Slopes of roof planes."""

REJECTED_CLASSES = (
    Category(value=Reason.VEGETATION.value, label="vegetation", fill=_grey(205)),
    Category(value=Reason.TOO_SMALL.value, label="too small", fill=_grey(170)),
    Category(value=Reason.TOO_LOW.value, label="too low", fill=_grey(135)),
    Category(value=Reason.TOO_NARROW.value, label="too narrow: a wall, a hedge", fill=_grey(100)),
    Category(value=Reason.NO_WALLS.value, label="no walls: a mound, a bank", fill=_grey(130, "horizontal")),
    Category(value=Reason.BELOW_Z_AVG.value, label="below the walls around it: a yard", fill=_grey(130, "vertical")),
    Category(value=Reason.TOO_FEW_POINTS.value, label="too few points", fill=_grey(130, "b_diagonal")),
    Category(value=Reason.BRIDGE.value, label="bridge", fill=_grey(130, "cross")),
    Category(value=Reason.VEHICLE.value, label="vehicle, container", fill=_grey(130, "diagonal_x")),
    Category(value=Reason.STRIPS_DISAGREE.value, label="flight strips that disagree", fill=_grey(60, "horizontal")),
    Category(value=Reason.OVERRIDDEN.value, label="rejected by an override", fill=_grey(130, "f_diagonal")),
    Category(value="", label="another reason", fill=_grey(230)),
)
"""Reasons of rejected objects."""

STYLES = (
    Style(
        layer="buildings",
        name="status",
        description="Delivered models, fallback blocks and failed candidates",
        qml=categorized("status", STATUS_CLASSES),
    ),
    Style(
        layer="buildings",
        name="distance of the points",
        description="Share of the roof returns within 0.2 m of the model; buildings without one are not drawn",
        qml=graduated("share_within_0_2m", DISTANCE_CLASSES),
    ),
    Style(
        layer="planes",
        name="slope",
        description="Roof planes by slope",
        qml=graduated("slope_deg", SLOPE_CLASSES),
    ),
    Style(
        layer="rejected",
        name="reason",
        description="Objects that are not buildings, in grey, by the reason",
        qml=categorized("reason", REJECTED_CLASSES),
    ),
)
"""All styles; the first of a layer is its default."""
