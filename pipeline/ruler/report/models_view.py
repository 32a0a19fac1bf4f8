"""A bird's-eye view of models that are measured without a reference."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import RoofType
from pipeline.report.maps import Entry
from pipeline.report.perspective import View, draw_view
from pipeline.report.pictures import blank, png_of
from pipeline.report.render import ROOF_COLOURS, VIEW_SIDE_M, view_window
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.report.viewed_models import viewed_faces

WIDTH_PX = 1500
"""Width of the picture."""
_HEIGHTS_PX = (450, 1050)
_MARGIN = 1.04


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelsView:
    """The picture with its words."""

    png: bytes
    """The picture."""
    width_px: int
    """Its width."""
    height_px: int
    """Its height."""
    legend: tuple[Entry, ...]
    """Roof types in it, with their numbers."""
    caption: str
    """What it shows."""


def models_view(models: Sequence[RoofModel]) -> ModelsView | None:
    """All models if they lie close together, else those in the square with the most roof faces; None without faces."""
    faces = np.array([surface.polygon for model in models for surface in model.surfaces], dtype=object)
    window, is_part = view_window(faces, 1.0)
    square = shapely.box(*window)
    shown = [model for model in models if model.surfaces and shapely.intersects_xy(square, *_middle(model))]
    viewed = [viewed_faces(model) for model in shown]
    if not viewed:
        return None
    corner = np.array([window[0], window[1], 0.0])
    local = [
        [dataclasses.replace(face, rings=tuple(ring - corner for ring in face.rings)) for face in building]
        for building in viewed
    ]
    drawn, limits = blank(WIDTH_PX, WIDTH_PX)
    draw_view(limits, local, View())
    west, east = limits.get_xlim()
    south, north = limits.get_ylim()
    low_px, high_px = _HEIGHTS_PX
    height_px = int(np.clip(round(WIDTH_PX * (north - south) / (east - west)), low_px, high_px))
    drawn.set_size_inches(WIDTH_PX / 100.0, height_px / 100.0)
    types = [model.roof_type for model in shown]
    place = f"the square of {VIEW_SIDE_M:g} m with the most roof faces" if is_part else "all models"
    return ModelsView(
        png=png_of(drawn),
        width_px=WIDTH_PX,
        height_px=height_px,
        legend=tuple(
            Entry(label=kind.value, colour=ROOF_COLOURS[kind], count=types.count(kind))
            for kind in RoofType
            if kind in types
        ),
        caption=f"From the south, {place}: {len(shown):,} of {len(models):,} models by roof type.",
    )


def _middle(model: RoofModel) -> tuple[float, float]:
    middle = model.footprint.centroid
    return middle.x, middle.y
