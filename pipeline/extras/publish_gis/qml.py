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
class Class:
    """The rows that are drawn alike."""

    label: str
    """Its line in the legend."""
    fill: Fill
    """Its fill."""
    value: str = ""
    """The value of the column; empty for all others."""
    bounds: tuple[float, float] | None = None
    """Its smallest and largest value in place of one; of two classes that hold a value, the first counts."""

    def element(self, number: int) -> ET.Element:
        """The class in the renderer, with the symbol of that number."""
        shown = {"label": self.label, "symbol": str(number), "render": "true"}
        if self.bounds is None:
            return ET.Element("category", {"value": self.value, "type": "string", **shown})
        lower, upper = map(repr, self.bounds)
        return ET.Element("range", {"lower": lower, "upper": upper, **shown})


def style_of(column: str, classes: Sequence[Class]) -> str:
    """The document of a layer that is drawn by a column, by values or by ranges; rows in no range are not drawn."""
    is_graduated = classes[0].bounds is not None
    kind = {"type": "categorizedSymbol", "attr": column, "symbollevels": "0"}
    if is_graduated:
        kind = {
            "type": "graduatedSymbol", "attr": column, "graduatedMethod": "GraduatedColor", "symbollevels": "0"
        }  # fmt: skip
    renderer = ET.Element("renderer-v2", kind)
    listed = ET.SubElement(renderer, "ranges" if is_graduated else "categories")
    listed.extend(one.element(number) for number, one in enumerate(classes))
    symbols = ET.SubElement(renderer, "symbols")
    symbols.extend(one.fill.element(str(number)) for number, one in enumerate(classes))
    root = ET.Element("qgis", {"version": _VERSION, "styleCategories": "Symbology"})
    root.append(renderer)
    ET.SubElement(root, "layerGeometryType").text = _POLYGONS
    ET.indent(root, " ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _grey(level: int, pattern: str = "solid") -> Fill:
    return Fill(colour=(level, level, level, 255), pattern=pattern, line=_GREY_LINE)


STATUS_CLASSES = (
    Class(value=Status.OK.value, label="delivered: a closed, valid model", fill=Fill(colour=(63, 134, 181, 255))),
    Class(
        value=Status.DOUBTFUL.value,
        label="doubtful: the points do not support the model",
        fill=Fill(colour=(216, 96, 60, 255)),
    ),
    Class(
        value=Status.FALLBACK.value,
        label="fallback block: the roof could not be delivered",
        fill=Fill(colour=(227, 178, 60, 255)),
    ),
    Class(value=Status.FAILED.value, label="failed: no model", fill=Fill(colour=(141, 79, 168, 255))),
)
"""Statuses of buildings."""

DISTANCE_CLASSES = (
    Class(bounds=(0.95, 1.0), label="95 % or more within 0.2 m", fill=Fill(colour=(44, 123, 182, 255))),
    Class(bounds=(0.9, 0.95), label="90 to 95 %", fill=Fill(colour=(128, 191, 213, 255))),
    Class(bounds=(0.75, 0.9), label="75 to 90 %", fill=Fill(colour=(255, 238, 170, 255))),
    Class(bounds=(0.5, 0.75), label="50 to 75 %", fill=Fill(colour=(253, 174, 97, 255))),
    Class(bounds=(0.0, 0.5), label="under 50 %", fill=Fill(colour=(202, 54, 47, 255))),
)
"""Shares of the roof returns near the model, as on the page of the service: a chimney has few of them. The largest come
first, so that a value between two ranges is in the upper one, as there."""

SLOPE_CLASSES = (
    Class(bounds=(0.0, 5.0), label="flat: up to 5 degrees", fill=Fill(colour=(247, 241, 221, 255))),
    Class(bounds=(5.0, 20.0), label="5 to 20 degrees", fill=Fill(colour=(250, 210, 140, 255))),
    Class(bounds=(20.0, 35.0), label="20 to 35 degrees", fill=Fill(colour=(243, 160, 88, 255))),
    Class(bounds=(35.0, 50.0), label="35 to 50 degrees", fill=Fill(colour=(216, 97, 62, 255))),
    Class(bounds=(50.0, 90.0), label="steep: more than 50 degrees", fill=Fill(colour=(141, 40, 56, 255))),
)
"""Slopes of roof planes."""

REJECTED_CLASSES = (
    Class(value=Reason.VEGETATION.value, label="vegetation", fill=_grey(205)),
    Class(value=Reason.TOO_SMALL.value, label="too small", fill=_grey(170)),
    Class(value=Reason.TOO_LOW.value, label="too low", fill=_grey(135)),
    Class(value=Reason.TOO_NARROW.value, label="too narrow: a wall, a hedge", fill=_grey(100)),
    Class(value=Reason.NO_WALLS.value, label="no walls: a mound, a bank", fill=_grey(130, "horizontal")),
    Class(value=Reason.BELOW_Z_AVG.value, label="below the walls around it: a yard", fill=_grey(130, "vertical")),
    Class(value=Reason.TOO_FEW_POINTS.value, label="too few points", fill=_grey(130, "b_diagonal")),
    Class(value=Reason.BRIDGE.value, label="bridge", fill=_grey(130, "cross")),
    Class(value=Reason.VEHICLE.value, label="vehicle, container", fill=_grey(130, "diagonal_x")),
    Class(value=Reason.STRIPS_DISAGREE.value, label="flight strips that disagree", fill=_grey(60, "horizontal")),
    Class(value=Reason.OVERRIDDEN.value, label="rejected by an override", fill=_grey(130, "f_diagonal")),
    Class(value="", label="another reason", fill=_grey(230)),
)
"""Reasons of rejected objects."""

STYLES = (
    Style(
        layer="buildings",
        name="status",
        description="Delivered models, fallback blocks and failed candidates",
        qml=style_of("status", STATUS_CLASSES),
    ),
    Style(
        layer="buildings",
        name="distance of the points",
        description="Share of the roof returns within 0.2 m of the model; buildings without one are not drawn",
        qml=style_of("share_within_0_2m", DISTANCE_CLASSES),
    ),
    Style(
        layer="planes",
        name="slope",
        description="Roof planes by slope",
        qml=style_of("slope_deg", SLOPE_CLASSES),
    ),
    Style(
        layer="rejected",
        name="reason",
        description="Objects that are not buildings, in grey, by the reason",
        qml=style_of("reason", REJECTED_CLASSES),
    ),
)
"""All styles; the first of a layer is its default."""
