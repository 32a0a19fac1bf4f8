"""A shaded bird's-eye view of closed solids in parallel projection, drawn by matplotlib's 2D paths.

Solids are closed and oriented outward: faces that look away are left out, the others are painted from far to near,
building by building. Faces with holes are one path each, without triangulation.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb

from pipeline.model import FloatArray
from pipeline.report.pictures import drawn_path

Colour = tuple[float, float, float]

MAP_SUN = (315.0, 50.0)
"""Azimuth and altitude in degrees of the sun over a map: in the north-west, by the convention of cartography."""
VIEW_SUN = (245.0, 48.0)
"""The sun over the bird's-eye view: beside the eye, so visible walls are lit."""
_AMBIENT = 0.5
_SHADOW = "#c9cdc4"
_EDGE_SHARE = 0.72
_GRAZING = 1e-6


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewedFace:
    """A planar face of a solid."""

    rings: tuple[FloatArray, ...]
    """Outer ring and holes, each (n, 3) metres, oriented as seen from outside."""
    colour: str

    def about(self, origin: FloatArray) -> ViewedFace:
        """The same face about an origin (3,)."""
        return dataclasses.replace(self, rings=tuple(ring - origin for ring in self.rings))


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Direction of a view."""

    azimuth_deg: float = 200.0
    """Direction from the scene to the eye, clockwise from north."""
    altitude_deg: float = 42.0


def lambert(normal: Sequence[float] | FloatArray, sun_deg: tuple[float, float]) -> float:
    """Brightness from 0 to 1 of a face, by its outward normal of any length and the sun's azimuth and altitude."""
    azimuth, altitude = (math.radians(angle) for angle in sun_deg)
    sun = (math.sin(azimuth) * math.cos(altitude), math.cos(azimuth) * math.cos(altitude), math.sin(altitude))
    length = math.hypot(*normal)
    lit = sum(n * s for n, s in zip(normal, sun, strict=True)) / length if length > 0.0 else 0.0
    return _AMBIENT + (1.0 - _AMBIENT) * max(0.0, lit)


def shaded(colour: str, brightness: float) -> Colour:
    """A colour in less than full light."""
    red, green, blue = to_rgb(colour)
    return red * brightness, green * brightness, blue * brightness


def face_normal(rings: Sequence[FloatArray]) -> FloatArray:
    """Area vector of a face by its outer ring (Newell), shape (3,)."""
    ring = rings[0] - rings[0][0]
    normal: FloatArray = 0.5 * np.sum(np.cross(ring, np.roll(ring, -1, axis=0)), axis=0)
    return normal


def draw_view(
    axes: Axes,
    models: Sequence[Sequence[ViewedFace]],
    view: View,
    *,
    origin: FloatArray | None = None,
    shadows: bool = True,
) -> None:
    """Draw buildings, each a sequence of faces; the axes become a frameless picture of equal scale.

    Without an `origin` (3,) near the buildings they must lie near the origin of the coordinates.
    """
    right, up, towards = _basis(view)
    buildings = [faces if origin is None else [face.about(origin) for face in faces] for faces in models]
    centres = [np.mean(np.vstack([face.rings[0] for face in faces]), axis=0) for faces in buildings]
    order = sorted(range(len(buildings)), key=lambda i: (float(centres[i][:2] @ towards[:2]), i))
    screen = np.stack([right, up])
    if shadows:
        thrown = [drawn_path([ring @ screen.T for ring in rings]) for faces in buildings for rings in _shadow(faces)]
        axes.add_collection(PathCollection(thrown, facecolors=_SHADOW, edgecolors=_SHADOW, linewidths=0.3))
    paths = []
    fills: list[Colour] = []
    lines: list[Colour] = []
    for index in order:
        visible = []
        for face in buildings[index]:
            normal = face_normal(face.rings)
            if float(normal @ towards) > _GRAZING * math.hypot(*normal):
                visible.append((float(np.mean(face.rings[0] @ towards)), face, normal))
        for _, face, normal in sorted(visible, key=lambda entry: entry[0]):
            paths.append(drawn_path([ring @ screen.T for ring in face.rings]))
            fill = shaded(face.colour, lambert(normal, VIEW_SUN))
            fills.append(fill)
            lines.append((fill[0] * _EDGE_SHARE, fill[1] * _EDGE_SHARE, fill[2] * _EDGE_SHARE))
    axes.add_collection(PathCollection(paths, facecolors=fills, edgecolors=lines, linewidths=0.4, zorder=2))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()


def projected(xyz: FloatArray, view: View) -> FloatArray:
    """Screen coordinates (n, 2), metres to the right and up, of points (n, 3), as in `draw_view`."""
    right, up, _ = _basis(view)
    return xyz @ np.stack([right, up]).T


def _basis(view: View) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit vectors to the right and up on the screen, and towards the eye."""
    azimuth, altitude = math.radians(view.azimuth_deg), math.radians(view.altitude_deg)
    towards = np.array(
        [math.sin(azimuth) * math.cos(altitude), math.cos(azimuth) * math.cos(altitude), math.sin(altitude)]
    )
    right = np.array([-math.cos(azimuth), math.sin(azimuth), 0.0])
    return right, np.cross(towards, right), towards


def _shadow(faces: Sequence[ViewedFace]) -> list[list[FloatArray]]:
    """The shadows of the faces on the level of the lowest point of the building."""
    ground = min(float(ring[:, 2].min()) for face in faces for ring in face.rings)
    azimuth, altitude = (math.radians(angle) for angle in VIEW_SUN)
    slip = np.array([-math.sin(azimuth), -math.cos(azimuth)]) / math.tan(altitude)
    thrown = []
    for face in faces:
        rings = []
        for ring in face.rings:
            flat = np.array(ring)
            flat[:, :2] += (ring[:, 2:] - ground) * slip
            flat[:, 2] = ground
            rings.append(flat)
        thrown.append(rings)
    return thrown
