"""Whole surfaces are judged by hand-made sums; levels unite whatever their numbers."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.model import IntArray, Reason
from pipeline.terrain.candidates import (
    NOWHERE,
    REASON_OF_FAULT,
    Fault,
    Surfaces,
    Verdict,
    are_glass,
    are_objects,
    judge_surface,
    judge_surfaces,
    unite_levels,
)
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.fragment_sums import MOMENTS, N_SUMS, Sum
from pipeline.terrain.terrain_settings import CandidateSettings

SETTINGS = CandidateSettings()

ROOF: dict[Sum, int] = {
    Sum.FACETS: 800,
    Sum.AREA2: 200_000_000,
    Sum.VERTICES: 400,
    Sum.HEIGHT: 400 * 5000,
    Sum.PLANAR: 380,
    Sum.ROUGH: 20,
    Sum.BOUNDARY: 40_000,
    Sum.WALL: 40_000,
    Sum.WALL_TOP: 39_000,
    Sum.WALLS: 80,
    Sum.WALLS_Z_MX: 80 * 8200,
    Sum.WALLS_OWN_Z: 80 * 8100,
    Sum.POINTS: 1600,
}
"""A flat roof of 100 m2, 5 m above the ground, walls all around; its edges lie 0.25 m beyond its outermost points."""

DOUBTFUL: dict[Sum, int] = {Sum.PLANAR: 240, Sum.ROUGH: 160}
"""Planar enough for a building, not enough to be sure of it."""

SHED: dict[Sum, int] = {
    Sum.FACETS: 24,
    Sum.AREA2: 6_100_000,
    Sum.HEIGHT: 400 * 3000,
    Sum.BOUNDARY: 7000,
    Sum.WALL: 7000,
    Sum.WALL_TOP: 7000,
}
"""Facets of 3.05 m2 whose edges enclose 5.01 m2, 3 m above the ground and 1.17 m wide in the mean."""


def sums_of(changes: dict[Sum, int] | None = None) -> IntArray:
    sums = np.zeros(N_SUMS, np.int64)
    for column, value in {**ROOF, **(changes or {})}.items():
        sums[column] = value
    return sums


def judged(changes: dict[Sum, int], kind: FacetKind = FacetKind.OBJECT) -> Verdict | None:
    return judge_surface(kind, sums_of(changes), SETTINGS)


def test_a_roof_with_walls_around_it_is_a_candidate() -> None:
    assert judged({}) is None
    assert judged({}, FacetKind.BUILDING) is None


@pytest.mark.parametrize(
    ("changes", "reason", "detail"),
    [
        ({**SHED, Sum.AREA2: 6_000_000}, Reason.TOO_SMALL, "area 4.9 m2, at least 5"),
        (
            {**DOUBTFUL, Sum.FACETS: 80, Sum.AREA2: 20_000_000, Sum.BOUNDARY: 30_000},
            Reason.TOO_SMALL,
            "area 17.7 m2, at least 20",
        ),
        ({Sum.HEIGHT: 400 * 1500}, Reason.TOO_LOW, "top 1.50 m above the terrain, at least 2"),
        ({Sum.PLANAR: 40, Sum.ROUGH: 60}, Reason.VEGETATION, "planar share 0.40, at least 0.5"),
        (
            {Sum.SEVERAL: 800, Sum.THROUGH: 320},
            Reason.VEGETATION,
            "pulses of 0.20 of its points go on below, at most 0.18",
        ),
        ({Sum.CANOPY: 1600}, Reason.VEGETATION, "canopy share 0.50, at most 0.35"),
        (
            {**DOUBTFUL, Sum.BOUNDARY: 200_000, Sum.WALL: 200_000},
            Reason.TOO_NARROW,
            "mean width 1.49 m, at least 2",
        ),
        ({Sum.BOUNDARY: 600_000, Sum.WALL: 600_000}, Reason.TOO_NARROW, "mean width 0.83 m, at least 1"),
        ({Sum.WALL: 4000, Sum.WALL_TOP: 4000}, Reason.NO_WALLS, "walls along 0.10 of the outline, at least 0.15"),
        (
            {**DOUBTFUL, Sum.WALL_TOP: 8000},
            Reason.BELOW_Z_AVG,
            "at the top of 0.20 of its walls, at least 0.3 (own 8.10 m, Z_avg 8.20 m)",
        ),
    ],
)
def test_each_reason_names_its_figure_and_threshold(changes: dict[Sum, int], reason: Reason, detail: str) -> None:
    assert judged(changes) == Verdict(reason=reason, detail=detail)


@pytest.mark.parametrize(
    ("at_limit", "beyond"),
    [
        (SHED, {**SHED, Sum.AREA2: 6_000_000}),
        # a small surface is no sure roof where it stands high and narrow
        ({**SHED, Sum.HEIGHT: 400 * 3450}, {**SHED, Sum.HEIGHT: 400 * 3550}),
        # a sure roof may lie at the foot of its walls, as annexes do
        ({Sum.PLANAR: 300, Sum.ROUGH: 100, Sum.WALL_TOP: 0}, {Sum.PLANAR: 299, Sum.ROUGH: 101, Sum.WALL_TOP: 0}),
        ({Sum.HEIGHT: 400 * 2000}, {Sum.HEIGHT: 400 * 2000 - 1}),
        # of a pitched roof the ridge counts: heights from 1.6 to 2.0 m in the first, to 1.96 m in the second
        (
            {Sum.HEIGHT: 400 * 1800, Sum.HEIGHT2: 400 * (1800**2 + 13_400)},
            {Sum.HEIGHT: 400 * 1780, Sum.HEIGHT2: 400 * (1780**2 + 10_800)},
        ),
        ({Sum.PLANAR: 50, Sum.ROUGH: 50}, {Sum.PLANAR: 49, Sum.ROUGH: 51}),
        ({Sum.POINTS: 65, Sum.CANOPY: 35}, {Sum.POINTS: 64, Sum.CANOPY: 36}),
        # the few points of a small surface show less
        (
            {Sum.POINTS: 20, Sum.SEVERAL: 8, Sum.THROUGH: 4},
            {Sum.POINTS: 1600, Sum.SEVERAL: 640, Sum.THROUGH: 320},
        ),
        # a surface as smooth as the scanner measures is a roof whose edges many pulses meet
        (
            {Sum.SMOOTH: 88, Sum.SEVERAL: 800, Sum.THROUGH: 640},
            {Sum.SMOOTH: 87, Sum.SEVERAL: 800, Sum.THROUGH: 640},
        ),
        # a scanner that records a first and a last echo of each pulse shows nothing
        ({Sum.SEVERAL: 1600, Sum.THROUGH: 800}, {Sum.SEVERAL: 1599, Sum.THROUGH: 800}),
        # a rough roof that hardly any pulse pierces; a scanner of single returns shows nothing of the kind
        ({Sum.PLANAR: 0, Sum.ROUGH: 380, Sum.SEVERAL: 160}, {Sum.PLANAR: 0, Sum.ROUGH: 380}),
        ({Sum.PLANAR: 0, Sum.ROUGH: 0, Sum.SEVERAL: 160}, {Sum.PLANAR: 0, Sum.ROUGH: 0, Sum.SEVERAL: 240}),
        ({Sum.WALL: 6000, Sum.WALL_TOP: 6000}, {Sum.WALL: 5999, Sum.WALL_TOP: 5999}),
        ({**DOUBTFUL, Sum.WALL_TOP: 12_000}, {**DOUBTFUL, Sum.WALL_TOP: 11_999}),
    ],
)
def test_a_figure_at_its_threshold_passes_and_one_beyond_fails(
    at_limit: dict[Sum, int], beyond: dict[Sum, int]
) -> None:
    assert judged(at_limit) is None
    assert judged(beyond) is not None


def test_a_crown_is_vegetation_whatever_its_figures() -> None:
    verdict = judged({}, FacetKind.CROWN)
    assert verdict is not None
    assert verdict.reason == Reason.VEGETATION
    # no threshold is named that the figure passes
    assert verdict.detail == "a crown: most of what surrounds its vertices is rough, planar share 0.95"


def test_a_surface_of_unknown_planarity_is_not_taken_for_a_roof() -> None:
    verdict = judged({Sum.PLANAR: 0, Sum.ROUGH: 0})
    assert verdict is not None
    assert verdict.reason == Reason.TOO_FEW_POINTS


def test_building_by_trusted_classes_needs_only_its_area() -> None:
    bare: dict[Sum, int] = {column: 0 for column in ROOF if column not in {Sum.FACETS, Sum.AREA2, Sum.POINTS}}
    assert judged(bare, FacetKind.BUILDING) is None
    small = judged({**bare, Sum.AREA2: 8_000_000}, FacetKind.BUILDING)
    assert small is not None
    assert small.reason == Reason.TOO_SMALL


@pytest.mark.parametrize(
    ("kind", "area_m2", "listed"),
    [
        (FacetKind.OBJECT, 4.0, True),
        (FacetKind.OBJECT, 3.9, False),
        (FacetKind.BUILDING, 4.0, True),
        (FacetKind.CROWN, 4.0, True),
        (FacetKind.STEP, 100.0, False),
        (FacetKind.GROUND, 100.0, False),
        (FacetKind.GROUND, 500.0, False),
    ],
)
def test_an_object_is_a_surface_of_some_size_above_the_ground(kind: FacetKind, area_m2: float, listed: bool) -> None:
    sums = sums_of({Sum.AREA2: round(area_m2 * 2e6)})
    assert are_objects(np.array([kind], np.int8), sums[None], SETTINGS).tolist() == [listed]


def test_a_share_beyond_one_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"min_planar_share is 1\.5"):
        CandidateSettings(min_planar_share=1.5)


columns = st.integers(0, 10**9)
figures = st.fixed_dictionaries(
    {
        Sum.FACETS: st.integers(0, 5000),
        Sum.AREA2: st.one_of(columns, st.sampled_from([8_000_000, 6_100_000, 36_000_000, 60_000_000])),
        Sum.VERTICES: st.integers(0, 500),
        Sum.HEIGHT: st.integers(0, 400 * 9000),
        Sum.HEIGHT2: st.integers(0, 400 * 9000**2),
        Sum.PLANAR: st.integers(0, 400),
        Sum.ROUGH: st.integers(0, 400),
        Sum.BOUNDARY: st.integers(0, 200_000),
        Sum.WALL: st.integers(0, 200_000),
        Sum.WALL_TOP: st.integers(0, 200_000),
        Sum.STEP: st.integers(0, 200_000),
        Sum.WALLS: st.integers(0, 200),
        Sum.WALLS_Z_MX: st.integers(-(10**6), 10**6),
        Sum.WALLS_OWN_Z: st.integers(-(10**6), 10**6),
        Sum.POINTS: st.integers(0, 5000),
        Sum.CANOPY: st.integers(0, 2000),
        Sum.SEVERAL: st.integers(0, 1000),
        Sum.THROUGH: st.integers(0, 1000),
        Sum.SMOOTH: st.integers(0, 400),
        Sum.OPEN: st.integers(0, 200_000),
        Sum.SEAM: st.integers(0, 6_000),
        Sum.GLASS: st.integers(0, 2_000),
    }
)
weights = st.lists(st.tuples(st.integers(1, 10**6), st.integers(0, 400), st.integers(0, 400)), max_size=6)


def moments_of(first: Sum, weighted: list[tuple[int, int, int]]) -> dict[Sum, int]:
    """The six moments of weights and places in dm, far from the origin; they wrap at 2^63."""
    far = [(w, x + 59_380_000, y + 59_380_000) for w, x, y in weighted]
    rows = [(w, w * x, w * y, w * x * x, w * x * y, w * y * y) for w, x, y in far]
    return {Sum(first + k): (sum(row[k] for row in rows) + 2**63) % 2**64 - 2**63 for k in range(MOMENTS)}


some_shapes = st.tuples(weights, weights, weights).map(
    lambda drawn: {
        **moments_of(Sum.AREA_W, drawn[0]),
        **moments_of(Sum.LEVEL_W, drawn[1]),
        **moments_of(Sum.GAP_W, drawn[2]),
    }
)
some_sums = st.tuples(figures, some_shapes).map(lambda drawn: {**drawn[0], **drawn[1]})
"""Anything, and more often than by chance what lies at a threshold or passes most of them."""
nearly_roofs = st.tuples(some_sums, st.sets(st.sampled_from(list(Sum)), max_size=4)).map(
    lambda drawn: {column: drawn[0][column] for column in drawn[1]}
)


@settings(deadline=None, max_examples=examples(300))
@given(
    rows=st.lists(st.one_of(some_sums, nearly_roofs), min_size=1, max_size=8),
    kinds=st.lists(st.sampled_from(FacetKind), min_size=8, max_size=8),
    somewhere=st.lists(st.booleans(), min_size=8, max_size=8),
)
def test_many_surfaces_are_judged_like_each_on_its_own(
    rows: list[dict[Sum, int]], kinds: list[FacetKind], somewhere: list[bool]
) -> None:
    surfaces = surfaces_of(rows, [], kinds[: len(rows)])
    surfaces.lowest_point_mm[~np.array(somewhere[: len(rows)])] = NOWHERE
    found = judge_surfaces(surfaces, SETTINGS)
    for k, kind in enumerate(kinds[: len(rows)]):
        if kind in {FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.CROWN}:
            verdict = judge_surface(kind, surfaces.sums[k], SETTINGS)
            if verdict is None:
                assert found[k] == (Fault.NONE if somewhere[k] else Fault.NOT_JUDGED)
            else:
                assert REASON_OF_FAULT[Fault(found[k])] == verdict.reason
        else:
            assert found[k] == Fault.NOT_JUDGED


# -- levels ------------------------------------------------------------------------------------------------------------


def surfaces_of(
    rows: list[dict[Sum, int]], along: list[tuple[int, int]], kinds: list[FacetKind] | None = None
) -> Surfaces:
    """Surfaces of these sums: steps and objects, unless the kinds are given."""
    count = len(rows)
    usual = [FacetKind.STEP if row is STEP_ROW else FacetKind.OBJECT for row in rows]
    return Surfaces(
        kind=np.array(usual if kinds is None else kinds, np.int8),
        sums=np.array([sums_of(changes) for changes in rows]).reshape(count, N_SUMS),
        boxes_mm=np.zeros((count, 4), np.int64),
        lowest_point_mm=np.array([[1000 * k, 0, 0] for k in range(count)], np.int64).reshape(count, 3),
        along_steps=np.array(along, np.int64).reshape(-1, 2),
    )


def leaders(surfaces: Surfaces) -> list[int]:
    return [int(k) for k in unite_levels(surfaces, judge_surfaces(surfaces, SETTINGS), SETTINGS)]


DORMER = {Sum.AREA2: 12_000_000, Sum.BOUNDARY: 10_000, Sum.WALL: 9000, Sum.WALL_TOP: 9000, Sum.STEP: 9000}
STEP_ROW = {Sum.AREA2: 1_000_000}
STOREYS = [{Sum.STEP: 30_000, Sum.AREA2: area2} for area2 in (60_000_000, 120_000_000, 200_000_000)]


def test_a_dormer_alone_is_no_candidate() -> None:
    assert judge_surface(FacetKind.OBJECT, sums_of(DORMER), SETTINGS) is not None


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ({}, DORMER, [0, 0]),
        # what is hardly along steps, or like no roof, stays out
        ({}, {**DORMER, Sum.STEP: 4900}, [0, -1]),
        ({}, {**DORMER, Sum.HEIGHT: 400 * 1900}, [0, -1]),
        ({}, {**DORMER, Sum.PLANAR: 10, Sum.ROUGH: 90}, [0, -1]),
        ({}, {**DORMER, Sum.CANOPY: 3000}, [0, -1]),
        # two equal roofs join at the smaller point
        ({Sum.STEP: 30_000}, {Sum.STEP: 30_000}, [0, 0]),
        # a candidate beside something that is none leads itself
        ({Sum.PLANAR: 0, Sum.ROUGH: 100, Sum.AREA2: 800_000_000}, {Sum.STEP: 40_000}, [-1, 1]),
    ],
)
def test_two_surfaces_across_a_step_join_where_both_are_like_roofs(
    one: dict[Sum, int], other: dict[Sum, int], expected: list[int]
) -> None:
    assert leaders(surfaces_of([one, other, STEP_ROW], [(0, 2), (1, 2)])) == [*expected, -1]


@pytest.mark.parametrize(("step", "leader"), [(9000, 0), (4900, -1)])
def test_a_small_surface_of_class_6_joins_whatever_its_surroundings(step: int, leader: int) -> None:
    part = {**DORMER, Sum.STEP: step, Sum.AREA2: 1_000_000, Sum.PLANAR: 0, Sum.ROUGH: 0}
    kinds = [FacetKind.BUILDING, FacetKind.BUILDING, FacetKind.STEP]
    assert leaders(surfaces_of([{}, part, STEP_ROW], [(0, 2), (1, 2)], kinds)) == [0, leader, -1]


@pytest.mark.parametrize(
    ("rows", "along", "expected"),
    [
        ([{Sum.AREA2: 150_000_000}, {}, DORMER], [(1, 3), (2, 3), (2, 4), (0, 4)], [0, 1, 1]),
        (STOREYS, [(0, 3), (1, 3), (1, 4), (2, 4)], [2, 2, 2]),
    ],
    ids=["of the roofs beside a dormer", "of a chain of storeys"],
)
def test_the_largest_leads(rows: list[dict[Sum, int]], along: list[tuple[int, int]], expected: list[int]) -> None:
    assert leaders(surfaces_of([*rows, STEP_ROW, STEP_ROW], along)) == [*expected, -1, -1]


def test_no_surfaces_have_no_leaders() -> None:
    assert leaders(surfaces_of([], [])) == []


scenes = st.lists(
    st.tuples(
        st.sampled_from([8_000_000, 60_000_000, 60_000_000, 200_000_000, 900_000_000]),
        st.sampled_from([0, 20_000, 40_000]),
        st.sampled_from([0, 39_000]),
        st.sampled_from([FacetKind.OBJECT, FacetKind.OBJECT, FacetKind.BUILDING, FacetKind.GROUND]),
    ),
    min_size=1,
    max_size=7,
)


def drawn(members: list[tuple[int, int, int, FacetKind]], links: list[tuple[int, int]]) -> Surfaces:
    """Surfaces first, then four steps."""
    rows = [{Sum.AREA2: area, Sum.STEP: step, Sum.WALL_TOP: top} for area, step, top, _ in members]
    kinds = [*(kind for *_, kind in members), *[FacetKind.STEP] * 4]
    along = sorted({(s % len(members), len(members) + step) for s, step in links})
    return surfaces_of([*rows, *[STEP_ROW] * 4], along, kinds)


link_lists = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 3)), max_size=14)


def is_solid(kind: int) -> bool:
    return kind not in {FacetKind.STEP, FacetKind.GROUND}


@settings(deadline=None, max_examples=examples(200))
@given(members=scenes, links=link_lists)
def test_every_leader_is_a_candidate_that_leads_itself(
    members: list[tuple[int, int, int, FacetKind]], links: list[tuple[int, int]]
) -> None:
    surfaces = drawn(members, links)
    found = leaders(surfaces)
    for k, lead in enumerate(found):
        if lead >= 0:
            assert found[lead] == lead
            assert judge_surface(int(surfaces.kind[lead]), surfaces.sums[lead], SETTINGS) is None
        else:
            assert not is_solid(surfaces.kind[k]) or judge_surface(int(surfaces.kind[k]), surfaces.sums[k], SETTINGS)


@settings(deadline=None, max_examples=examples(200))
@given(members=scenes, links=link_lists, seed=st.integers(0, 10_000))
def test_the_numbering_of_the_surfaces_does_not_matter(
    members: list[tuple[int, int, int, FacetKind]], links: list[tuple[int, int]], seed: int
) -> None:
    surfaces = drawn(members, links)
    count = len(surfaces.kind)
    random = np.random.default_rng(seed)
    order = random.permutation(count)
    number_of = np.argsort(order)
    along = surfaces.along_steps.copy()
    along[:, 0], along[:, 1] = number_of[along[:, 0]], number_of[along[:, 1]]
    renumbered = Surfaces(
        kind=surfaces.kind[order],
        sums=surfaces.sums[order],
        boxes_mm=surfaces.boxes_mm[order],
        lowest_point_mm=surfaces.lowest_point_mm[order],
        along_steps=random.permutation(along),
    )
    back = [order[lead] if lead >= 0 else -1 for lead in leaders(renumbered)]
    assert [back[number_of[k]] for k in range(count)] == leaders(surfaces)


def test_a_candidate_is_of_glass_by_all_points_of_its_surfaces() -> None:
    seen_through = [(30, 100), (0, 500), (200, 300), (0, 0), (0, 40)]
    sums = np.zeros((5, N_SUMS), np.int64)
    sums[:, [Sum.GLASS, Sum.POINTS]] = seen_through
    # a conservatory of a large house, a greenhouse, nothing, tiles
    assert are_glass(sums, np.array([0, 0, 1, 2, 3]), 4).tolist() == [False, True, False, False]
