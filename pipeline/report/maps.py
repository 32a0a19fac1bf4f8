"""Maps of buildings: layers of polygons drawn to a picture, with a legend and a scale bar as data.

The pictures have no text: legend and scale bar belong to the page. Faults are drawn last, and small polygons get an
edge in their own colour, so a map of a whole city still shows every fault.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection

from pipeline.model import FloatArray
from pipeline.report.pictures import blank, paths_of, png_of

WIDTH_PX = 1500
"""Width of a map over the full page; the height follows the extent."""
HALF_WIDTH_PX = 1000
"""Width of a map of few buildings."""
_MIN_HEIGHT, _MAX_HEIGHT = 0.35, 1.25
_MARGIN = 0.02
_SMALL_PX = 14.0
_HALF_SHARE = 0.04
_EDGE = "#ffffffa0"

GOOD, FAIR, BAD, MISSING, UNJUDGED = "#3f86b5", "#e3b23c", "#cf4f2a", "#8d4fa8", "#9aa3ab"
DOUBTFUL = "#009e73"
"""Blue, amber, vermilion, purple, grey, green: distinct for all kinds of colour vision, on white and on near black."""
NO_FIGURE = "-"
"""Shown for a missing figure."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A line of a legend, and the polygons that have its colour, or are hatched with it."""

    label: str
    colour: str
    count: int = 0
    hatched: bool = False
    geometries: Sequence[Any] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Map:
    """A map with its words."""

    title: str
    png: bytes
    width_px: int
    height_px: int
    legend: tuple[Entry, ...]
    is_half: bool
    scale_label: str
    scale_share: float

    @property
    def description(self) -> str:
        """Text alternative."""
        return f"Map: {self.title}. " + ", ".join(f"{entry.label}: {entry.count:,}" for entry in self.legend) + "."


def draw_map(title: str, layers: Sequence[Entry]) -> Map | None:
    """A map of the layers, later ones over earlier ones; None if they are empty."""
    drawn = [layer for layer in layers if layer.geometries]
    everything = [geometry for layer in drawn for geometry in layer.geometries if geometry is not None]
    if not everything:
        return None
    west, south, east, north = _extent(shapely.total_bounds(everything))
    width_m, height_m = east - west, north - south
    typical = float(np.median(np.sqrt(shapely.area(everything)))) / width_m
    is_half = typical >= _HALF_SHARE
    width_px = HALF_WIDTH_PX if is_half else WIDTH_PX
    height_px = round(width_px * height_m / width_m)
    figure, axes = blank(width_px, height_px)
    for place, layer in enumerate(drawn):
        _draw_layer(axes, layer, is_small=typical * width_px < _SMALL_PX, zorder=place + 1)
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    length_m = round_length(width_m / 5.0)
    return Map(
        title=title,
        png=png_of(figure),
        width_px=width_px,
        height_px=height_px,
        legend=tuple(dataclasses.replace(layer, geometries=()) for layer in drawn),
        is_half=is_half,
        scale_label=f"{length_m / 1000.0:g} km" if length_m >= 1000.0 else f"{length_m:g} m",
        scale_share=length_m / width_m,
    )


def _draw_layer(axes: Axes, layer: Entry, *, is_small: bool, zorder: int) -> None:
    colour = layer.colour
    edge = colour if is_small or layer.hatched else _EDGE
    drawn = PathCollection(
        paths_of(layer.geometries),
        facecolors="none" if layer.hatched else colour,
        edgecolors=edge,
        linewidths=1.5 if layer.hatched else 1.0 if is_small else 0.8,
        zorder=zorder,
    )
    if layer.hatched:
        drawn.set_hatch("//////" if is_small else "///")
    axes.add_collection(drawn, autolim=False)


def _extent(bounds: FloatArray) -> tuple[float, float, float, float]:
    """Bounds with a margin, with an aspect that fits a page."""
    west, south, east, north = (float(value) for value in bounds)
    margin = _MARGIN * max(east - west, north - south, 1.0)
    width, height = east - west + 2.0 * margin, north - south + 2.0 * margin
    width, height = max(width, height / _MAX_HEIGHT), max(height, width * _MIN_HEIGHT)
    x, y = (west + east) / 2.0, (south + north) / 2.0
    return x - width / 2.0, y - height / 2.0, x + width / 2.0, y + height / 2.0


def round_length(wanted_m: float) -> float:
    """The largest of 1, 2, 5, 10 ... up to the wanted length."""
    step = 10.0 ** math.floor(math.log10(wanted_m))
    return float(max(step * factor for factor in (1.0, 2.0, 5.0) if step * factor <= wanted_m * (1.0 + 1e-9)))
