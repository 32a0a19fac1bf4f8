"""The raster of two roofs against the exact integral over the pieces in which their faces overlap, and its details."""

import numpy as np
import pytest
import shapely
import shapely.affinity
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.ruler.epochs.roof_raster import (
    ADDED_M2,
    COMMON_M2,
    DIFFERENCE_M,
    FORM_M2,
    GAINED_M3,
    LOST_M3,
    MAX_RAISE_M,
    MEDIAN_M,
    RAISED_M2,
    REMOVED_M2,
    ROUGH_M2,
    SHIFT_M,
    UNIFORM_M,
    RoofFaces,
    RoofGroups,
    compare_roofs,
)

Face = tuple[shapely.Polygon, tuple[float, float, float]]
"""Outline, and the plane z = a x + b y + c over it."""
WIDTH_M = 0.5


def faces_of(faces: list[Face], rough: list[bool] | None = None) -> RoofFaces:
    rings = [ring for polygon, _ in faces for ring in shapely.get_rings(polygon)]
    corners = [shapely.get_coordinates(ring) for ring in rings]
    return RoofFaces(
        xy=np.concatenate(corners),
        rings=np.concatenate([[0], np.cumsum([len(ring) for ring in corners])]).astype(np.int64),
        faces=np.concatenate([[0], np.cumsum([1 + len(polygon.interiors) for polygon, _ in faces])]).astype(np.int64),
        planes=np.array([(0.0, 0.0, c, a, b) for _, (a, b, c) in faces]),
        is_rough=np.array(rough or [False] * len(faces)),
    )


def figures(
    old: list[Face],
    new: list[Face],
    *,
    guests: tuple[list[Face], list[Face]] = ([], []),
    width_m: float = WIDTH_M,
    min_m: float = 0.5,
    shift_m: float = 0.0,
    rough_new: bool = False,
) -> np.ndarray:
    entries = [*((f, False, True) for f in old), *((f, True, True) for f in new)]
    entries += [*((f, False, False) for f in guests[0]), *((f, True, False) for f in guests[1])]
    own = [polygon for (polygon, _), _, mine in entries if mine]
    groups = RoofGroups(
        starts=np.array([0, len(entries)]),
        face=np.arange(len(entries)),
        is_new=np.array([new for _, new, _ in entries]),
        is_own=np.array([mine for _, _, mine in entries]),
        boxes=shapely.total_bounds(own)[None, :],
        width_m=np.array([width_m]),
        height_m=np.array([min_m]),
        ground_m=np.zeros((1, 2)),
    )
    faces = faces_of([face for face, _, _ in entries], [new and rough_new for _, new, _ in entries])
    return compare_roofs(faces, groups, 0.9, shift_m)[0]


def exact_absolute_integral(old: list[Face], new: list[Face]) -> float:
    """The integral of the absolute difference: pieces of two faces, cut where the planes cross, prisms summed."""
    total = 0.0
    for first, (a, b, c) in old:
        for second, (d, e, f) in new:
            piece = first.intersection(second)
            rise = (d - a, e - b, f - c)
            for part in (half(piece, rise), half(piece, tuple(-v for v in rise))):
                if not part.is_empty:
                    middle = part.centroid
                    total += abs(rise[0] * middle.x + rise[1] * middle.y + rise[2]) * part.area
    return total


def half(piece: shapely.Geometry, rise: tuple[float, ...]) -> shapely.Geometry:
    """Where a linear function is not negative."""
    a, b, c = rise
    values = [a * x + b * y + c for x, y in shapely.get_coordinates(piece)]
    if min(values, default=0.0) >= 0.0:
        return piece
    if max(values) <= 0.0:
        return shapely.Polygon()
    length = np.hypot(a, b)
    foot, along = -c * np.array([a, b]) / length**2, np.array([-b, a]) / length * 1e3
    up = np.array([a, b]) / length * 1e3
    side = shapely.Polygon([foot - along, foot + along, foot + along + up, foot - along + up])
    return piece.intersection(side)


def gable(x: float, y: float, length: float, width: float, eave: float, rise: float) -> list[Face]:
    """Two faces whose ridge runs along x."""
    slope, middle = rise / (width / 2.0), y + width / 2.0
    return [
        (shapely.box(x, y, x + length, middle), (0.0, slope, eave - slope * y)),
        (shapely.box(x, middle, x + length, y + width), (0.0, -slope, eave + slope * (y + width))),
    ]


@settings(max_examples=examples(40), deadline=None)
@given(
    st.floats(6.0, 14.0),
    st.floats(6.0, 12.0),
    st.floats(2.0, 6.0),
    st.floats(0.0, 4.0),
    st.floats(2.0, 6.0),
    st.floats(0.0, 4.0),
)
def test_the_mean_difference_is_that_of_the_exact_integral(
    length: float, width: float, eave: float, rise: float, other_eave: float, other_rise: float
) -> None:
    old, new = gable(0.0, 0.0, length, width, eave, rise), gable(0.0, 0.0, length, width, other_eave, other_rise)
    found = figures(old, new)
    exact = exact_absolute_integral(old, new) / (length * width)
    assert found[DIFFERENCE_M] == pytest.approx(exact, abs=0.02)
    assert found[COMMON_M2] == pytest.approx(length * width, rel=0.03)


def test_holes_stay_open_and_the_highest_face_counts() -> None:
    court = shapely.box(0, 0, 20, 20).difference(shapely.box(5, 5, 15, 15))
    found = figures([(court, (0.0, 0.0, 6.0))], [(court, (0.0, 0.0, 6.0)), (shapely.box(0, 0, 5, 20), (0.0, 0.0, 9.0))])
    assert found[COMMON_M2] == pytest.approx(300.0, rel=0.01)
    assert found[RAISED_M2] == pytest.approx(100.0, rel=0.02)
    assert found[MAX_RAISE_M] == pytest.approx(3.0)
    assert found[MEDIAN_M] == found[UNIFORM_M] == found[SHIFT_M] == 0.0


def test_a_shift_of_the_whole_is_no_other_form() -> None:
    found = figures(gable(0, 0, 12, 9, 5, 3), gable(0, 0, 12, 9, 7.5, 3))
    assert [found[SHIFT_M], found[MEDIAN_M]] == pytest.approx([2.5, 2.5])
    assert found[FORM_M2] == 0.0
    assert found[GAINED_M3] == pytest.approx(2.5 * 108.0, rel=0.03)
    same = figures(gable(0, 0, 12, 9, 5, 3), gable(0, 0, 12, 9, 7.5, 3), shift_m=2.5)
    assert (same[SHIFT_M], same[GAINED_M3], same[LOST_M3]) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("turn", [0.0, 22.5, 45.0])
def test_parts_count_by_their_width_whatever_their_direction(turn: float) -> None:
    def turned(face: Face) -> Face:
        return shapely.affinity.rotate(face[0], turn, origin=(0, 0)), face[1]

    old = [turned((shapely.box(0, 0, 10, 20), (0.0, 0.0, 5.0)))]
    for width_m, counts in ((1.0, False), (2.2, True)):
        new = [turned((shapely.box(0, 0, 10 + width_m, 20), (0.0, 0.0, 5.0)))]
        found = figures(old, new, width_m=1.5)
        assert (found[ADDED_M2] > 0.0) == counts
        if counts:
            assert found[ADDED_M2] == pytest.approx(20.0 * width_m, rel=0.12)
            assert found[GAINED_M3] == pytest.approx(5.0 * found[ADDED_M2])


def test_what_a_neighbour_covers_is_neither_added_nor_removed() -> None:
    level = (0.0, 0.0, 5.0)
    old, new = [(shapely.box(0, 0, 10, 10), level)], [(shapely.box(0, 0, 13, 10), level)]
    alone, beside = figures(old, new), figures(old, new, guests=([(shapely.box(10, 0, 20, 10), level)], []))
    assert alone[ADDED_M2] == pytest.approx(30.0, rel=0.05)
    assert (beside[ADDED_M2], beside[REMOVED_M2], beside[FORM_M2]) == (0.0, 0.0, 0.0)
    assert beside[COMMON_M2] == pytest.approx(130.0, rel=0.02)


def test_parts_on_rough_faces_are_counted() -> None:
    old = [(shapely.box(0, 0, 10, 10), (0.0, 0.0, 5.0))]
    new = [(shapely.box(0, 0, 14, 10), (0.0, 0.0, 5.0))]
    found = figures(old, new, rough_new=True)
    assert found[ROUGH_M2] == found[ADDED_M2] > 30.0
    assert figures(old, new)[ROUGH_M2] == 0.0


def test_epochs_without_a_common_roof_have_no_difference() -> None:
    found = figures([(shapely.box(0, 0, 5, 5), (0, 0, 3.0))], [(shapely.box(8, 0, 13, 5), (0, 0, 3.0))])
    assert np.isnan(found[MEDIAN_M])
    assert found[COMMON_M2] == 0.0
    assert found[ADDED_M2] == pytest.approx(25.0, rel=0.1)
    assert found[REMOVED_M2] == pytest.approx(25.0, rel=0.1)


def test_a_very_large_roof_takes_larger_cells_and_not_all_the_memory() -> None:
    hall = shapely.box(0, 0, 3000, 2000)
    found = figures([(hall, (0.0, 0.0, 8.0))], [(hall, (0.0, 0.0, 10.0))], width_m=0.5)
    assert found[COMMON_M2] == pytest.approx(6e6, rel=0.01)
    assert found[MEDIAN_M] == pytest.approx(2.0)
