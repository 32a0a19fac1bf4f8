"""Models as pictures: bird's-eye views, and the true outlines, points and scale bars of plans."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from pipeline.model import FaceKind, FloatArray, RoofType
from pipeline.report.maps import Entry, round_length
from pipeline.report.palette import ROOF_COLOURS
from pipeline.report.perspective import View, ViewedFace, draw_view, projected
from pipeline.report.pictures import blank, plan_rings, png_of, set_frame
from pipeline.report.render import VIEW_SIDE_M, WALL_COLOUR, view_window
from pipeline.ruler.evaluation.models import RoofModel

TRUTH_COLOUR = "#2a9470"
WIDTH_PX = 1500
"""Width of the view of all models."""
_HEIGHTS_PX = (450, 1050)


def viewed_faces(model: RoofModel, roof_colour: str | None = None) -> list[ViewedFace]:
    """Roofs and walls of the solids, or roofs alone without solids; by default in the colour of the roof type."""
    roof = roof_colour or ROOF_COLOURS[model.roof_type]
    if not model.solids:
        polygons = [shapely.orient_polygons(surface.polygon) for surface in model.surfaces]
        rings = [[ring[:-1] for ring in plan_rings(polygon)] for polygon in polygons]
        return [
            ViewedFace(
                rings=tuple(np.column_stack([xy, surface.elevation(xy[:, 0], xy[:, 1])]) for xy in of_surface),
                colour=roof,
            )
            for surface, of_surface in zip(model.surfaces, rings, strict=True)
        ]
    origin = np.array(model.solid_origin)
    return [
        ViewedFace(
            rings=tuple(solid.vertices[list(ring)] + origin for ring in face.rings),
            colour=roof if face.kind is FaceKind.ROOF else WALL_COLOUR,
        )
        for solid in model.solids
        for face in solid.faces
        if face.kind is not FaceKind.GROUND
    ]


def corners_of(buildings: Sequence[Sequence[ViewedFace]]) -> FloatArray:
    """All corners of some buildings, (n, 3)."""
    return np.concatenate([np.zeros((0, 3)), *(ring for faces in buildings for face in faces for ring in face.rings)])


def view_png(
    buildings: Sequence[Sequence[ViewedFace]], shown: FloatArray, size_px: tuple[int, int], view: View | None = None
) -> bytes | None:
    """Buildings in a view that shows all of some places (n, 3); None without a face."""
    view = view or View()
    drawn = [faces for faces in buildings if faces]
    if not drawn:
        return None
    figure, axes = blank(*size_px)
    origin = np.floor(shown.min(axis=0))
    draw_view(axes, drawn, view, origin=origin, shadows=False)
    set_frame(axes, projected(shown - origin, view))
    return png_of(figure)


def draw_true_edges(axes: Axes, truth: RoofModel, origin: FloatArray, width: float) -> None:
    """The edges of the true roof faces, else the true outline, dashed, about an origin (>= 2,)."""
    outlines = [surface.polygon for surface in truth.surfaces] or [truth.footprint]
    rings = [ring - origin[:2] for outline in outlines for ring in plan_rings(outline)]
    lines = LineCollection(rings, colors=TRUTH_COLOUR, linewidths=width, linestyles=(0, (5, 2.5)), zorder=5)
    axes.add_collection(lines)


def scale_bar(width_m: float) -> tuple[float, float]:
    """Length of a bar of about a third of a picture, metres, and its share of the width."""
    length_m = round_length(width_m / 3.0)
    return length_m, length_m / width_m


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelsView:
    """A bird's-eye view of models that are measured without a reference, with its words."""

    png: bytes
    width_px: int
    height_px: int
    legend: tuple[Entry, ...]
    caption: str


def models_view(models: Sequence[RoofModel]) -> ModelsView | None:
    """All models if they lie close together, else those in the square with the most roof faces; None without faces."""
    faces = np.array([surface.polygon for model in models for surface in model.surfaces], dtype=object)
    window, is_part = view_window(faces, 1.0)
    middles = shapely.centroid([model.footprint for model in models])
    inside = shapely.intersects(middles, shapely.box(*window))
    shown = [model for model, is_in in zip(models, inside, strict=True) if is_in and model.surfaces]
    if not shown:
        return None
    drawn, limits = blank(WIDTH_PX, WIDTH_PX)
    draw_view(limits, [viewed_faces(model) for model in shown], View(), origin=np.array([*window[:2], 0.0]))
    (west, east), (south, north) = limits.get_xlim(), limits.get_ylim()
    height_px = int(np.clip(round(WIDTH_PX * (north - south) / (east - west)), *_HEIGHTS_PX))
    drawn.set_size_inches(WIDTH_PX / 100.0, height_px / 100.0)
    types = [model.roof_type for model in shown]
    place = f"the square of {VIEW_SIDE_M:g} m with the most roof faces" if is_part else "all models"
    kinds = [kind for kind in RoofType if kind in types]
    return ModelsView(
        png=png_of(drawn),
        width_px=WIDTH_PX,
        height_px=height_px,
        legend=tuple(Entry(label=kind.value, colour=ROOF_COLOURS[kind], count=types.count(kind)) for kind in kinds),
        caption=f"From the south, {place}: {len(shown):,} of {len(models):,} models by roof type.",
    )
