"""The roof planes of a tile in local metres: their faces' edges, their normals, and the points that look at the sky."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import shapely

from pipeline.model import BoolArray, FloatArray, IntArray

LIFT_M = 0.01
"""Height of a sampled point above its plane: corners are rounded to 1 mm, and their own face must not shade it."""
_MOST_COLUMNS = 64
"""Bound of a lattice of samples along each axis; a sliver across its box would need thousands."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofPlanes:
    """Roof planes in metres of the run's CRS, sorted by building."""

    faces: Any
    """(n,) polygons or multipolygons with z, None where a plane has no face."""
    building: IntArray
    """(n,) number of each plane's building, in order."""
    slope_deg: FloatArray
    """(n,) true slopes."""
    aspect_deg: FloatArray
    """(n,) directions of steepest descent, clockwise from grid north."""
    through: FloatArray
    """(n, 3) a point of each plane."""

    @property
    def bounds(self) -> FloatArray:
        """Smallest x and y, largest x and y of all faces; nan without faces."""
        found: FloatArray = shapely.total_bounds(self.faces)
        return found

    def turned(self, centre: FloatArray, convergence_deg: float) -> RoofPlanes:
        """The planes around a local origin (3,), turned so that y points to true north.

        `convergence_deg` is the azimuth of grid north: turning by it brings grid north where it truly points.
        """
        angle = np.radians(convergence_deg)
        cos, sin = np.cos(angle), np.sin(angle)

        def move(xyz: FloatArray) -> FloatArray:
            x, y, z = (xyz - centre).T
            found: FloatArray = np.column_stack([cos * x + sin * y, cos * y - sin * x, z])
            return found

        return RoofPlanes(
            faces=shapely.transform(self.faces, move, include_z=True),
            building=self.building,
            slope_deg=self.slope_deg,
            aspect_deg=(self.aspect_deg + convergence_deg) % 360.0,
            through=move(self.through),
        )

    @property
    def normals(self) -> FloatArray:
        """(n, 3) unit normals, up."""
        slope, aspect = np.radians(self.slope_deg), np.radians(self.aspect_deg)
        found: FloatArray = np.column_stack(
            [np.sin(slope) * np.sin(aspect), np.sin(slope) * np.cos(aspect), np.cos(slope)]
        )
        return found

    def samples(self, about: int) -> tuple[FloatArray, IntArray]:
        """About so many points of each plane on a lattice in plan, at least one where it has a face, and their planes.

        Returns (m, 3) points, `LIFT_M` above the planes, and (m,) numbers of planes, in order.
        """
        present = np.flatnonzero(~(shapely.is_missing(self.faces) | shapely.is_empty(self.faces)))
        faces = shapely.force_2d(self.faces[present])
        shapely.prepare(faces)
        x0, y0, x1, y1 = shapely.bounds(faces).reshape(-1, 4).T
        step = np.maximum(np.sqrt(shapely.area(faces) / about), 1e-6)
        columns, rows = (np.clip(np.ceil(size / step), 1, _MOST_COLUMNS).astype(int) for size in (x1 - x0, y1 - y0))
        owner = np.repeat(np.arange(len(faces)), columns * rows)
        cell = np.arange(len(owner)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
        x = x0[owner] + (cell % columns[owner] + 0.5) * ((x1 - x0) / columns)[owner]
        y = y0[owner] + (cell // columns[owner] + 0.5) * ((y1 - y0) / rows)[owner]
        inside: BoolArray = shapely.contains_xy(faces[owner], x, y)
        without = np.setdiff1d(np.arange(len(faces)), owner[inside])
        spare = shapely.get_coordinates(shapely.point_on_surface(faces[without])).reshape(-1, 2)
        owner = np.concatenate([owner[inside], without])
        xy = np.concatenate([np.column_stack([x, y])[inside], spare])
        order = np.argsort(owner, kind="stable")
        planes, xy = present[owner[order]], xy[order]
        normal, through = self.normals[planes], self.through[planes]
        z = through[:, 2] - ((xy - through[:, :2]) * normal[:, :2]).sum(axis=1) / normal[:, 2]
        return np.column_stack([xy, z + LIFT_M]), planes

    def edges(self) -> tuple[FloatArray, IntArray]:
        """The edges of all faces, those between two faces of a building once.

        Returns (m, 6) ends x, y, z, x, y, z and (m,) numbers of buildings, in order.
        """
        polygons, plane = shapely.get_parts(self.faces, return_index=True)
        rings, part = shapely.get_rings(polygons, return_index=True)
        owner = plane[part]
        xyz, ring = shapely.get_coordinates(rings, include_z=True, return_index=True)
        follows = ring[1:] == ring[:-1]
        start, end = xyz[:-1][follows], xyz[1:][follows]
        building = self.building[owner[ring[1:][follows]]] if len(ring) else np.zeros(0, np.int64)
        swapped = (start[:, 0] > end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] > end[:, 1]))
        start, end = np.where(swapped[:, None], end, start), np.where(swapped[:, None], start, end)
        found = np.column_stack([start, end])
        order = np.lexsort((*found.T[::-1], building))
        found, building = found[order], building[order]
        new = np.ones(len(found), bool)
        new[1:] = (found[1:] != found[:-1]).any(axis=1) | (building[1:] != building[:-1])
        return found[new], building[new]
