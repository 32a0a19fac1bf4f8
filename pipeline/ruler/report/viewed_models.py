"""Models as the faces of a bird's-eye view."""

from __future__ import annotations

import numpy as np
import shapely

from pipeline.model import FaceKind, FloatArray
from pipeline.report.perspective import ViewedFace
from pipeline.report.render import ROOF_COLOURS, WALL_COLOUR
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface


def viewed_faces(model: RoofModel, roof_colour: str | None = None) -> list[ViewedFace]:
    """Roofs and walls of the solids, or roofs alone without solids; by default in the colour of the roof type."""
    roof = roof_colour or ROOF_COLOURS[model.roof_type]
    if not model.solids:
        return [ViewedFace(rings=_lifted(surface), colour=roof) for surface in model.surfaces]
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


def _lifted(surface: RoofSurface) -> tuple[FloatArray, ...]:
    """The rings of a roof face in 3D, counter-clockwise from above, the first vertex not repeated."""
    oriented = shapely.orient_polygons(surface.polygon)
    corners = [shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(oriented)]
    return tuple(np.column_stack([xy, surface.elevation(xy[:, 0], xy[:, 1])]) for xy in corners)
