"""TIN densification after Axelsson (2000): points join the ground that lie close to the TIN of the ground.

A point joins where it is close to the facet that holds it, and at small angles to the facet's vertices. A facet decides
only where its circumcircle lies within reach of the point in question: such a facet is the same in every window that
sees as far, because the triangulation is unique. The vertices are cells of the lattice, at their centres, so the TIN is
exact on small whole numbers.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, LabelArray
from pipeline.terrain.lattice import CELL_MM, Elevations
from pipeline.tin.delaunay import triangulate


@kernel
def _joins_facet(
    x: int, y: int, above: float, cosine: float, corners: tuple[float, ...], z: float, limits: tuple[float, ...]
) -> bool:
    """Whether a point `above` its facet joins the ground: below it, or close and at small angles to its vertices.

    Coordinates in cells and z in mm are relative to the first vertex; `corners` are x, y, z of the other two.
    """
    max_distance, noise, sine = limits
    if above <= 0.0:
        return True
    distance = above * cosine
    if distance > max_distance or distance <= noise:
        return distance <= max_distance
    bx, by, bz, cx, cy, cz = corners
    square = CELL_MM * CELL_MM
    nearest = min(
        square * (x * x + y * y) + z * z,
        square * ((x - bx) ** 2 + (y - by) ** 2) + (z - bz) ** 2,
        square * ((x - cx) ** 2 + (y - cy) ** 2) + (z - cz) ** 2,
    )
    # the angle at a vertex: sin = distance to the plane / distance to the vertex; the nearest one has the largest
    return distance <= sine * math.sqrt(nearest)


@kernel
def _join_facets(
    lowest: Elevations,
    asked: BoolArray,
    judged: BoolArray,
    joined: BoolArray,
    tin: tuple[IntArray, IntArray, LabelArray],
    reach: int,
    limits: tuple[float, float, float],
) -> None:
    """Judge the asked cells by the facets that hold them: mark what was judged, and what joins.

    On an edge between two facets it is enough to join one of them. `tin` holds column and row of the vertices (v,) and
    the facets (m, 3).
    """
    vertex_c, vertex_r, facets = tin
    for f in range(len(facets)):
        p, q, s = facets[f]
        bx, by = vertex_c[q] - vertex_c[p], vertex_r[q] - vertex_r[p]
        cx, cy = vertex_c[s] - vertex_c[p], vertex_r[s] - vertex_r[p]
        area = float(bx * cy - by * cx)
        b2, c2 = float(bx * bx + by * by), float(cx * cx + cy * cy)
        centre_x, centre_y = (cy * b2 - by * c2) / (2.0 * area), (bx * c2 - cx * b2) / (2.0 * area)
        radius = math.sqrt(centre_x * centre_x + centre_y * centre_y)
        if radius > reach:
            continue
        base = float(lowest[vertex_r[p], vertex_c[p]])
        bz, cz = lowest[vertex_r[q], vertex_c[q]] - base, lowest[vertex_r[s], vertex_c[s]] - base
        rise_x, rise_y = (bz * cy - cz * by) / area, (cz * bx - bz * cx) / area
        cosine = 1.0 / math.sqrt(1.0 + (rise_x * rise_x + rise_y * rise_y) / CELL_MM**2)
        corners = (float(bx), float(by), bz, float(cx), float(cy), cz)
        for y in range(min(0, by, cy), max(0, by, cy) + 1):
            for x in range(min(0, bx, cx), max(0, bx, cx) + 1):
                r, c = y + vertex_r[p], x + vertex_c[p]
                if not asked[r, c] or joined[r, c]:
                    continue
                if bx * y < by * x or (cx - bx) * (y - by) < (cy - by) * (x - bx) or cy * x < cx * y:
                    continue
                if abs(centre_x - x) + radius > reach or abs(centre_y - y) + radius > reach:
                    continue
                judged[r, c] = True
                z = lowest[r, c] - base
                joined[r, c] = _joins_facet(x, y, z - rise_x * x - rise_y * y, cosine, corners, z, limits)


def join_facets(
    elevation: Elevations, ground: BoolArray, asked: BoolArray, reach: int, limits: tuple[float, float, float]
) -> tuple[BoolArray, BoolArray]:
    """Judge cells by the TIN of the ground: which join it, and which of them a facet decided on; elevations in mm.

    Parameters
    ----------
    ground, asked : (rows, columns) bool
        The vertices of the TIN, and what is judged; no cell is both.
    reach : int
        Facets decide whose circumcircle lies within this many cells of a point along both axes.
    limits : tuple of float
        Farthest perpendicular distance above a facet in mm; distance in mm up to which angles do not matter; sine of
        the largest angle.
    """
    vertex_r, vertex_c = np.nonzero(ground)
    tin = triangulate(np.column_stack((vertex_c, vertex_r)))
    joined, judged = np.zeros_like(ground), np.zeros_like(ground)
    _join_facets(elevation, asked, judged, joined, (vertex_c, vertex_r, tin.facets), reach, limits)
    return joined, judged
