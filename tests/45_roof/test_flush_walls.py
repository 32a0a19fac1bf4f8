"""Flush walls: one wall where two lie in one plane, and nothing else changes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FaceKind, Plane
from pipeline.quality.validity import check_solid
from pipeline.roof.flush_walls import unite_flush_walls
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import SolidPart, solid_parts


def gable(turn_deg: float, length_mm: float, width_mm: float, rise: float) -> SolidPart:
    """A gable roof over a turned rectangle, its coordinates rounded to the millimetre."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))

    def at(u: float, v: float) -> tuple[int, int]:
        return round(c * u - s * v), round(s * u + c * v)

    half, end = width_mm / 2, length_mm
    sides = [
        shapely.Polygon([at(0, 0), at(end, 0), at(end, half), at(0, half)]),
        shapely.Polygon([at(0, half), at(end, half), at(end, width_mm), at(0, width_mm)]),
    ]
    # exactly level along the rounded ridge, so that both sides meet there
    (xa, ya), (xb, yb) = at(0, half), at(end, half)
    east, north = -(yb - ya) / math.hypot(xb - xa, yb - ya), (xb - xa) / math.hypot(xb - xa, yb - ya)
    ridge_m = 5.0 + rise * half * 1e-3
    planes = [
        Plane(
            a=slope * east,
            b=slope * north,
            c=ridge_m - slope * (east * xa + north * ya) * 1e-3,
            n_points=0,
            rmse_m=0.0,
        )
        for slope in (rise, -rise)
    ]
    (part,) = solid_parts(RoofPartition(polygons=tuple(sides), labels=np.array([0, 1], np.int32)), planes, 0.0)
    return part


def volume(part: SolidPart) -> float:
    """By the divergence theorem over triangle fans."""
    v = part.solid.vertices
    total = 0.0
    for face in part.solid.faces:
        for ring in face.rings:
            for b, c in itertools.pairwise(ring[1:]):
                total += float(np.dot(v[ring[0]], np.cross(v[b], v[c]))) / 6.0
    return total


@settings(deadline=None)
@given(
    st.floats(0.0, 360.0), st.floats(4_000.0, 60_000.0), st.floats(4_000.0, 20_000.0), st.floats(0.1, 1.4)
)  # fmt: skip
def test_a_gable_has_ten_vertices_and_seven_faces_however_it_stands(
    turn_deg: float, length_mm: float, width_mm: float, rise: float
) -> None:
    before = gable(turn_deg, length_mm, width_mm, rise)
    after = unite_flush_walls(before)
    assert len(after.solid.vertices) == 10
    kinds = [face.kind for face in after.solid.faces]
    assert [kinds.count(kind) for kind in (FaceKind.ROOF, FaceKind.WALL, FaceKind.GROUND)] == [2, 4, 1]
    assert check_solid(after.solid) == ()
    assert volume(after) == pytest.approx(volume(before), rel=1e-3)
    assert after.footprint.area == pytest.approx(before.footprint.area, rel=1e-3)
    assert len(after.footprint.exterior.coords) == 5


def test_walls_over_a_step_keep_their_common_edge() -> None:
    sides = (shapely.box(0, 0, 6_000, 8_000), shapely.box(6_000, 0, 12_000, 8_000))
    planes = [Plane(a=0.0, b=0.0, c=z, n_points=0, rmse_m=0.0) for z in (4.0, 7.0)]
    (part,) = solid_parts(RoofPartition(polygons=sides, labels=np.array([0, 1], np.int32)), planes, 0.0)
    united = unite_flush_walls(part)
    assert check_solid(united.solid) == ()
    assert volume(united) == pytest.approx(volume(part))


def test_a_corner_stays_a_corner() -> None:
    hook = shapely.Polygon([(0, 0), (9_000, 0), (9_000, 4_000), (4_000, 4_000), (4_000, 9_000), (0, 9_000)])
    plane = Plane(a=0.0, b=0.0, c=4.0, n_points=0, rmse_m=0.0)
    (part,) = solid_parts(RoofPartition(polygons=(hook,), labels=np.zeros(1, np.int32)), [plane], 0.0)
    assert unite_flush_walls(part) is part
