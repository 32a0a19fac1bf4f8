"""Greedy insertion with noise absorption."""

import dataclasses
import math

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.model import FloatArray, Tin
from pipeline.segmentation.facet_geometry import facet_normals
from pipeline.tin.delaunay import triangulate
from pipeline.tin.greedy_insertion import GreedyInsertionSettings, GreedyTin, insert_greedily

Point = tuple[int, int]

BUCKET = GreedyInsertionSettings()
INSERT = GreedyInsertionSettings(absorption="insert")


def exact_orientation(a: Point, b: Point, c: Point) -> int:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@dataclasses.dataclass
class SlowTin:
    """What the twin found, by positions in millimetres."""

    facets: set[tuple[Point, ...]]
    z_mm: dict[Point, float]
    facet_of: dict[Point, tuple[Point, ...]]
    absorbed: set[Point]


def slow_greedy(points_mm: list[tuple[int, int, int]], rules: GreedyInsertionSettings, corner_z_mm: int) -> SlowTin:
    """Slow twin: at every step a new triangulation, and all errors of all unused points anew."""
    z: dict[Point, float] = {}
    for u, v, h in points_mm:
        z[u, v] = float(max(h, z.get((u, v), h)))
    margin = round(rules.margin_m * 1000)
    us, vs = [u for u, _ in z], [v for _, v in z]
    west, east, south, north = min(us) - margin, max(us) + margin, min(vs) - margin, max(vs) + margin
    used: list[Point] = [(west, south), (east, south), (east, north), (west, north)]
    unused = sorted(z)
    z.update(dict.fromkeys(used, float(corner_z_mm)))
    absorbed: set[Point] = set()
    while True:
        tin = triangulate(np.array(used))
        facets = [tuple(used[v] for v in facet) for facet in tin.facets]
        home: dict[Point, tuple[Point, ...]] = {}
        best: tuple[float, Point] | None = None
        for p in unused:
            owners = []
            for facet in facets:
                edges = zip(facet, facet[1:] + facet[:1], strict=True)
                turns = [(exact_orientation(a, b, p), a < b) for a, b in edges]
                if all(turn > 0 or (turn == 0 and ascending) for turn, ascending in turns):
                    owners.append(facet)
            assert len(owners) == 1
            home[p] = tuple(sorted(owners[0]))
            error, height, is_near = slow_error(owners[0], p, z, rules)
            if is_near and rules.absorption == "bucket":
                continue
            if best is None or (-error, p) < (-best[0], best[1]):
                best = (error, p)
                becomes = height if is_near else z[p]
                is_absorbed = is_near
        if best is None:
            return SlowTin({tuple(sorted(f)) for f in facets}, z, home, absorbed | set(home))
        p = best[1]
        unused.remove(p)
        used.append(p)
        z[p] = becomes
        if is_absorbed:
            absorbed.add(p)


def slow_error(
    facet: tuple[Point, ...], p: Point, z: dict[Point, float], rules: GreedyInsertionSettings
) -> tuple[float, float, bool]:
    """Vertical error, elevation of the facet, and whether the facet absorbs the point."""
    k = facet.index(min(facet))
    a, b, c = facet[k:] + facet[:k]
    ux, uy, uz = b[0] - a[0], b[1] - a[1], z[b] - z[a]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], z[c] - z[a]
    area = ux * vy - uy * vx
    gx, gy = (uz * vy - vz * uy) / area, (ux * vz - vx * uz) / area
    height = z[a] + gx * (p[0] - a[0]) + gy * (p[1] - a[1])
    error = abs(z[p] - height)
    steepness = gx * gx + gy * gy
    near = error <= rules.absorption_distance_m * 1000.0 * math.sqrt(1.0 + steepness)
    return error, height, near and steepness <= math.tan(math.radians(rules.absorption_slope_deg)) ** 2


def positions(greedy: GreedyTin) -> list[Point]:
    return [(int(u), int(v)) for u, v in np.rint(greedy.vertices[:, :2] * 1000)]


def assert_equals_the_twin(points_mm: list[tuple[int, int, int]], rules: GreedyInsertionSettings, corner: int) -> None:
    points_m = np.array(points_mm) / 1000.0
    greedy = insert_greedily(points_m, rules, corner / 1000.0)
    slow = slow_greedy(points_mm, rules, corner)
    where = positions(greedy)
    facets = [tuple(sorted(where[v] for v in facet)) for facet in greedy.tin.facets]
    assert set(facets) == slow.facets
    for p, height in zip(where, greedy.vertices[:, 2], strict=True):
        assert height * 1000 == pytest.approx(slow.z_mm[p], abs=1e-9)
    highest = {(u, v): max(h for a, b, h in points_mm if (a, b) == (u, v)) for u, v, _ in points_mm}
    taken: set[Point] = set()
    for i, (u, v, h) in enumerate(points_mm):
        if (u, v) in taken or h < highest[u, v]:
            # beneath another one: in its facet, or in the first one at its vertex
            at_vertex = next((t for t, facet in enumerate(facets) if (u, v) in facet), None)
            expected = slow.facet_of[u, v] if at_vertex is None else facets[at_vertex]
            assert facets[greedy.facet_of_point[i]] == expected
            assert not greedy.absorbed[i]
            continue
        taken.add((u, v))
        assert greedy.absorbed[i] == ((u, v) in slow.absorbed)
        if (u, v) in slow.facet_of:
            assert facets[greedy.facet_of_point[i]] == slow.facet_of[u, v]
        else:
            assert greedy.facet_of_point[i] == -1
            assert i in greedy.vertex_point


lattice_points = st.lists(
    st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(0, 8)).map(
        lambda p: (p[0] * 1000, p[1] * 1000, p[2] * 100)
    ),
    min_size=1,
    max_size=16,
)


@settings(max_examples=examples(150), deadline=None)
@given(lattice_points, st.sampled_from(["bucket", "insert"]), st.sampled_from([0.0, 0.2, 0.5]), st.integers(0, 1))
def test_it_equals_the_slow_twin_on_lattices_full_of_ties(
    points_mm: list[tuple[int, int, int]], absorption: str, distance_m: float, corner_m: int
) -> None:
    rules = GreedyInsertionSettings(absorption=absorption, absorption_distance_m=distance_m)
    assert_equals_the_twin(points_mm, rules, corner_m * 1000)


@pytest.mark.parametrize("absorption", ["bucket", "insert"])
@pytest.mark.parametrize("seed", range(4))
def test_it_equals_the_slow_twin_on_a_noisy_gable(absorption: str, seed: int) -> None:
    points_m = gable(60, 0.05, seed)
    points_mm = [(int(u), int(v), int(h)) for u, v, h in np.rint(points_m * 1000)]
    assert_equals_the_twin(points_mm, GreedyInsertionSettings(absorption=absorption), 0)


def gable(n: int, noise_m: float, seed: int, slope_deg: float = 30.0) -> FloatArray:
    """A gable roof of 12 m x 8 m, ridge along x, eaves at 4 m, with points on the ground around it."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-3, 15, n), rng.uniform(-3, 11, n)
    on_roof = (u >= 0) & (u <= 12) & (v >= 0) & (v <= 8)
    roof_z = 4 + math.tan(math.radians(slope_deg)) * (4 - np.abs(v - 4))
    return np.round(np.column_stack((u, v, np.where(on_roof, roof_z, 0.0) + rng.normal(0, noise_m, n))), 3)


def assert_sound(greedy: GreedyTin, points: FloatArray) -> None:
    """The TIN is the Delaunay triangulation of its vertices, and every point is where the record says."""
    xy = np.rint(greedy.vertices[:, :2] * 1000).astype(np.int64)
    expected = triangulate(xy)
    np.testing.assert_array_equal(greedy.tin.facets, expected.facets)
    np.testing.assert_array_equal(greedy.tin.neighbours, expected.neighbours)
    of_points = greedy.vertex_point[4:]
    assert (greedy.vertex_point[:4] == -1).all()
    assert (np.diff(of_points) > 0).all()
    np.testing.assert_array_equal(greedy.vertices[4:, :2], points[of_points, :2])
    inserted = greedy.facet_of_point < 0
    np.testing.assert_array_equal(np.flatnonzero(inserted), of_points)
    kept_z = ~greedy.absorbed[of_points]
    np.testing.assert_array_equal(greedy.vertices[4:][kept_z, 2], points[of_points[kept_z], 2])
    outside = np.flatnonzero(~inserted)
    corners = greedy.vertices[greedy.tin.facets[greedy.facet_of_point[outside]]]
    p = points[outside]
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        turn = (b[:, 0] - a[:, 0]) * (p[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (p[:, 0] - a[:, 0])
        assert (turn > -1e-9).all()


@pytest.mark.parametrize("rules", [BUCKET, INSERT], ids=["bucket", "insert"])
def test_the_tin_is_exactly_delaunay_and_every_point_is_accounted_for(rules: GreedyInsertionSettings) -> None:
    points = gable(3_000, 0.05, seed=1)
    points = np.concatenate((points, points[:50] - np.array([0, 0, 1.0])))
    assert_sound(insert_greedily(points, rules, 0.0), points)


def test_a_raster_of_cocircular_cells_is_sound() -> None:
    u, v = np.meshgrid(np.arange(40) * 0.5, np.arange(30) * 0.5)
    z = np.round(np.maximum(0, 5 - np.hypot(u - 10, v - 7)), 3)
    points = np.stack((u, v, z), -1).reshape(-1, 3)
    assert_sound(insert_greedily(points, BUCKET, 0.0), points)


def test_what_is_left_in_the_buckets_would_be_absorbed() -> None:
    points = gable(4_000, 0.08, seed=2)
    greedy = insert_greedily(points, BUCKET, 0.0)
    left = np.flatnonzero(greedy.facet_of_point >= 0)
    np.testing.assert_array_equal(left, np.flatnonzero(greedy.absorbed))
    assert 0.6 < len(left) / len(points) < 0.99
    normals = facet_normals(greedy.vertices, greedy.tin.facets)[greedy.facet_of_point[left]]
    on_facet = greedy.vertices[greedy.tin.facets[greedy.facet_of_point[left], 0]]
    distance = np.abs(((points[left] - on_facet) * normals).sum(axis=1))  # Eq. 1
    assert distance.max() <= 0.2 + 1e-9
    assert np.degrees(np.arccos(normals[:, 2])).max() <= 60 + 1e-9


def test_absorption_measures_perpendicular_to_the_facet() -> None:
    # a facet of 45 degrees; its absorption reaches 0.2 * sqrt(2) = 0.2828 m vertically
    plane = np.array([[0.0, 0, 0], [10, 0, 10], [10, 10, 10], [0, 10, 0]])
    for above, is_absorbed in ((0.282, True), (0.284, False)):
        points = np.vstack((plane, [[5.0, 4.0, 5 + above]]))
        greedy = insert_greedily(points, GreedyInsertionSettings(margin_m=0.001), 0.0)
        assert greedy.absorbed[4] == is_absorbed


def test_facets_steeper_than_the_limit_absorb_nothing() -> None:
    rules = GreedyInsertionSettings(margin_m=0.001)
    for slope_deg, is_absorbed in ((59.0, True), (61.0, False)):
        rise = round(10 * math.tan(math.radians(slope_deg)), 3)
        points = np.array([[0.0, 0, 0], [10, 0, rise], [10, 10, rise], [0, 10, 0], [5, 4, rise / 2]])
        points[4, 2] = round(points[4, 2], 3)
        assert insert_greedily(points, rules, 0.0).absorbed[4] == is_absorbed


def test_an_absorbed_point_that_is_inserted_lies_on_its_facet() -> None:
    points = np.array([[0.0, 0, 5], [10, 0, 5], [10, 10, 5], [0, 10, 5], [5, 4, 4.85]])
    greedy = insert_greedily(points, INSERT, 0.0)
    assert greedy.absorbed.tolist() == [False, False, False, False, True]
    assert greedy.vertices[4:, 2].tolist() == [5, 5, 5, 5, 5]
    assert (greedy.facet_of_point == -1).all()
    assert len(insert_greedily(points, BUCKET, 0.0).vertices) == 8


def test_the_worst_point_is_inserted_first() -> None:
    # the peak alone explains the tent, so nothing else is inserted
    u, v = np.meshgrid(np.arange(1.0, 20), np.arange(1.0, 20))
    z = 6 - 0.25 * np.maximum(np.abs(u - 10), np.abs(v - 10))
    points = np.round(np.stack((u, v, z), -1).reshape(-1, 3), 3)
    greedy = insert_greedily(points, GreedyInsertionSettings(margin_m=1.0, absorption_distance_m=0.01), 3.5)
    assert greedy.vertices[4:].tolist() == [[10, 10, 6]]


@settings(max_examples=examples(40), deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["bucket", "insert"]), st.booleans())
def test_the_order_of_points_changes_nothing(seed: int, absorption: str, is_coarse: bool) -> None:
    rules = GreedyInsertionSettings(absorption=absorption)
    points = gable(300, 0.1, seed)
    if is_coarse:
        points = np.round(points * 2) / 2  # many equal positions, errors and circles
    turned = np.random.default_rng(seed).permutation(len(points))
    one, other = insert_greedily(points, rules, 0.0), insert_greedily(points[turned], rules, 0.0)

    def content(greedy: GreedyTin) -> set[tuple[tuple[float, ...], ...]]:
        return {tuple(sorted(map(tuple, greedy.vertices[f].tolist()))) for f in greedy.tin.facets}

    assert content(one) == content(other)


def test_moving_the_scene_changes_nothing_but_its_place() -> None:
    points = gable(1_500, 0.05, seed=8)
    shift = np.array([-321.0, 777.0, 12.0])
    here, there = insert_greedily(points, BUCKET, 0.0), insert_greedily(points + shift, BUCKET, 12.0)
    np.testing.assert_array_equal(here.tin.facets, there.tin.facets)
    np.testing.assert_array_equal(here.facet_of_point, there.facet_of_point)
    np.testing.assert_allclose(here.vertices + shift, there.vertices, atol=1e-9)


def roof_normal_error_deg(points: FloatArray, greedy: GreedyTin, slope_deg: float) -> float:
    """Median angle of the normals of facets inside the roof halves to the true ones, by facet."""
    centres = greedy.vertices[greedy.tin.facets].mean(axis=1)
    inside = (np.abs(centres[:, 0] - 6) < 5) & (np.abs(centres[:, 1] - 4) < 3.2) & (np.abs(centres[:, 1] - 4) > 0.8)
    normals = facet_normals(greedy.vertices, greedy.tin.facets)[inside]
    tilt = math.sin(math.radians(slope_deg)) * np.sign(centres[inside, 1] - 4)
    cosine = normals[:, 1] * tilt + normals[:, 2] * math.cos(math.radians(slope_deg))
    return float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))


@pytest.mark.parametrize("noise_m", [0.05, 0.10])
def test_absorption_steadies_the_normals_of_roof_facets(noise_m: float) -> None:
    plain, absorbed = [], []
    for seed in range(12):
        points = gable(450, noise_m, seed)
        none = insert_greedily(points, GreedyInsertionSettings(absorption="insert", absorption_distance_m=0.0), 0.0)
        plain.append(roof_normal_error_deg(points, none, 30.0))
        absorbed.append(roof_normal_error_deg(points, insert_greedily(points, INSERT, 0.0), 30.0))
    assert np.median(absorbed) < 0.65 * np.median(plain)


def test_one_point_makes_four_facets_and_none_makes_none() -> None:
    greedy = insert_greedily(np.array([[3.0, 4.0, 5.0]]), BUCKET, 0.0)
    assert len(greedy.tin) == 4
    assert greedy.vertices[:4].tolist() == [[1, 2, 0], [5, 2, 0], [5, 6, 0], [1, 6, 0]]
    nothing = insert_greedily(np.empty((0, 3)), BUCKET, 0.0)
    assert isinstance(nothing.tin, Tin)
    assert len(nothing.tin) == len(nothing.vertices) == len(nothing.absorbed) == 0


def test_points_at_one_position_keep_the_highest() -> None:
    points = np.array([[0.0, 0, 2], [0, 0, 7], [0, 0, 5], [3, 0, 7]])
    greedy = insert_greedily(points, BUCKET, 0.0)
    assert greedy.vertex_point.tolist() == [-1, -1, -1, -1, 1, 3]
    for below in (0, 2):
        assert 4 in greedy.tin.facets[greedy.facet_of_point[below]]


def test_too_wide_a_set_is_refused_with_its_extent() -> None:
    with pytest.raises(ValueError, match=r"2504\.000 m"):
        insert_greedily(np.array([[0.0, 0, 0], [2_500.0, 0, 0]]), BUCKET, 0.0)


def test_settings_tell_all_faults_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        GreedyInsertionSettings(absorption="drop", absorption_distance_m=-1.0, absorption_slope_deg=95.0)
    assert len(caught.value.faults) == 3
