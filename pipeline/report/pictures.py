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


def blank(width_px: int, height_px: int) -> tuple[Figure, Axes]:
    """A figure with a size in pixels, 100 per inch, and axes that fill it."""
    figure = Figure(figsize=(width_px / 100.0, height_px / 100.0), dpi=100, facecolor="none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    return figure, axes


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


def paths_of(geometries: Sequence[Any]) -> list[DrawnPath]:
    """One path per geometry (polygon or multipolygon, with holes); missing and empty ones get an empty path."""
    return [_path(geometry) for geometry in geometries]


def _path(geometry: Any) -> DrawnPath:
    rings = [] if geometry is None else shapely.get_rings(shapely.force_2d(geometry))
    corners: list[FloatArray] = [shapely.get_coordinates(ring) for ring in rings]
    corners = [ring for ring in corners if len(ring) > 3]
    if not corners:
        return DrawnPath(np.zeros((1, 2)))
    codes = []
    for ring in corners:
        code = np.full(len(ring), DrawnPath.LINETO, dtype=np.uint8)
        code[0], code[-1] = DrawnPath.MOVETO, DrawnPath.CLOSEPOLY
        codes.append(code)
    return DrawnPath(np.vstack(corners), np.concatenate(codes))
