"""Flush walls: one wall where two lie in one plane, and nothing else changes."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import shapely
from faces_by_hand import plane
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.extras.papers.flush_walls import unite_flush_walls
from pipeline.model import FaceKind, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import SolidPart, solid_parts

Volume = Callable[[Solid], float]


def part_over(polygons: Sequence[shapely.Polygon], planes: Sequence[tuple[float, float, float]]) -> SolidPart:
    """The one solid over faces in millimetres."""
    partition = RoofPartition(polygons=tuple(polygons), labels=np.arange(len(polygons), dtype=np.int32))
    (part,) = solid_parts(partition, [plane(*row) for row in planes], 0.0)
    return part


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
    along = (east * xa + north * ya) * 1e-3
    return part_over(sides, [(slope * east, slope * north, ridge_m - slope * along) for slope in (rise, -rise)])


@settings(deadline=None)
@given(
    st.floats(0.0, 360.0), st.floats(4_000.0, 60_000.0), st.floats(4_000.0, 20_000.0), st.floats(0.1, 1.4)
)  # fmt: skip
def test_a_gable_has_ten_vertices_and_seven_faces_however_it_stands(
    volume: Volume, turn_deg: float, length_mm: float, width_mm: float, rise: float
) -> None:
    before = gable(turn_deg, length_mm, width_mm, rise)
    after = unite_flush_walls(before)
    assert len(after.solid.vertices) == 10
    kinds = [face.kind for face in after.solid.faces]
    assert [kinds.count(kind) for kind in (FaceKind.ROOF, FaceKind.WALL, FaceKind.GROUND)] == [2, 4, 1]
    assert check_solid(after.solid) == ()
    assert volume(after.solid) == pytest.approx(volume(before.solid), rel=1e-3)
    assert after.footprint.area == pytest.approx(before.footprint.area, rel=1e-3)
    assert len(after.footprint.exterior.coords) == 5


def test_walls_over_a_step_keep_their_common_edge(volume: Volume) -> None:
    sides = (shapely.box(0, 0, 6_000, 8_000), shapely.box(6_000, 0, 12_000, 8_000))
    part = part_over(sides, [(0.0, 0.0, 4.0), (0.0, 0.0, 7.0)])
    united = unite_flush_walls(part)
    assert check_solid(united.solid) == ()
    assert volume(united.solid) == pytest.approx(volume(part.solid))


def test_a_corner_stays_a_corner() -> None:
    hook = shapely.Polygon([(0, 0), (9_000, 0), (9_000, 4_000), (4_000, 4_000), (4_000, 9_000), (0, 9_000)])
    part = part_over([hook], [(0.0, 0.0, 4.0)])
    assert unite_flush_walls(part) is part
