"""The terrain of tiles as triangles: seamless, with floors cut out, within its tolerance."""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from surface_rules import surface_faults

from pipeline.extras.terrain_tin.terrain_files import surfaces_of
from pipeline.extras.terrain_tin.terrain_tin import (
    BESIDE_MM,
    CLEARANCE_MM,
    GAP_CELLS,
    REACH_M,
    Outline,
    TerrainMesh,
    terrain_mesh,
)
from pipeline.model import IntArray
from pipeline.terrain.lattice import NO_DATA
from pipeline.tiling import Window

Edge = tuple[tuple[int, int, int], tuple[int, int, int]]
SIDE = 24_000
TOLERANCE = 100.0


def hills(x: IntArray, y: IntArray) -> IntArray:
    """A terrain in mm, at places in mm."""
    waves = 2000 * np.sin(x / 9000) * np.cos(y / 7000) + 150 * np.sin(x / 1700 + y / 1300)
    return np.rint(5000 + 0.1 * x + waves).astype(np.int32)


def tile_at(
    corner: tuple[int, int],
    outlines: Sequence[Outline],
    side: int = SIDE,
    data: shapely.Geometry | None = None,
) -> TerrainMesh:
    """The terrain of a tile from its lower left corner; `data` is where points are, everywhere by default."""
    core = Window(x0_mm=corner[0], y0_mm=corner[1], x1_mm=corner[0] + side, y1_mm=corner[1] + side)
    view = core.grown(REACH_M * 1000)
    column0, row0 = view.x0_mm // 1000, view.y0_mm // 1000
    columns, rows = -(-view.x1_mm // 1000) - column0, -(-view.y1_mm // 1000) - row0
    x, y = np.meshgrid(1000 * (column0 + np.arange(columns)) + 500, 1000 * (row0 + np.arange(rows)) + 500)
    occupied = np.ones(x.shape, np.bool_) if data is None else shapely.contains_xy(data, x, y)
    return terrain_mesh(core, hills(x, y), occupied, (column0, row0), outlines, TOLERANCE)


def edges_of(meshes: Sequence[TerrainMesh]) -> Counter[Edge]:
    """How often each directed edge occurs in all meshes."""
    found: Counter[Edge] = Counter()
    for mesh in meshes:
        places = [tuple(place) for place in mesh.vertices_mm.tolist()]
        for a, b, c in mesh.triangles.tolist():
            found.update(((places[a], places[b]), (places[b], places[c]), (places[c], places[a])))
    return found


def area_mm2(mesh: TerrainMesh) -> float:
    """Area in plan; no triangle may be upside down."""
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k], :2] for k in range(3))
    doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    assert (doubled >= 0).all()
    return float(doubled.sum()) / 2


def box(x: int, y: int, wide: int, deep: int, turn: float, z: int) -> Outline:
    corners = np.array([(0, 0), (wide, 0), (wide, deep), (0, deep)])
    cosine, sine = np.cos(turn), np.sin(turn)
    turned = np.rint(corners @ np.array([[cosine, sine], [-sine, cosine]])).astype(np.int64)
    return Outline(rings=(turned + np.array((x, y)),), z_mm=z)


def row_of_houses(x: int, y: int, turn: float, levels: Sequence[int]) -> list[Outline]:
    """Touching houses of 6 m by 9 m that share the corners between them."""
    along, across = np.array((np.cos(turn), np.sin(turn))), np.array((-np.sin(turn), np.cos(turn)))
    front = [np.rint((x, y) + 6000 * k * along).astype(np.int64) for k in range(len(levels) + 1)]
    back = [np.rint((x, y) + 6000 * k * along + 9000 * across).astype(np.int64) for k in range(len(levels) + 1)]
    return [
        Outline(rings=(np.array((front[k], front[k + 1], back[k + 1], back[k])),), z_mm=level)
        for k, level in enumerate(levels)
    ]


def polygon(outline: Outline) -> shapely.Polygon:
    return shapely.Polygon(outline.rings[0], outline.rings[1:])


HOUSES = st.one_of(
    st.builds(
        box,
        st.integers(-9000, 50_000),
        st.integers(-9000, 50_000),
        st.integers(1500, 20_000),
        st.integers(1500, 12_000),
        st.sampled_from([0.0, 0.3, 1.1, np.pi / 4]),
        st.sampled_from([3000, 3200, 5000]),
    ).map(lambda one: [one]),
    st.builds(
        row_of_houses,
        st.integers(0, 48_000),
        st.integers(0, 48_000),
        st.sampled_from([0.0, 0.7, 2.5]),
        st.lists(st.sampled_from([3000, 3400]), min_size=2, max_size=4),
    ),
)


@settings(max_examples=examples(40), deadline=None)
@given(st.lists(HOUSES, max_size=5), st.sampled_from([(0, 0), (217, 881), (-7_000_500, 94_999_999)]))
def test_tiles_meet_without_gaps_overlaps_or_loose_vertices(
    houses: list[list[Outline]], corner: tuple[int, int]
) -> None:
    # houses that overlap are united as the models of a run never do: keep those apart from all before
    outlines: list[Outline] = []
    for group in houses:
        moved = [Outline(rings=tuple(r + corner for r in one.rings), z_mm=one.z_mm) for one in group]
        if all(polygon(a).distance(polygon(b)) > 5 for a in moved for b in outlines):
            outlines.extend(moved)
    corners = [(corner[0] + SIDE * i, corner[1] + SIDE * k) for i, k in itertools.product((0, 1), repeat=2)]
    meshes = [tile_at(place, outlines) for place in corners]
    edges = edges_of(meshes)
    assert max(edges.values()) == 1
    square = shapely.box(*corner, corner[0] + 2 * SIDE, corner[1] + 2 * SIDE)
    built = shapely.union_all([polygon(one) for one in outlines]) & square
    # noding moves vertices by less than a millimetre
    moved_mm2 = 1000 + built.length
    assert sum(map(area_mm2, meshes)) == pytest.approx(square.area - built.area, abs=moved_mm2)
    walls = shapely.union_all([polygon(one).exterior for one in outlines])
    for a, b in edges:
        if (b, a) in edges or (a[:2] == b[:2]):
            continue
        line = shapely.LineString((a[:2], b[:2]))
        on_edge = square.exterior.distance(shapely.Point(a[:2])) == square.exterior.distance(shapely.Point(b[:2])) == 0
        assert on_edge or shapely.hausdorff_distance(line, walls & line.buffer(2)) < 3


@settings(max_examples=examples(20), deadline=None)
@given(st.lists(HOUSES, min_size=1, max_size=3))
def test_cells_away_from_outlines_are_within_the_tolerance(houses: list[list[Outline]]) -> None:
    outlines = [one for group in houses for one in group]
    mesh = tile_at((0, 0), outlines)
    walls = shapely.union_all([polygon(one) for one in outlines])
    corners = mesh.vertices_mm[mesh.triangles].astype(float)
    flat = shapely.polygons(corners[:, :, :2])
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(500, SIDE, 1000)] * 2))
    counted = shapely.distance(walls, shapely.points(x, y)) >= CLEARANCE_MM
    cell, triangle = shapely.STRtree(flat[shapely.area(flat) > 0]).query(shapely.points(x, y), predicate="intersects")
    upright = corners[shapely.area(flat) > 0][triangle]
    normal = np.cross(upright[:, 1] - upright[:, 0], upright[:, 2] - upright[:, 0])
    away = np.column_stack((x, y))[cell] - upright[:, 0, :2]
    z = upright[:, 0, 2] - (normal[:, :2] * away).sum(axis=1) / normal[:, 2]
    errors = np.abs(z - hills(x, y)[cell])[counted[cell]]
    assert len(np.unique(cell[counted[cell]])) == mesh.n_cells == np.count_nonzero(counted)
    assert errors.max(initial=0.0) <= TOLERANCE + 1e-6
    assert mesh.max_error_mm <= TOLERANCE


def test_outlines_are_edges_of_the_mesh_at_the_level_of_the_floor() -> None:
    inner = np.array([(8000, 16_000), (8000, 19_000), (11_000, 19_000), (11_000, 16_000)])
    court = Outline(rings=(box(5000, 13_000, 9000, 9000, 0.0, 0).rings[0], inner), z_mm=4321)
    row = row_of_houses(2500, 1000, 0.1, [3000, 3400, 3000])
    edges = edges_of([tile_at((0, 0), [court, *row])])
    free = {frozenset(edge) for edge in edges if edge[::-1] not in edges}
    shared = set[frozenset[tuple[int, ...]]]()
    for first, second in itertools.pairwise(row):
        common = {tuple(place) for place in first.rings[0].tolist()} & {tuple(p) for p in second.rings[0].tolist()}
        shared.add(frozenset(common))
    for one in (court, *row):
        for ring in one.rings:
            for a, b in zip(ring.tolist(), np.roll(ring, -1, axis=0).tolist(), strict=True):
                if frozenset((tuple(a), tuple(b))) not in shared:
                    assert frozenset(((*a, one.z_mm), (*b, one.z_mm))) in free
    # nothing is drawn beneath a house, but the court has ground
    mesh = tile_at((0, 0), [court])
    places = shapely.polygons(mesh.vertices_mm[mesh.triangles][:, :, :2].astype(float))
    assert not shapely.intersects(places, shapely.Point(6000, 17_000)).any()
    assert shapely.intersects(places, shapely.Point(9500, 17_500)).any()


def test_upright_triangles_close_the_step_between_floors_that_touch() -> None:
    low, high = row_of_houses(8000, 8000, 0.0, [3000, 3400])
    mesh = tile_at((0, 0), [low, high])
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k]] for k in range(3))
    upright = np.flatnonzero(np.cross(b - a, c - a)[:, 2] == 0)
    # one at each end of the common wall, beneath the higher floor
    assert len(upright) == 2
    for triangle in mesh.triangles[upright]:
        assert set(mesh.vertices_mm[triangle][:, 2].tolist()) == {3000, 3400}
    assert len(mesh.vertices_mm) == len(np.unique(mesh.vertices_mm, axis=0))


def test_outlines_farther_away_do_not_matter() -> None:
    near = box(5000, 6000, 8000, 7000, 0.4, 3000)
    far = box(SIDE + BESIDE_MM + 1, 6000, 8000, 7000, 0.0, 3000)
    alone, both = tile_at((0, 0), [near]), tile_at((0, 0), [near, far])
    assert np.array_equal(alone.vertices_mm, both.vertices_mm)
    assert np.array_equal(alone.triangles, both.triangles)


def test_the_order_of_outlines_does_not_matter() -> None:
    row = row_of_houses(-3000, 9000, 0.2, [3000, 3400, 3100, 3400])
    one, other = tile_at((0, 0), row), tile_at((0, 0), row[::-1])
    assert np.array_equal(one.vertices_mm, other.vertices_mm)
    assert np.array_equal(one.triangles, other.triangles)


def test_terrain_ends_with_the_data_and_gaps_are_closed() -> None:
    wide = 2 * GAP_CELLS * 1000 + 3000
    data = shapely.box(-90_000, -90_000, 130_000, 70_000)
    pond, lake = shapely.box(10_000, 10_000, 25_000, 25_000), shapely.box(40_000, 10_000, 40_000 + wide, 10_000 + wide)
    tiles = [(100_000 * i, 0) for i in (0, 1)]
    meshes = [tile_at(corner, [], 100_000, data - pond - lake) for corner in tiles]
    edges = edges_of(meshes)
    assert max(edges.values()) == 1
    expected = shapely.box(0, 0, 130_000, 70_000) - lake
    assert sum(map(area_mm2, meshes)) == expected.area
    ends = shapely.MultiLineString([(a[:2], b[:2]) for a, b in edges if (b, a) not in edges])
    assert shapely.union_all(ends).symmetric_difference(expected.boundary).length == 0
    # the edge of the data is at the level of the terrain
    for mesh in meshes:
        x, y, z = mesh.vertices_mm.T
        assert np.abs(z - hills(x, y)).max() < 150


def test_a_tile_without_terrain_has_no_triangles() -> None:
    for outlines, data in (([], shapely.Polygon()), ([box(-9000, -9000, 60_000, 60_000, 0.0, 3000)], None)):
        mesh = tile_at((0, 0), outlines, data=data)
        assert (len(mesh.vertices_mm), len(mesh.triangles), mesh.n_cells) == (0, 0, 0)
        assert mesh.max_error_mm == mesh.squares_mm2 == 0.0


def test_cells_without_terrain_are_left_out() -> None:
    core = Window(x0_mm=0, y0_mm=0, x1_mm=8000, y1_mm=8000)
    cells = 8 + 2 * REACH_M
    terrain = np.full((cells, cells), 1000, np.int32)
    terrain[:, : REACH_M + 3] = NO_DATA
    mesh = terrain_mesh(core, terrain, np.ones((cells, cells), np.bool_), (-REACH_M, -REACH_M), [], TOLERANCE)
    assert mesh.vertices_mm.min(axis=0).tolist() == [3000, 0, 1000]
    assert len(mesh.triangles) == 2


def box_at(x0: int, y0: int, x1: int, y1: int, z: int) -> Outline:
    return Outline(rings=(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]),), z_mm=z)


@pytest.mark.parametrize(
    "houses",
    [
        [box_at(3000, SIDE, 9000, SIDE + 9000, 3000), box_at(9000, SIDE, 15000, SIDE + 9000, 3400)],
        [box_at(15000, 5000, SIDE, 14000, 3000), box_at(SIDE, 5000, 33000, 14000, 3400)],
        [box_at(15000, 15000, SIDE, SIDE, 3000), box_at(SIDE, SIDE, 33000, 33000, 3400)],
    ],
    ids=["walls on a border", "a common wall on a border", "one vertex on a corner"],
)
def test_the_step_to_a_lower_floor_is_closed_on_a_border_too(houses: list[Outline]) -> None:
    found = edges_of([tile_at((SIDE * i, SIDE * k), houses) for i in (0, 1) for k in (0, 1)])
    free = [(a, b) for a, b in found if (b, a) not in found]
    inside = [(a, b) for a, b in free if not any(a[d] == b[d] and a[d] in (0, 2 * SIDE) for d in (0, 1))]
    upright = [(a, b) for a, b in inside if a[:2] == b[:2]]
    # no terrain lies between the floors: the ends of a common wall are free
    assert {(a[2], b[2]) for a, b in inside if (a, b) not in upright} == {(3000, 3000), (3400, 3400)}
    assert max(found.values()) == 1


def facets_of(mesh: TerrainMesh) -> TerrainMesh:
    """The mesh without its upright triangles."""
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k], :2] for k in range(3))
    u, v = b - a, c - a
    return dataclasses.replace(mesh, triangles=mesh.triangles[u[:, 0] * v[:, 1] != u[:, 1] * v[:, 0]])


def faults_of(mesh: TerrainMesh) -> list[str]:
    """Vertices closer than 2 mm, upright edges with a vertex in the middle, and faults of the surfaces."""
    vertices = mesh.vertices_mm.tolist()
    pairs = shapely.STRtree(shapely.points(mesh.vertices_mm)).query(shapely.points(mesh.vertices_mm), "dwithin", 1.9)
    found = [f"{a}, {b} are close" for a, b in pairs.T.tolist() if a < b and math.dist(vertices[a], vertices[b]) < 2]
    levels: dict[tuple[int, int], list[int]] = {}
    for x, y, z in vertices:
        levels.setdefault((x, y), []).append(z)
    for a, b in edges_of([mesh]):
        if a[:2] == b[:2] and any(a[2] < z < b[2] for z in levels[a[:2]]):
            found.append(f"{a}, {b} has a vertex within")
    return [*found, *(fault for one in surfaces_of(mesh.triangles) for fault in surface_faults(one.tolist()))]


@pytest.mark.parametrize("at", [8000, SIDE - 1, SIDE], ids=["inside", "beside a border", "on a border"])
@pytest.mark.parametrize("along", [0, 1])
def test_corners_a_millimetre_apart_become_one_in_all_tiles(at: int, along: int) -> None:
    one, other = box_at(4000, 5000, at, 12_000, 3000), box_at(at + 1, 5000, 30_000, 14_000, 3000)
    houses = [dataclasses.replace(house, rings=(house.rings[0][:, :: 1 - 2 * along],)) for house in (one, other)]
    meshes = [tile_at((SIDE * i, SIDE * k), houses) for i in (0, 1) for k in (0, 1)]
    assert [fault for mesh in meshes for fault in faults_of(mesh)] == []
    edges = edges_of(meshes)
    assert max(edges.values()) == 1
    built = shapely.union_all([polygon(house) for house in houses])
    free = [(a[:2], b[:2]) for a, b in edges if (b, a) not in edges]
    inside = [line for line in free if not any(a in (0, 2 * SIDE) and a == b for a, b in zip(*line, strict=True))]
    # no terrain is left between the houses, and elsewhere an outline is left by at most the diagonal of a millimetre
    assert shapely.hausdorff_distance(shapely.union_all(shapely.linestrings(inside)), built.buffer(1).exterior) < 3
    assert sum(map(area_mm2, meshes)) == pytest.approx(4 * SIDE**2 - built.area, abs=20_000)


def test_floors_a_millimetre_apart_are_one_level() -> None:
    mesh = tile_at((0, 0), row_of_houses(2500, 8000, 0.0, [3000, 3001, 3400]))
    assert faults_of(mesh) == []
    assert {3000, 3001, 3400} <= set(mesh.vertices_mm[:, 2].tolist())


def test_no_vertex_on_a_border_is_close_to_the_corner_of_the_tile() -> None:
    # the middles of the first cells lie a millimetre from the corner, and all beside a house become vertices
    assert faults_of(tile_at((499, 499), [box_at(1500, 1500, 9000, 9000, 3000)])) == []


def test_upright_triangles_on_both_sides_of_a_slit_share_whole_edges() -> None:
    low = box_at(2000, 2000, 16_000, 8000, 3000)
    west = box_at(2000, 8000, 8000, 14_000, 3200)
    east = Outline(rings=(np.array([(8000, 8000), (14_000, 8000), (14_000, 14_000), (9000, 14_000)]),), z_mm=3400)
    mesh = tile_at((0, 0), [low, west, east])
    assert faults_of(mesh) == []
    edges = edges_of([mesh])
    step = ((8000, 8000, 3000), (8000, 8000, 3200))
    assert edges[step] == edges[step[::-1]] == 1
    assert ((8000, 8000, 3200), (8000, 8000, 3400)) in edges or ((8000, 8000, 3400), (8000, 8000, 3200)) in edges


def test_terrain_around_a_house_with_a_corner_on_the_border_is_two_surfaces() -> None:
    house = Outline(rings=(np.array([(0, 12_000), (6000, 6000), (12_000, 12_000), (6000, 18_000)]),), z_mm=3000)
    mesh = tile_at((0, 0), [house])
    surfaces = surfaces_of(mesh.triangles)
    assert len(surfaces) == 2
    assert faults_of(mesh) == []


def sectors(x: int, y: int, turn: float, parts: Sequence[tuple[float, int, tuple[int, int]]]) -> list[Outline]:
    """Houses around a corner, each up to a sixth of the circle: its share, level, and how far its corner is off."""
    found = []
    for number, (share, level, shift) in enumerate(parts):
        angles = turn + np.pi / 3 * np.array((number, number + share))
        corner = np.array((x, y)) + shift
        ends = np.rint(corner + 9000 * np.column_stack((np.cos(angles), np.sin(angles)))).astype(np.int64)
        if share:
            found.append(Outline(rings=(np.concatenate((corner[None], ends)),), z_mm=level))
    return found


NEAR_A_BORDER = st.one_of(st.integers(SIDE - 3, SIDE + 3), st.integers(9000, 39_000))


@settings(max_examples=examples(40), deadline=None)
@given(
    st.builds(
        sectors,
        NEAR_A_BORDER,
        NEAR_A_BORDER,
        st.sampled_from([0.0, 0.3, 1.1]),
        st.lists(
            st.tuples(
                st.sampled_from([0.0, 0.5, 1.0]),
                st.sampled_from([3000, 3001, 3002, 3400, 3800]),
                st.tuples(st.integers(-1, 1), st.integers(-1, 1)),
            ),
            min_size=6,
            max_size=6,
        ),
    )
)
def test_houses_that_nearly_meet_at_a_corner_leave_valid_terrain_in_all_tiles(houses: list[Outline]) -> None:
    meshes = [tile_at((SIDE * i, SIDE * k), houses) for i in (0, 1) for k in (0, 1)]
    assert [fault for mesh in meshes for fault in faults_of(mesh)] == []
    edges = edges_of([facets_of(mesh) for mesh in meshes])
    assert max(edges.values()) == 1
    built = shapely.union_all([polygon(house) for house in houses])
    square = shapely.box(0, 0, 2 * SIDE, 2 * SIDE)
    assert sum(map(area_mm2, meshes)) == pytest.approx(square.area - built.area, abs=2000 + 4 * built.length)
    walls = shapely.union_all([polygon(house).exterior for house in houses])
    for a, b in edges:
        line = shapely.LineString((a[:2], b[:2]))
        if (b, a) not in edges and not square.exterior.contains(line):
            assert shapely.hausdorff_distance(line, walls & line.buffer(3)) < 4
