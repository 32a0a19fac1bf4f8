"""Walls cut the TIN: what lies on either side of them, and what is summed of it."""

import dataclasses
import itertools
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.model import FloatArray, IntArray, KindArray, LabelArray, Tin
from pipeline.terrain.decks_and_vehicles import shape_figures
from pipeline.terrain.facets import (
    FacetKind,
    FacetLimits,
    SceneVertices,
    VertexKind,
    classify_facets,
    facet_keys,
    label_fragments,
    label_vertices,
)
from pipeline.terrain.fragment_sums import N_SUMS, Sum
from pipeline.terrain.point_assignment import Allowed, ScenePoints
from pipeline.terrain.surfaces import Fragments, fragments_of
from pipeline.terrain.terrain_settings import SurfaceSettings
from pipeline.tin.delaunay import triangulate

Height = Callable[[FloatArray, FloatArray], FloatArray]
Core = tuple[int, int, int, int]

SETTINGS = SurfaceSettings()
EVERYWHERE: Core = (-(10**9), -(10**9), 10**9, 10**9)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """Vertices over flat ground at elevation 0, their TIN, and more points on the same surface."""

    vertices: SceneVertices
    tin: Tin
    points: ScenePoints

    def cut(self, core: Core = EVERYWHERE) -> tuple[Fragments, LabelArray]:
        """The fragments of a core; it owns those of the points that lie in it."""
        p = self.points
        inside = (p.x_mm >= core[0]) & (p.x_mm < core[2]) & (p.y_mm >= core[1]) & (p.y_mm < core[3])
        owned = ScenePoints(*(values[inside] for values in p))
        fragments, labels = fragments_of(self.tin, self.vertices, owned, core, SETTINGS, canopy_m=1.0, ground_m=0.5)
        out = np.full(len(p.x_mm), -1, np.int32)
        out[inside] = labels
        return fragments, out

    def facet_kinds(self) -> KindArray:
        """Kinds of the facets."""
        wall, steep = (math.tan(math.radians(deg)) for deg in (SETTINGS.wall_deg, SETTINGS.steep_deg))
        return classify_facets(self.vertices, self.tin.facets, FacetLimits(6000.0, 2000, wall, steep, 1000, 2000))


def built(
    height_m: Height, *, side_m: float = 40.0, spacing_m: float = 0.5, seed: int = 0, corner_mm: int = 0
) -> Scene:
    """A jittered lattice of vertices and twice as many points; what stands above 0.5 m is an object."""
    random = np.random.default_rng(seed)
    axis = np.arange(0, side_m, spacing_m) + spacing_m / 2
    lattice = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    xy = np.rint(1000 * (lattice + random.uniform(-0.3, 0.3, lattice.shape) * spacing_m)).astype(np.int64)
    xy = xy[np.lexsort((xy[:, 1], xy[:, 0]))]
    other = random.integers(0, round(1000 * side_m), (2 * len(xy), 2))

    def at(places: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        z = np.rint(1000 * height_m(places[:, 0] / 1000, places[:, 1] / 1000)).astype(np.int64)
        return places[:, 0] + corner_mm, places[:, 1] + corner_mm, z

    x, y, z = at(xy)
    px, py, pz = at(np.concatenate((xy, other)))
    return Scene(
        vertices=SceneVertices(
            x_mm=x,
            y_mm=y,
            z_mm=z,
            height_mm=z,
            kind=np.where(z >= 500, VertexKind.OBJECT, VertexKind.GROUND).astype(np.int8),
            planar=np.where(z >= 500, 1, -1).astype(np.int8),
        ),
        tin=triangulate(np.column_stack((x, y))),
        points=ScenePoints(
            x_mm=px,
            y_mm=py,
            z_mm=pz,
            height_mm=pz,
            last=np.ones(len(px), np.bool_),
            several=np.zeros(len(px), np.bool_),
            allowed=np.ones(len(px), np.int8),
        ),
    )


def in_box(x: FloatArray, y: FloatArray, x0: float, y0: float, x1: float, y1: float) -> npt.NDArray[np.bool_]:
    return (x >= x0) & (x < x1) & (y >= y0) & (y < y1)


def box(x: FloatArray, y: FloatArray) -> FloatArray:
    """A flat roof of 16 m by 12 m, 6 m high."""
    return np.where(in_box(x, y, 12, 14, 28, 26), 6.0, 0.0)


def two_levels(x: FloatArray, y: FloatArray) -> FloatArray:
    """The box with a storey of 6 m by 4 m on it."""
    return np.where(in_box(x, y, 16, 18, 22, 22), 10.0, box(x, y))


def canyon(x: FloatArray, y: FloatArray) -> FloatArray:
    """Two blocks with a raised lane of 4 m between them, 1 m above the ground and so no ground."""
    z = np.where(in_box(x, y, 8, 8, 18, 32) | in_box(x, y, 22, 8, 32, 32), 9.0, 0.0)
    return np.where(in_box(x, y, 18, 8, 22, 32), 1.0, z)


def town(x: FloatArray, y: FloatArray) -> FloatArray:
    """Everything at once, with roofs that slope and a wavy hedge."""
    z = np.where(in_box(x, y, 4, 4, 16, 14), 5.0 + 0.5 * (y - 4), 0.0)
    z = np.where(in_box(x, y, 8, 8, 12, 12), 14.0, z)
    z = np.where(in_box(x, y, 20, 3, 36, 18), 7.0, z)
    z = np.where(in_box(x, y, 1, 29, 8, 38), 2.5, z)
    z = np.where(in_box(x, y, 3, 31, 6, 36), 6.0, z)
    z = np.where(in_box(x, y, 5, 20, 30, 24), 1.5 + np.sin(2 * x) * np.cos(3 * y), z)
    return np.where(in_box(x, y, 10, 28, 37, 37), 4.0 + 3.0 * (x > 22), z)


def of_kind(fragments: Fragments, kind: FacetKind) -> IntArray:
    """Numbers of the fragments of a kind that own facets, the largest first."""
    found = np.flatnonzero((fragments.kind == kind) & (fragments.sums[:, Sum.FACETS] > 0))
    return found[np.argsort(-fragments.sums[found, Sum.AREA2])]


# -- facets ------------------------------------------------------------------------------------------------------------


def slow_kind(scene: Scene, facet: npt.NDArray[np.int32]) -> FacetKind:
    """Kind of a facet by plain floats: sides, slope by the normal of numpy, words instead of numbers."""
    v = scene.vertices
    p = np.column_stack((v.x_mm, v.y_mm, v.z_mm))[facet] / 1000.0
    plan = p[:, :2]
    sides = [float(np.linalg.norm(plan[k] - plan[k - 1])) for k in range(3)]
    area = float(shapely.Polygon(plan).area)
    radius = math.prod(sides) / (4 * area)
    if radius > 6.0:
        return FacetKind.VOID
    kinds = v.kind[facet]
    difference = float(np.ptp(p[:, 2]))
    if (kinds == VertexKind.GROUND).all():
        return FacetKind.GROUND if difference < 2.0 else FacetKind.BORDER
    if (kinds == VertexKind.GROUND).any() or (kinds == VertexKind.EXCLUDED).any():
        return FacetKind.BORDER
    normal = np.cross(p[1] - p[0], p[2] - p[0])
    slope_deg = math.degrees(math.acos(normal[2] / np.linalg.norm(normal)))
    if (difference >= 2.0 and slope_deg > 55.0) or (difference >= 1.0 and slope_deg > 70.0):
        return FacetKind.STEP if v.height_mm[facet].min() >= 2000 else FacetKind.BORDER
    places = np.column_stack((v.x_mm, v.y_mm)) / 1000.0
    second = [float(np.sort(np.hypot(*(places - at).T))[2]) for at in plan] if radius > 3.0 else []
    if second and max(second) <= radius / 5.0:
        return FacetKind.VOID
    if (kinds == VertexKind.OBJECT).all():
        return FacetKind.OBJECT
    building = np.isin(kinds, (VertexKind.BUILDING, VertexKind.JOINED))
    if building.all():
        return FacetKind.BUILDING
    if building.any():
        goes_on = (kinds == VertexKind.JOINED).any() and not (kinds == VertexKind.CROWN).any()
        return FacetKind.SEAM if goes_on else FacetKind.BORDER
    return FacetKind.CROWN


def test_facet_kinds_agree_with_a_slow_twin() -> None:
    scene = built(town, seed=3)
    random = np.random.default_rng(3)
    kind = scene.vertices.kind.copy()
    x = scene.vertices.x_mm
    kind[(x > 20_000) & (kind == VertexKind.OBJECT)] = VertexKind.BUILDING
    kind[(random.random(len(kind)) < 0.05) & (kind == VertexKind.BUILDING)] = VertexKind.JOINED
    kind[(random.random(len(kind)) < 0.05) & (kind == VertexKind.BUILDING)] = VertexKind.OBJECT
    kind[(random.random(len(kind)) < 0.02) & (kind != VertexKind.GROUND)] = VertexKind.EXCLUDED
    kind[(random.random(len(kind)) < 0.05) & (kind == VertexKind.OBJECT)] = VertexKind.CROWN
    gap = in_box(x / 1000, scene.vertices.y_mm / 1000, 22, 26, 39, 32)
    kept = np.flatnonzero(~gap | (random.random(len(x)) < 0.02))
    v = SceneVertices(*(values[kept] for values in scene.vertices._replace(kind=kind)))
    scene = dataclasses.replace(scene, vertices=v, tin=triangulate(np.column_stack((v.x_mm, v.y_mm))))
    found = scene.facet_kinds().tolist()
    assert found == [slow_kind(scene, facet) for facet in scene.tin.facets]
    assert set(found) == set(FacetKind)


@pytest.mark.parametrize(("spacing_m", "spans"), [(0.5, False), (1.5, True)])
def test_no_surface_spans_a_gap_that_is_wide_for_its_points(spacing_m: float, *, spans: bool) -> None:
    """Two roofs with 8 m of dark water between them; where points are sparse, one roof may look like that."""
    scene = built(lambda x, _: np.full(len(x), 6.0), spacing_m=spacing_m, seed=20)
    x = scene.vertices.x_mm
    kept = np.flatnonzero((x < 16_000) | (x >= 24_000))
    v = SceneVertices(*(values[kept] for values in scene.vertices))
    scene = dataclasses.replace(scene, vertices=v, tin=triangulate(np.column_stack((v.x_mm, v.y_mm))))
    corners = scene.tin.facets
    # those at the hull are gaps by their circumradius alone
    inside = (v.y_mm[corners].min(axis=1) > 4000) & (v.y_mm[corners].max(axis=1) < 36_000)
    across = inside & (np.ptp(v.x_mm[corners], axis=1) > 7500)
    assert across.sum() > 20
    assert (scene.facet_kinds()[across] == (FacetKind.OBJECT if spans else FacetKind.VOID)).all()


def test_facet_kinds_do_not_depend_on_the_first_vertex() -> None:
    scene = built(town, seed=4)
    tin = Tin(facets=np.roll(scene.tin.facets, 1, axis=1), neighbours=scene.tin.neighbours)
    turned = dataclasses.replace(scene, tin=tin)
    np.testing.assert_array_equal(turned.facet_kinds(), scene.facet_kinds())


def test_fragments_are_the_connected_components_of_scipy() -> None:
    scene = built(town, seed=5)
    kinds = scene.facet_kinds()
    considered = np.random.default_rng(5).random(len(kinds)) < 0.9
    label, fragment_kind = label_fragments(kinds, scene.tin.neighbours, considered)
    facet, side = np.nonzero(scene.tin.neighbours >= 0)
    other = scene.tin.neighbours[facet, side]
    joined = considered[facet] & considered[other] & (kinds[facet] == kinds[other]) & (kinds[facet] > FacetKind.GROUND)
    graph = coo_array((np.ones(joined.sum()), (facet[joined], other[joined])), shape=(len(kinds),) * 2)
    component = connected_components(graph, directed=False)[1]
    labelled = considered & (kinds > FacetKind.GROUND)
    assert ((label >= 0) == labelled).all()
    pairs = np.unique(np.column_stack((label[labelled], component[labelled])), axis=0)
    assert len(pairs) == len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(fragment_kind)
    np.testing.assert_array_equal(fragment_kind[label[labelled]], kinds[labelled])


def test_a_vertex_belongs_to_its_largest_object_facet() -> None:
    scene = built(town, seed=6)
    v, facets, kinds = scene.vertices, scene.tin.facets, scene.facet_kinds()
    label, _ = label_fragments(kinds, scene.tin.neighbours, np.ones(len(kinds), np.bool_))
    best: dict[int, tuple[int, int, int]] = {}
    expected = np.full(len(v.x_mm), -1)
    for f, (a, b, c) in enumerate(facets.tolist()):
        if kinds[f] not in {FacetKind.OBJECT, FacetKind.BUILDING}:
            continue
        x, y = v.x_mm[[a, b, c]], v.y_mm[[a, b, c]]
        area2 = int((x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]))
        rank = (-area2, int(x.sum()), int(y.sum()))
        for vertex in (a, b, c):
            if vertex not in best or rank < best[vertex]:
                best[vertex] = rank
                expected[vertex] = label[f]
    np.testing.assert_array_equal(label_vertices(v.x_mm, v.y_mm, facets, kinds, label), expected)


def test_keys_of_a_facet_do_not_depend_on_its_first_vertex() -> None:
    scene = built(box)
    v, facets = scene.vertices, scene.tin.facets
    chosen = np.arange(len(facets))
    keys = facet_keys(v.x_mm, v.y_mm, facets, chosen)
    for turn in (1, 2):
        np.testing.assert_array_equal(facet_keys(v.x_mm, v.y_mm, np.roll(facets, turn, axis=1), chosen), keys)
    corners = keys.reshape(-1, 3, 2)
    assert len(np.unique(keys, axis=0)) == len(keys)
    first, second, third = (corners[:, k] for k in range(3))
    for later in (second, third):
        assert ((first[:, 0] < later[:, 0]) | ((first[:, 0] == later[:, 0]) & (first[:, 1] < later[:, 1]))).all()
    u, w = second - first, third - first
    assert (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0] > 0).all()


# -- sums --------------------------------------------------------------------------------------------------------------


def test_a_box_on_flat_ground_is_one_object_with_walls_around_it() -> None:
    scene = built(box)
    fragments, labels = scene.cut()
    roof, *others = of_kind(fragments, FacetKind.OBJECT)
    assert not others
    sums = fragments.sums[roof]
    # the outline runs through the outermost vertices, up to 0.4 m inside the edge
    assert 15.2 * 11.2 <= sums[Sum.AREA2] / 2e6 <= 16.0 * 12.0
    assert sums[Sum.WALL] == sums[Sum.BOUNDARY]
    assert 2 * (15.2 + 11.2) <= sums[Sum.BOUNDARY] / 1000 <= 1.25 * 2 * (16 + 12)
    assert sums[Sum.WALL_TOP] == sums[Sum.WALL]
    assert sums[Sum.STEP] == 0
    assert sums[Sum.WALLS_Z_MX] == sums[Sum.WALLS_OWN_Z] == 6000 * sums[Sum.WALLS]
    assert sums[Sum.HEIGHT] == 6000 * sums[Sum.VERTICES]
    assert sums[Sum.HEIGHT2] == 6000**2 * sums[Sum.VERTICES]
    assert sums[Sum.PLANAR] == sums[Sum.VERTICES]
    assert (fragments.boxes_mm[roof] // 500 == [24, 28, 55, 51]).all()
    assert len(of_kind(fragments, FacetKind.GROUND)) == 0
    assert sums[Sum.POINTS] == (labels == roof).sum()


def test_the_ground_of_a_canyon_lies_at_the_foot_of_its_walls() -> None:
    fragments, _ = built(canyon).cut()
    blocks_and_lane = of_kind(fragments, FacetKind.OBJECT)
    assert len(blocks_and_lane) == 3
    lane = fragments.sums[blocks_and_lane[2]]
    assert lane[Sum.HEIGHT] == 1000 * lane[Sum.VERTICES]
    assert lane[Sum.WALL] > 0.7 * lane[Sum.BOUNDARY]
    assert lane[Sum.WALL_TOP] == 0
    assert lane[Sum.WALLS_OWN_Z] == 1000 * lane[Sum.WALLS]
    assert lane[Sum.WALLS_Z_MX] == 9000 * lane[Sum.WALLS]
    # the walls of the lane reach down to less than step_height_m: they are no steps between levels
    assert lane[Sum.STEP] == 0
    for block in blocks_and_lane[:2]:
        assert fragments.sums[block, Sum.WALL_TOP] == fragments.sums[block, Sum.WALL]


def test_a_step_between_two_levels_links_them() -> None:
    fragments, _ = built(two_levels).cut()
    lower, upper = of_kind(fragments, FacetKind.OBJECT)
    (step,) = of_kind(fragments, FacetKind.STEP)
    along = fragments.along_steps
    assert set(along[:, 1].tolist()) == {step}
    assert set(along[:, 0].tolist()) == {lower, upper}
    for level in (lower, upper):
        assert along[along[:, 0] == level, 2].sum() == fragments.sums[level, Sum.STEP]
    assert fragments.sums[upper, Sum.STEP] == fragments.sums[upper, Sum.BOUNDARY] == fragments.sums[upper, Sum.WALL_TOP]
    assert fragments.sums[lower, Sum.STEP] + fragments.sums[lower, Sum.WALL_TOP] == fragments.sums[lower, Sum.BOUNDARY]
    assert fragments.sums[step, Sum.BOUNDARY] == fragments.sums[[lower, upper], Sum.STEP].sum()


def slab(x: FloatArray, y: FloatArray) -> FloatArray:
    """A slab that rises from the ground in the west to 2 m at the edge of the data in the east."""
    return np.where(in_box(x, y, 10, 12, 40, 26), (x - 10) / 15, 0.0)


def add_moments(row: IntArray, first: Sum, weight: int, x_dm: int, y_dm: int) -> None:
    """Add a weight and its moments."""
    for k, value in enumerate((1, x_dm, y_dm, x_dm * x_dm, x_dm * y_dm, y_dm * y_dm)):
        row[first + k] += weight * value


@pytest.mark.parametrize("heights", [box, two_levels, canyon, town, slab])
def test_sums_agree_with_a_walk_over_all_edges(heights: Height) -> None:
    scene = built(heights, seed=7)
    v, facets, kinds = scene.vertices, scene.tin.facets, scene.facet_kinds()
    label, kind_of = label_fragments(kinds, scene.tin.neighbours, np.ones(len(kinds), np.bool_))
    sides: dict[frozenset[int], list[int]] = {}
    for f, (a, b, c) in enumerate(facets.tolist()):
        for edge in ((a, b), (b, c), (c, a)):
            sides.setdefault(frozenset(edge), []).append(f)
    expected = np.zeros((len(kind_of), N_SUMS), np.int64)
    for f, corners in enumerate(facets.tolist()):
        if label[f] >= 0:
            expected[label[f], Sum.FACETS] += 1
            area = shapely.Polygon(np.column_stack((v.x_mm, v.y_mm))[corners]).area
            expected[label[f], Sum.AREA2] += round(2 * area)
        if label[f] >= 0 and kinds[f] == FacetKind.OBJECT:
            for a, b in itertools.pairwise([*corners, corners[0]]):
                place = (v.x_mm[a] + v.x_mm[b]) // 200, (v.y_mm[a] + v.y_mm[b]) // 200
                add_moments(expected[label[f]], Sum.AREA_W, round(2 * area) // 6000, *place)
    for ends, beside in sides.items():
        a, b = ends
        length = round(math.dist((v.x_mm[a], v.y_mm[a]), (v.x_mm[b], v.y_mm[b])))
        for f, g in [(f, g) for f in beside for g in ([k for k in beside if k != f] or [-1])]:
            if label[f] < 0 or (g >= 0 and kinds[f] == kinds[g]):
                continue
            row = expected[label[f]]
            row[Sum.BOUNDARY] += length
            if kinds[f] == FacetKind.OBJECT:
                place = (v.x_mm[a] + v.x_mm[b]) // 200, (v.y_mm[a] + v.y_mm[b]) // 200
                if g < 0 or kinds[g] == FacetKind.VOID:
                    add_moments(row, Sum.GAP_W, length // 10, *place)
                elif kinds[g] == FacetKind.BORDER:
                    (beyond,) = set(facets[g].tolist()) - {a, b}
                    row[Sum.OPEN] += length if v.height_mm[beyond] < (v.height_mm[a] + v.height_mm[b]) / 3 else 0
                    if v.kind[beyond] == VertexKind.GROUND and np.ptp(v.z_mm[facets[g]]) < 300:
                        add_moments(row, Sum.LEVEL_W, length // 10, *place)
            if g < 0 or kinds[g] == FacetKind.VOID:
                continue
            top, foot = v.z_mm[facets[g]].max(), v.z_mm[facets[g]].min()
            own = (v.z_mm[a] + v.z_mm[b]) // 2
            if top - foot >= 2000:
                row[Sum.WALL] += length
                row[Sum.WALL_TOP] += length if own >= (top + foot) / 2 else 0
                row[Sum.WALLS] += 1
                row[Sum.WALLS_Z_MX] += top
                row[Sum.WALLS_OWN_Z] += own
            if kinds[g] in {FacetKind.STEP, FacetKind.SEAM}:
                row[Sum.STEP if kinds[g] == FacetKind.STEP else Sum.SEAM] += length
    fragments, _ = scene.cut()
    columns = [Sum.FACETS, Sum.AREA2, *range(Sum.BOUNDARY, Sum.POINTS), *range(Sum.OPEN, N_SUMS)]
    assert (expected[:, [Sum.OPEN, Sum.AREA_W, Sum.GAP_W]].sum(axis=0) > 0).tolist() == [True, True, heights is slab]
    assert (expected[:, Sum.LEVEL_W].sum() > 0) == (heights is slab)
    np.testing.assert_array_equal(fragments.sums[:, columns], expected[:, columns])


def test_fragments_borders_and_gaps_fill_the_hull() -> None:
    scene = built(town, seed=8)
    fragments, _ = scene.cut()
    v, kinds = scene.vertices, scene.facet_kinds()
    p = np.column_stack((v.x_mm, v.y_mm))
    rest = sum(shapely.Polygon(p[facet]).area for facet in scene.tin.facets[kinds <= FacetKind.GROUND])
    hull = shapely.MultiPoint(p).convex_hull.area
    assert fragments.sums[:, Sum.AREA2].sum() / 2 + rest == pytest.approx(hull)


# -- points ------------------------------------------------------------------------------------------------------------


def test_points_of_the_roof_are_assigned_and_those_of_the_ground_are_not() -> None:
    scene = built(box, seed=9)
    fragments, labels = scene.cut()
    p = scene.points
    on_roof = p.z_mm == 6000
    (roof,) = of_kind(fragments, FacetKind.OBJECT)
    assert (labels[~on_roof] == -1).all()
    assert (labels[on_roof] == roof).all()
    order = np.lexsort((p.z_mm[on_roof], p.y_mm[on_roof], p.x_mm[on_roof]))
    smallest = np.column_stack((p.x_mm, p.y_mm, p.z_mm))[on_roof][order[0]]
    np.testing.assert_array_equal(fragments.lowest_point_mm[roof], smallest)


def test_points_inside_facets_are_assigned_as_a_slow_twin_does() -> None:
    scene = built(town, seed=10, side_m=40.0)
    random = np.random.default_rng(10)
    p, v = scene.points, scene.vertices
    z = p.z_mm + np.where(random.random(len(p.z_mm)) < 0.3, random.integers(-4000, 4000, len(p.z_mm)), 0)
    scene = dataclasses.replace(scene, points=p._replace(z_mm=z, height_mm=z, last=random.random(len(z)) < 0.5))
    fragments, labels = scene.cut()
    kinds = scene.facet_kinds()
    facet_label, _ = label_fragments(kinds, scene.tin.neighbours, np.ones(len(kinds), np.bool_))
    vertex_label = label_vertices(v.x_mm, v.y_mm, scene.tin.facets, kinds, facet_label)
    corners = np.column_stack((v.x_mm, v.y_mm))[scene.tin.facets]
    tree = shapely.STRtree(shapely.polygons(corners.astype(np.float64)))
    chosen = random.choice(len(z), 1500, replace=False)
    point, facet = tree.query(shapely.points(p.x_mm[chosen].astype(float), p.y_mm[chosen].astype(float)), "within")
    seen: set[tuple[int, bool]] = set()
    for i, f in zip(chosen[point].tolist(), facet.tolist(), strict=True):
        expected = -1
        ids = scene.tin.facets[f]
        if z[i] >= 500 and kinds[f] in {FacetKind.OBJECT, FacetKind.BUILDING}:
            design = np.column_stack((v.x_mm[ids] - p.x_mm[i], v.y_mm[ids] - p.y_mm[i], np.ones(3)))
            surface_mm = np.linalg.solve(design.astype(np.float64), v.z_mm[ids].astype(np.float64))[2]
            expected = int(facet_label[f]) if abs(z[i] - surface_mm) <= 1000 else -1
        elif z[i] >= 500 and kinds[f] != FacetKind.VOID:
            ranked = sorted(
                (abs(z[i] - v.z_mm[k]), math.dist((v.x_mm[k], v.y_mm[k]), (p.x_mm[i], p.y_mm[i])), int(vertex_label[k]))
                for k in ids
                if vertex_label[k] >= 0
            )
            expected = ranked[0][2] if ranked and ranked[0][0] <= 1000 else -1
        assert labels[i] == expected
        seen.add((int(kinds[f]), expected >= 0))
    assert {(kind, True) for kind in (FacetKind.OBJECT, FacetKind.BORDER, FacetKind.STEP)} <= seen
    assert (FacetKind.OBJECT, False) in seen
    counts = np.bincount(labels[labels >= 0], minlength=len(fragments.kind))
    np.testing.assert_array_equal(fragments.sums[:, Sum.POINTS], counts)


def test_the_order_of_points_does_not_matter_nor_those_beyond_the_hull() -> None:
    scene = built(town, seed=12, side_m=30.0)
    random = np.random.default_rng(12)
    far = random.random(len(scene.points.x_mm)) < 0.05
    x = scene.points.x_mm + np.where(far, random.integers(-50_000, 50_000, len(far)), 0)
    scene = dataclasses.replace(scene, points=scene.points._replace(x_mm=x))
    fragments, labels = scene.cut()
    turned = random.permutation(len(x))
    other, other_labels = dataclasses.replace(scene, points=ScenePoints(*(v[turned] for v in scene.points))).cut()
    assert (labels >= 0).any()
    assert (labels[far & (np.abs(x - 15_000) > 16_000)] == -1).all()
    np.testing.assert_array_equal(other_labels, labels[turned])
    np.testing.assert_array_equal(other.sums, fragments.sums)
    np.testing.assert_array_equal(other.lowest_point_mm, fragments.lowest_point_mm)


def test_earlier_returns_above_a_surface_are_its_canopy_and_no_points_of_it() -> None:
    scene = built(box, seed=11)
    p = scene.points
    over = in_box(p.x_mm / 1000, p.y_mm / 1000, 14, 16, 26, 24) & (np.arange(len(p.x_mm)) >= len(scene.vertices.x_mm))
    z = np.where(over, 9000, p.z_mm)
    raised = p._replace(z_mm=z, height_mm=z, last=~over)
    fragments, labels = dataclasses.replace(scene, points=raised).cut()
    (roof,) = of_kind(fragments, FacetKind.OBJECT)
    assert fragments.sums[roof, Sum.CANOPY] == over.sum()
    assert (labels[over] == -1).all()
    # last returns that high are no canopy
    fragments, _ = dataclasses.replace(scene, points=raised._replace(last=np.ones_like(over))).cut()
    assert fragments.sums[roof, Sum.CANOPY] == 0


def test_points_that_the_classes_exclude_are_not_assigned() -> None:
    scene = built(box, seed=12)
    excluded = np.random.default_rng(12).random(len(scene.points.x_mm)) < 0.3
    allowed = np.where(excluded, Allowed.NEVER, Allowed.ANY).astype(np.int8)
    _, before = scene.cut()
    _, after = dataclasses.replace(scene, points=scene.points._replace(allowed=allowed)).cut()
    np.testing.assert_array_equal(after, np.where(excluded, -1, before))


def test_points_of_thin_objects_are_evidence_alone() -> None:
    scene = built(box, seed=12)
    thin = np.random.default_rng(12).random(len(scene.points.x_mm)) < 0.3
    allowed = np.where(thin, Allowed.EVIDENCE, Allowed.ANY).astype(np.int8)
    whole, before = scene.cut()
    found, after = dataclasses.replace(scene, points=scene.points._replace(allowed=allowed)).cut()
    np.testing.assert_array_equal(after, np.where(thin, -1, before))
    np.testing.assert_array_equal(found.sums, whole.sums)
    p = scene.points
    (roof,) = of_kind(found, FacetKind.OBJECT)
    rest = np.column_stack((p.x_mm, p.y_mm, p.z_mm))[after == roof]
    np.testing.assert_array_equal(found.lowest_point_mm[roof], min(map(tuple, rest.tolist())))


def test_undecided_points_join_a_surface_of_class_building_if_they_lie_on_it() -> None:
    scene = built(box, seed=13)
    v, p = scene.vertices, scene.points
    kind = np.where(v.kind == VertexKind.OBJECT, VertexKind.BUILDING, v.kind).astype(np.int8)
    random = np.random.default_rng(13)
    allowed = random.choice(np.array([Allowed.BUILDING, Allowed.ANY, Allowed.NEVER], np.int8), len(p.x_mm))
    lift_mm = np.where((allowed != Allowed.BUILDING) & (random.random(len(p.x_mm)) < 0.3), 300, 0)
    points = p._replace(z_mm=p.z_mm + lift_mm, height_mm=p.height_mm + lift_mm, allowed=allowed)
    fragments, labels = dataclasses.replace(scene, vertices=v._replace(kind=kind), points=points).cut()
    (roof,) = of_kind(fragments, FacetKind.BUILDING)
    on_roof = p.z_mm == 6000
    known, undecided = on_roof & (allowed == Allowed.BUILDING), on_roof & (allowed == Allowed.ANY) & (lift_mm == 0)
    assert (labels[known] == roof).all()
    assert not (labels == roof)[~known & ~undecided].any(), "others, and those that lie 0.3 m above the roof"
    inner = undecided & (abs(p.x_mm - p.x_mm[on_roof].mean()) < 6000) & (abs(p.y_mm - p.y_mm[on_roof].mean()) < 4000)
    assert inner.any()
    assert (labels[inner] == roof).all()


# -- tiles -------------------------------------------------------------------------------------------------------------


def quarters(scene: Scene, x_mm: int, y_mm: int) -> list[Core]:
    """Four cores that meet at a point."""
    x0, y0, x1, y1 = EVERYWHERE
    return [(x0, y0, x_mm, y_mm), (x_mm, y0, x1, y_mm), (x0, y_mm, x_mm, y1), (x_mm, y_mm, x1, y1)]


@pytest.mark.parametrize("heights", [box, two_levels, canyon, town])
@pytest.mark.parametrize("at_mm", [(20_000, 20_000), (17_123, 20_999), (12_000, 26_000)])
@pytest.mark.parametrize("spacing_m", [0.5, 2.5])
def test_the_sums_of_four_tiles_add_up_to_those_of_the_whole(
    heights: Height, at_mm: tuple[int, int], spacing_m: float
) -> None:
    scene = built(heights, seed=14, spacing_m=spacing_m)
    whole, labels = scene.cut()
    parts = [scene.cut(core) for core in quarters(scene, *at_mm)]
    for kind in (FacetKind.OBJECT, FacetKind.STEP):
        total = sum(fragments.sums[fragments.kind == kind].sum(axis=0) for fragments, _ in parts)
        np.testing.assert_array_equal(total, whole.sums[whole.kind == kind].sum(axis=0))
    assert sum(f.along_steps[:, 2].sum() for f, _ in parts) == whole.along_steps[:, 2].sum()
    assigned = np.stack([part >= 0 for _, part in parts])
    np.testing.assert_array_equal(assigned.sum(axis=0), labels >= 0)
    # points that one tile puts together are together in the whole
    for _, part in parts:
        pairs = np.unique(np.column_stack((part, labels))[part >= 0], axis=0)
        assert len(pairs) == len(np.unique(pairs[:, 0]))


@pytest.mark.parametrize("heights", [two_levels, town])
@pytest.mark.parametrize("spacing_m", [0.5, 2.5])
@pytest.mark.parametrize("at_mm", [(20_000, 20_000), (17_123, 20_999), (9_000, 11_000)])
def test_shared_facets_unite_the_fragments_of_four_tiles_to_whole_surfaces(
    heights: Height, spacing_m: float, at_mm: tuple[int, int]
) -> None:
    scene = built(heights, seed=16, spacing_m=spacing_m)
    whole, _ = scene.cut()
    parts = [scene.cut(core)[0] for core in quarters(scene, *at_mm)]
    start = np.cumsum([0, *(len(f.kind) for f in parts)])
    held: dict[tuple[int, ...], list[int]] = {}
    for fragments, first in zip(parts, start, strict=False):
        for key, fragment in zip(fragments.crossing_keys.tolist(), fragments.crossing_fragment.tolist(), strict=True):
            held.setdefault(tuple(key), []).append(int(first) + fragment)
    pairs = np.array([(a, b) for members in held.values() for a, b in itertools.pairwise(members)]).reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(start[-1], start[-1]))
    count, component = connected_components(graph, directed=False)
    united = np.zeros((count, N_SUMS), np.int64)
    np.add.at(united, component, np.concatenate([f.sums for f in parts]))
    rows = sorted(row for row in united.tolist() if row[Sum.FACETS] > 0)
    assert rows == sorted(row for row in whole.sums.tolist() if row[Sum.FACETS] > 0)


def test_a_shift_changes_nothing_but_coordinates() -> None:
    shift = -84_000_000
    here, here_labels = built(town, seed=15).cut()
    there, there_labels = built(town, seed=15, corner_mm=shift).cut()
    weights = [*range(Sum.AREA_W), Sum.AREA_W, Sum.LEVEL_W, Sum.GAP_W]
    np.testing.assert_array_equal(there.sums[:, weights], here.sums[:, weights])
    for name, figure in shape_figures(here.sums).items():
        np.testing.assert_allclose(shape_figures(there.sums)[name], figure, err_msg=name)
    np.testing.assert_array_equal(there_labels, here_labels)
    np.testing.assert_array_equal(there.boxes_mm, here.boxes_mm + shift)
    np.testing.assert_array_equal(there.crossing_keys, here.crossing_keys + shift)


def test_a_scene_of_two_points_has_no_fragments() -> None:
    scene = built(lambda x, _: np.full(len(x), 3.0))
    vertices, points = (type(part)(*(values[:2] for values in part)) for part in (scene.vertices, scene.points))
    tin = triangulate(np.column_stack((vertices.x_mm, vertices.y_mm)))
    fragments, labels = Scene(vertices=vertices, tin=tin, points=points).cut()
    assert len(fragments.kind) == len(fragments.sums) == len(fragments.crossing_keys) == 0
    assert labels.tolist() == [-1, -1]
