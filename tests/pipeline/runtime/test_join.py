"""What tiles finish and what they hand on give, joined, what one tile of everything gives."""

import dataclasses
import itertools
import math
import pickle
from collections import Counter
from collections.abc import Sequence

import laspy
import numpy as np
import numpy.typing as npt
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from whole_scene import seen_m, split_alone
from whole_surfaces import WholeSplit, whole_surfaces

from pipeline.kernels.union_find import united
from pipeline.model import IntArray, Tin
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.stages.border_facets import are_beyond, facet_names, shared_facets, united_by_name
from pipeline.runtime.stages.open_fragments import open_fragments
from pipeline.runtime.stages.rehearsal import join_tiles
from pipeline.runtime.stages.sites import FoundSites
from pipeline.runtime.stages.split import Split, SplitFigures
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, WindowPoints
from pipeline.terrain.candidates import CONNECTING, NOWHERE, SOLID
from pipeline.terrain.facets import FacetKind, SceneVertices, VertexKind
from pipeline.terrain.fragment_sums import N_SUMS, Sum
from pipeline.terrain.point_assignment import ScenePoints
from pipeline.terrain.surfaces import Fragments, fragments_of
from pipeline.terrain.terrain_settings import CandidateSettings, ClassesInUse, SceneSettings, SurfaceSettings
from pipeline.tiling import Tile, TileGrid
from pipeline.tin.delaunay import triangulate

CRS = "EPSG:25832"

CUT = SurfaceSettings(max_circumradius_m=2.0)
"""Facets of 1 m fit, and a third tile sees 4 m far: strips along borders begin there."""

EASY = CandidateSettings(
    min_object_area_m2=2.0,
    min_area_m2=3.0,
    doubtful_area_m2=6.0,
    min_width_m=0.5,
    min_planar_share=0.0,
    max_canopy_share=1.0,
    min_top_share=0.4,
    unite_share=0.2,
)
"""Small patches become candidates, join, and are rejected, about as often as they are too small to be listed."""


def handed_on(whole: WholeSplit, grid: TileGrid, cut: SurfaceSettings, judging: CandidateSettings) -> Split:
    """What a split hands on of its fragments; through a pickle, as in a run."""
    surfaces = open_fragments(whole.fragments, whole.keys, whole.starts, whole.tile, grid, cut, judging)
    figures = SplitFigures(tile=whole.tile, points=0, audit=(0, 0, 0), outcome="")
    found = Split(tile=whole.tile, surfaces=surfaces, footprints=None, figures=figures)
    copy: Split = pickle.loads(pickle.dumps(found))
    return copy


def joined(
    wholes: Sequence[WholeSplit], grid: TileGrid, cut: SurfaceSettings, judging: CandidateSettings
) -> tuple[FoundSites, int]:
    """The join of what is handed on: the same in any order of the tiles, and in blocks of all tiles, of two, of one."""
    handed = [handed_on(whole, grid, cut, judging) for whole in wholes]
    found = join_tiles(reversed(handed), grid, judging, CRS)
    for across in (1, 2):
        assert join_tiles(handed, grid, judging, CRS, across) == found
    return found


def sorted_points(tile: Tile, fragments: Fragments, point_fragment: npt.NDArray[np.int32]) -> WholeSplit:
    """The fragments of a tile, and where their points lie once they are sorted."""
    owner = np.sort(point_fragment[point_fragment >= 0]).astype(np.int64)
    keys, starts = np.unique(owner, return_index=True)
    return WholeSplit(tile=tile, fragments=fragments, keys=keys, starts=np.append(starts, len(owner)).astype(np.int64))


# -- patches of many levels --------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class Patchwork:
    """Blocks of random levels, kinds and roughness over flat ground: steps run through all of it."""

    tin: Tin
    vertices: SceneVertices
    points: ScenePoints

    def cut(self, grid: TileGrid) -> list[WholeSplit]:
        """The fragments of all tiles."""
        p = self.points
        columns, rows = grid.columns_rows(p.x_mm, p.y_mm)
        found = []
        for tile in sorted({Tile(c, r) for c, r in zip(columns.tolist(), rows.tolist(), strict=True)}):
            own = np.flatnonzero((columns == tile.column) & (rows == tile.row))
            core = grid.core(tile)
            fragments, labels = fragments_of(
                self.tin,
                self.vertices,
                ScenePoints(*(values[own] for values in p)),
                (core.x0_mm, core.y0_mm, core.x1_mm, core.y1_mm),
                CUT,
                canopy_m=1.0,
                ground_m=0.5,
            )
            found.append(sorted_points(tile, fragments, labels))
        return found


def patchwork(seed: int, *, side_m: int, block_m: float, ground: float) -> Patchwork:
    """A jittered lattice of vertices, all of them points, too; `ground` is the share of blocks without anything."""
    random = np.random.default_rng(seed)
    x, y = (axis.ravel() * 1000 for axis in np.meshgrid(np.arange(side_m), np.arange(side_m)))
    x, y = x + random.integers(0, 400, x.size), y + random.integers(0, 400, y.size)
    blocks = math.ceil(side_m / block_m)
    at = (x / (1000 * block_m)).astype(int), (y / (1000 * block_m)).astype(int)
    level = np.where(random.random((blocks, blocks)) < ground, 0, random.integers(1, 4, (blocks, blocks)))[at]
    kinds = [VertexKind.OBJECT, VertexKind.OBJECT, VertexKind.BUILDING, VertexKind.CROWN]
    solids = random.choice(kinds, (blocks, blocks))
    z = 3000 * level + random.integers(0, 200, x.size)
    kind = np.where(level == 0, VertexKind.GROUND, solids[at]).astype(np.int8)
    # rifts: no point for metres, so that no facet bridges them
    keep = np.abs(x - random.integers(0, 1000 * side_m)) > random.choice([0, 3000])
    x, y, z, kind, level = (column[keep] for column in (x, y, z, kind, level))
    planar = random.integers(-1, 2, x.size).astype(np.int8)
    return Patchwork(
        tin=triangulate(np.column_stack((x, y))),
        vertices=SceneVertices(x_mm=x, y_mm=y, z_mm=z, height_mm=z, kind=kind, planar=planar),
        points=ScenePoints(
            x_mm=x,
            y_mm=y,
            z_mm=z,
            height_mm=z,
            last=np.ones(x.size, np.bool_),
            several=random.random(x.size) < 0.2,
            # what may belong to no building leaves surfaces without points
            allowed=np.where(random.random((blocks, blocks)) < 0.1, 0, 1)[at][keep].astype(np.int8),
        ),
    )


patchworks = st.builds(
    patchwork,
    st.integers(0, 10**6),
    side_m=st.sampled_from([30, 45]),
    block_m=st.sampled_from([2.5, 4.0, 7.0]),
    ground=st.sampled_from([0.0, 0.2, 0.5, 0.8]),
)
grids = st.builds(
    TileGrid,
    size_mm=st.sampled_from([5_000, 9_700, 14_000, 21_000, 32_000]),
    halo_mm=st.just(8_000),
    origin_x_mm=st.integers(-40_000, 40_000),
    origin_y_mm=st.integers(-40_000, 40_000),
)
easy = st.sampled_from(
    [
        EASY,
        CandidateSettings(),
        dataclasses.replace(EASY, unite_share=0.1, unite_reach_m=0.0),
        dataclasses.replace(EASY, unite_share=0.1, unite_reach_m=50.0),
    ]
)


@settings(max_examples=examples(30), deadline=None)
@given(scene=patchworks, grid=grids, judging=easy)
def test_neither_tiles_nor_blocks_nor_order_decide_what_is_found(
    scene: Patchwork, grid: TileGrid, judging: CandidateSettings
) -> None:
    everything = TileGrid(size_mm=200_000, halo_mm=8_000, origin_x_mm=-90_000, origin_y_mm=-90_000)
    (alone,) = [handed_on(whole, everything, CUT, judging) for whole in scene.cut(everything)]
    waiting = alone.surfaces.open
    assert len(waiting.kind) == len(waiting.step_reach) == len(waiting.facets.names) == 0
    whole, small = join_tiles([alone], everything, judging, CRS)
    cut, cut_small = joined(scene.cut(grid), grid, CUT, judging)
    counts = [Counter((c.building_id, c.points) for c in found.candidates) for found in (cut, whole)]
    assert counts[0] == counts[1]
    nowhere = [[dataclasses.replace(r, owner=Tile(0, 0), ranges=()) for r in found.rejected] for found in (cut, whole)]
    assert nowhere[0] == nowhere[1]
    assert cut_small == small


def test_the_patches_have_what_the_join_is_for() -> None:
    """Else the tests above could not fail."""
    seen = Counter[str]()
    for seed in range(6):
        scene = patchwork(seed, side_m=45, block_m=4.0, ground=0.3)
        grid = TileGrid(size_mm=14_000, halo_mm=8_000, origin_x_mm=1000 * seed)
        wholes = scene.cut(grid)
        handed = [handed_on(whole, grid, CUT, EASY) for whole in wholes]
        found, small = join_tiles(handed, grid, EASY, CRS)
        tiles_of = [{part.tile for part in site.ranges} for site in found.candidates]
        surfaces, surface, offsets = whole_surfaces(wholes)
        tile_of = np.repeat(np.arange(len(wholes)), np.diff(offsets))
        steps = np.flatnonzero(np.isin(surfaces.kind, CONNECTING))
        seen["candidates of one tile"] += sum(len(tiles) == 1 for tiles in tiles_of)
        seen["candidates of several tiles"] += sum(len(tiles) > 1 for tiles in tiles_of)
        seen["candidates of several surfaces of a tile"] += sum(
            len(site.ranges) > len(tiles) for site, tiles in zip(found.candidates, tiles_of, strict=True)
        )
        seen["steps through three tiles"] += sum(len(set(tile_of[surface == k].tolist())) > 2 for k in steps)
        seen["reasons"] += len({site.verdict.reason for site in found.rejected})
        seen["small"] += small
        seen["finished in their tile"] += sum(len(s.surfaces.done.kind) for s in handed if s.surfaces)
        named = sum(len(s.surfaces.open.facets.names) for s in handed if s.surfaces)
        kinds = [w.fragments.kind[w.fragments.crossing_fragment] for w in wholes]
        seen["facets that need not be named"] += sum(int(np.isin(kind, SOLID).sum()) for kind in kinds) - named
    assert min(seen.values()) >= 6, seen


# -- fragments by hand -------------------------------------------------------------------------------------------------

CORNER = TileGrid(size_mm=20_000, halo_mm=8_000)
"""Facets around the origin lie where four tiles see them."""
TILES = (Tile(-1, -1), Tile(-1, 0), Tile(0, -1), Tile(0, 0))


def by_hand(tile: Tile, kinds: list[int], facets: list[tuple[int, int]], along: list[tuple[int, int]]) -> WholeSplit:
    """Steps, and roofs whose size depends on the tile's column; facets (number, fragment) around the origin."""
    count = len(kinds)
    roof = {Sum.FACETS: 100, Sum.VERTICES: 50, Sum.HEIGHT: 50 * 6000, Sum.PLANAR: 50, Sum.BOUNDARY: 20_000}
    roof |= {Sum.AREA2: 60_000_000 + 1000 * tile.column, Sum.WALL: 20_000, Sum.WALL_TOP: 20_000, Sum.STEP: 15_000}
    sums = np.zeros((count, N_SUMS), np.int64)
    for column, value in roof.items():
        sums[:, column] = value
    held = [k for k, kind in enumerate(kinds) if kind != FacetKind.STEP]
    points = np.full((count, 3), NOWHERE, np.int64)
    points[held] = np.array([[1000 * tile.column, 1000 * tile.row, k] for k in held], np.int64).reshape(-1, 3)
    return WholeSplit(
        tile=tile,
        fragments=Fragments(
            kind=np.array(kinds, np.int8),
            sums=sums,
            boxes_mm=np.array([[-500, -500, 500, 500]] * count, np.int64),
            lowest_point_mm=points,
            crossing_keys=np.array([facet_at(600 * n - 700, 0) for n, _ in facets], np.int64).reshape(-1, 6),
            crossing_fragment=np.array([k for _, k in facets], np.int32),
            along_steps=np.array([(*pair, 800) for pair in along], np.int64).reshape(-1, 3),
        ),
        keys=np.array(held, np.int64),
        starts=np.arange(len(held) + 1, dtype=np.int64) * 10,
    )


def test_a_step_unites_roofs_of_two_tiles_through_a_third_in_which_nothing_lies_along_it() -> None:
    roof, step = FacetKind.OBJECT, FacetKind.STEP
    west = by_hand(TILES[0], [roof, step], [(0, 1)], [(0, 1)])
    east = by_hand(TILES[3], [roof, step], [(1, 1)], [(0, 1)])
    middle = by_hand(TILES[1], [step], [(0, 0), (1, 0)], [])
    found, _ = joined([west, middle, east], CORNER, CUT, EASY)
    assert [len(site.ranges) for site in found.candidates] == [2]
    without, _ = joined([west, east], CORNER, CUT, EASY)
    assert [len(site.ranges) for site in without.candidates] == [1, 1]


def test_no_tiles_have_no_sites() -> None:
    assert join_tiles([], CORNER, EASY, CRS) == (FoundSites(candidates=(), rejected=()), 0)


# -- towns -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suite", "seed"), [("town", 5), ("city", 1)])
@pytest.mark.parametrize("classes", [ClassesInUse(), ClassesInUse(ground=True, building=True)])
def test_towns_in_tiny_tiles_of_any_size_have_the_same_candidates(
    suite: str, seed: int, classes: ClassesInUse, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Rows of touching houses at several levels, over many tiles of 20 to 40 m."""
    folder = tmp_path_factory.mktemp(suite)
    simulate(suite, folder, seed, size_m=(90.0, 80.0), density_per_m2=2.5)
    files = [laspy.read(path) for path in sorted(folder.rglob("*.laz"))]
    x, y, z, *rest = (
        np.concatenate([np.asarray(las[name]) for las in files])
        for name in ("x", "y", "z", "return_number", "number_of_returns")
    )
    x, y, z = (np.rint(1000 * axis).astype(np.int64) for axis in (x, y, z))
    number, count = (column.astype(np.uint8) for column in rest)
    # as a careless classification would have it: all that is high is a building
    codes = np.where(z < np.percentile(z, 60), GROUND_CLASS, BUILDING_CLASS).astype(np.uint8)
    points = WindowPoints(x_mm=x, y_mm=y, z_mm=z, return_number=number, return_count=count, classification=codes)
    scene = SceneSettings()
    halo = math.ceil(1000 * seen_m(scene, classes))
    sites = []
    for size_mm, origin in ((22_000, 3_700), (38_000, -9_100)):
        grid = TileGrid(size_mm=size_mm, halo_mm=halo, origin_x_mm=origin, origin_y_mm=-origin)
        columns, rows = grid.columns_rows(x, y)
        wholes = []
        for tile in sorted({Tile(c, r) for c, r in zip(columns.tolist(), rows.tolist(), strict=True)}):
            window = grid.window(tile)
            inside = points.take(np.flatnonzero(window.contains(x, y)))
            found = split_alone(inside, grid.core(tile), window, scene, classes)
            wholes.append(sorted_points(tile, found.fragments, found.point_fragment))
        new, _ = joined(wholes, grid, scene.surfaces, scene.candidates)
        assert len(new.candidates) > 5
        assert any(len({part.tile for part in site.ranges}) > 2 for site in new.candidates)
        sites.append([(c.building_id, c.points) for c in new.candidates])
    assert sites[0] == sites[1]


# -- facets ------------------------------------------------------------------------------------------------------------


def test_equal_facets_have_equal_names_and_others_other_ones() -> None:
    random = np.random.default_rng(3)
    keys = np.unique(random.integers(-4, 5, (40_000, 6)) * 1000, axis=0)
    names = facet_names(keys)
    np.testing.assert_array_equal(facet_names(keys.copy()), names)
    for column in (0, 1):
        assert len(np.unique(names[:, column])) == len(keys)
    # each bit is set in half of the names, and the two words of a name tell nothing of each other
    bits = np.unpackbits(names.view(np.uint8).reshape(len(names), 16), axis=1)
    assert np.abs(bits.mean(axis=0) - 0.5).max() < 0.02
    agreement = np.corrcoef(bits.T.astype(np.float64)) - np.eye(128)
    assert np.abs(agreement).max() < 0.03


@given(count=st.integers(1, 12), links=st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=20))
def test_uniting_gives_the_smallest_member_of_each_set(count: int, links: list[tuple[int, int]]) -> None:
    pairs = np.array([(a % count, b % count) for a, b in links], np.int64).reshape(-1, 2)
    label = list(range(count))
    for _ in range(count):
        for a, b in pairs.tolist():
            label[a] = label[b] = min(label[a], label[b])
    assert united(count, pairs[:, 0], pairs[:, 1]).tolist() == label


@given(held=st.lists(st.tuples(st.integers(0, 5), st.integers(0, 1), st.integers(0, 1)), max_size=20))
def test_who_holds_one_name_is_one_set_and_half_a_name_is_none(held: list[tuple[int, int, int]]) -> None:
    table = np.array(held, np.int64).reshape(-1, 3)
    pairs = [(a[0], b[0]) for a, b in itertools.combinations(held, 2) if a[1:] == b[1:]]
    expected = united(6, *np.array(pairs, np.int64).reshape(-1, 2).T.copy())
    found = united_by_name(6, table[:, 1:].astype(np.uint64), table[:, 0])
    assert found.tolist() == expected.tolist()


def facet_at(x: int, y: int) -> list[int]:
    """A facet of half a metre with its smallest vertex there."""
    return [x, y, x + 500, y - 100, x + 480, y + 420]


@pytest.mark.parametrize(
    ("x", "y", "seen", "named"),
    [
        (10_000, 10_000, [False], [False]),  # the middle of its tile
        (19_300, 10_000, [True], [True]),  # reaches over the border: sure, and alone in the strip
        (17_000, 10_000, [True], [True]),  # perhaps seen from the east, through a facet that reaches there
        (19_300, 19_300, [True], [True]),  # a corner
    ],
)
def test_a_facet_alone_is_named_wherever_another_tile_may_see_it(
    x: int, y: int, seen: list[bool], named: list[bool]
) -> None:
    assert shared([facet_at(x, y)]) == (seen, named)


def shared(
    facets: list[list[int]], kinds: list[int] | None = None, tile: Tile = TILES[3]
) -> tuple[list[bool], list[bool]]:
    keys: IntArray = np.array(facets, np.int64)
    kind = np.full(len(keys), FacetKind.OBJECT, np.int8) if kinds is None else np.array(kinds, np.int8)
    reach, named = shared_facets(keys, facet_names(keys), kind, tile, CORNER, CUT)
    return are_beyond(reach, (tile.column, tile.row, tile.column, tile.row)).tolist(), named.tolist()


def along_border(x: int, count: int) -> list[list[int]]:
    """A band of facets that share edges, from south to north."""
    left = [(x, 8_000 + 500 * k) for k in range(count + 1)]
    right = [(x + 500, 8_250 + 500 * k) for k in range(count + 1)]
    facets = []
    for k in range(count):
        facets.append([*left[k], *right[k], *left[k + 1]])
        facets.append([*left[k + 1], *right[k], *right[k + 1]])
    return facets


def test_both_tiles_name_the_same_one_of_connected_facets_along_a_border() -> None:
    band = along_border(19_800, 6)
    here, there = shared(band), shared(band, tile=Tile(1, 0))
    assert here == there
    assert here[0] == [True] * 12
    assert sum(here[1]) == 1
    # without one facet of the band two pieces are left
    assert sum(shared(band[:5] + band[6:])[1]) == 2
    # nor are facets of two kinds connected
    assert sum(shared(band, [3] * 4 + [5] * 4 + [3] * 4)[1]) == 3


def test_facets_that_only_one_of_two_tiles_certainly_sees_are_all_named() -> None:
    assert all(shared(along_border(17_500, 6))[1])
