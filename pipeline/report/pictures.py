"""Figures as small PNG bytes for a page: no background, few colours, text left to the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.path import Path as DrawnPath
from PIL import Image

from pipeline.model import FloatArray

COLOURS = 128
"""Colours of a picture: so few make a PNG a third as large."""
_MARGIN = 0.06


def blank(width_px: int, height_px: int) -> tuple[Figure, Axes]:
    """A figure with a size in pixels, 100 per inch, and axes that fill it."""
    figure = Figure(figsize=(width_px / 100.0, height_px / 100.0), dpi=100, facecolor="none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    return figure, axes


def set_frame(axes: Axes, places: FloatArray) -> float:
    """Show all places (n, 2) with a margin, at one scale in both directions; returns the shown width."""
    low, high = places.min(axis=0), places.max(axis=0)
    shape: Any = axes.figure
    width_px, height_px = map(float, shape.get_size_inches())
    size = np.maximum(high - low, 1.0) * (1.0 + 2.0 * _MARGIN)
    width = max(float(size[0]), float(size[1]) * width_px / height_px)
    (x, y), half = (low + high) / 2.0, width * height_px / width_px / 2.0
    axes.set_aspect("auto")
    axes.set_xlim(x - width / 2.0, x + width / 2.0)
    axes.set_ylim(y - half, y + half)
    return width


def png_of(figure: Figure) -> bytes:
    """The figure as a PNG with a transparent background, for light and dark pages."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    reduced = Image.fromarray(np.asarray(canvas.buffer_rgba())).quantize(COLOURS, Image.Quantize.FASTOCTREE)
    written = io.BytesIO()
    reduced.save(written, format="PNG", optimize=True)
    return written.getvalue()


def data_uri(png: bytes) -> str:
    """PNG bytes as a data URI."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def drawn_path(rings: Sequence[FloatArray]) -> DrawnPath:
    """One path of outer rings and holes; the rings are (n, 2), the first vertex not repeated. Empty without rings."""
    if not rings:
        return DrawnPath(np.full((1, 2), np.nan))
    codes = []
    for ring in rings:
        code = np.full(len(ring) + 1, DrawnPath.LINETO, dtype=np.uint8)
        code[0], code[-1] = DrawnPath.MOVETO, DrawnPath.CLOSEPOLY
        codes.append(code)
    return DrawnPath(np.vstack([corners for ring in rings for corners in (ring, ring[:1])]), np.concatenate(codes))


def paths_of(geometries: Sequence[Any]) -> list[DrawnPath]:
    """One path per geometry (polygon or multipolygon, with holes); missing and empty ones get an empty path."""
    return [drawn_path([ring[:-1] for ring in plan_rings(geometry) if len(ring) > 3]) for geometry in geometries]


def plan_rings(geometry: Any) -> list[FloatArray]:
    """All rings of a polygon or multipolygon in plan, closed, (n, 2) each; none of a missing one."""
    # a multipolygon has no rings of its own
    rings = [] if geometry is None else shapely.get_rings(shapely.get_parts(shapely.force_2d(geometry)))
    return [shapely.get_coordinates(ring) for ring in rings]
