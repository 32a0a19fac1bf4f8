"""Decks of bridges and vehicles are rejected; houses on slopes, lids of garages and sheds are not."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.model import FloatArray, IntArray, Reason
from pipeline.terrain.candidates import Verdict, judge_surface
from pipeline.terrain.decks_and_vehicles import shape_figures
from pipeline.terrain.facets import FacetKind, SceneVertices, VertexKind
from pipeline.terrain.fragment_sums import Sum
from pipeline.terrain.point_assignment import ScenePoints
from pipeline.terrain.surfaces import fragments_of
from pipeline.terrain.terrain_settings import CandidateSettings, SurfaceSettings
from pipeline.tin.delaunay import triangulate

Elevation = Callable[[FloatArray, FloatArray], FloatArray]

SETTINGS = CandidateSettings()
FAR_MM = 5_938_000_000
"""Squares of such coordinates in dm, weighted, pass 2^63."""


def largest(
    surface_m: Elevation,
    ground_m: Elevation,
    *,
    side_m: float = 50.0,
    spacing_m: float = 0.5,
    turn_deg: float = 0.0,
    corner_mm: int = FAR_MM,
) -> IntArray:
    """Sums of the largest object among jittered vertices on a surface, over some ground; both about the middle."""
    random = np.random.default_rng(7)
    axis = np.arange(-side_m / 2, side_m / 2, spacing_m)
    xy = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    xy = xy + random.uniform(-0.3, 0.3, xy.shape) * spacing_m
    z, ground = surface_m(*xy.T), ground_m(*xy.T)
    angle = np.radians(turn_deg)
    xy = xy @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    x, y, z_mm, height = (np.rint(1000 * v).astype(np.int64) for v in (*xy.T, z, z - ground))
    x, y = x + corner_mm, y + corner_mm
    stands = height >= 500
    vertices = SceneVertices(
        x_mm=x,
        y_mm=y,
        z_mm=z_mm,
        height_mm=height,
        kind=np.where(stands, VertexKind.OBJECT, VertexKind.GROUND).astype(np.int8),
        planar=np.where(stands, 1, -1).astype(np.int8),
    )
    yes, one = np.ones(len(x), np.bool_), np.ones(len(x), np.int8)
    points = ScenePoints(x_mm=x, y_mm=y, z_mm=z_mm, height_mm=height, last=yes, several=~yes, allowed=one)
    core = (corner_mm - 10**6, corner_mm - 10**6, corner_mm + 10**6, corner_mm + 10**6)
    tin = triangulate(np.column_stack((x, y)))
    found, _ = fragments_of(tin, vertices, points, core, SurfaceSettings(), canopy_m=1.0, ground_m=0.5)
    objects = np.flatnonzero(found.kind == FacetKind.OBJECT)
    sums: IntArray = found.sums[objects[np.argmax(found.sums[objects, Sum.AREA2])]]
    return sums


def verdict_on(sums: IntArray, settings: CandidateSettings = SETTINGS) -> Verdict | None:
    return judge_surface(FacetKind.OBJECT, sums, settings)


def cutting(x: FloatArray, y: FloatArray) -> FloatArray:
    """Ground at 0 with a cutting 20 m wide and 4 m deep that runs along y; banks of 3 m."""
    return -4.0 * np.clip((10.0 - np.abs(x)) / 3.0, 0.0, 1.0) + 0.0 * y


def deck(width_m: float, skew: float = 0.0, cars: int = 0) -> Elevation:
    """A deck over the cutting; cars of 1.8 m by 4.5 m, 1.5 m high, stand on it."""

    def surface(x: FloatArray, y: FloatArray) -> FloatArray:
        z = np.where(np.abs(y - skew * x) <= width_m / 2, 0.0, cutting(x, y))
        for car in range(cars):
            at_x, at_y = -6.0 + 6.0 * car, (-1) ** car * width_m / 4
            z = np.where((np.abs(x - at_x) < 2.25) & (np.abs(y - at_y) < 0.9), 1.5, z)
        return z

    return surface


@pytest.mark.parametrize(
    ("width_m", "skew", "cars", "turn_deg"),
    [(2.5, 0.0, 0, 0.0), (8.0, 0.0, 0, 30.0), (8.0, 0.6, 0, 0.0), (24.0, 0.0, 0, 75.0), (10.0, 0.0, 3, 10.0)],
)
def test_a_deck_is_level_with_the_ground_at_two_ends(width_m: float, skew: float, cars: int, turn_deg: float) -> None:
    verdict = verdict_on(largest(deck(width_m, skew, cars), cutting, turn_deg=turn_deg))
    assert verdict is not None
    assert verdict.reason == Reason.BRIDGE
    assert "of two opposite ends" in verdict.detail
    assert "at least 0.6" in verdict.detail


def test_a_deck_beside_a_tall_building_is_a_bridge_and_the_building_is_not() -> None:
    def scene(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.where((np.abs(x) < 6) & (y > 4) & (y < 9), 9.0, deck(8.0)(x, y))

    verdict = verdict_on(largest(scene, cutting))
    assert verdict is not None
    assert verdict.reason == Reason.BRIDGE
    house = largest(lambda x, y: np.where((np.abs(x) < 6) & (y > 4) & (y < 30), 9.0, deck(2.0)(x, y)), cutting)
    assert verdict_on(house) is None


def test_a_deck_that_the_edge_of_the_data_cuts_is_a_bridge() -> None:
    def shifted(x: FloatArray, y: FloatArray) -> FloatArray:
        return cutting(x - 25.0, y)

    verdict = verdict_on(largest(lambda x, y: np.where(np.abs(y) <= 4, 0.0, shifted(x, y)), shifted))
    assert verdict is not None
    assert verdict.reason == Reason.BRIDGE


def footbridge(x: FloatArray, y: FloatArray) -> FloatArray:
    """A deck 2.4 m wide over a wide cutting; its eastern part was not seen."""
    return np.where((np.abs(y) <= 1.2) & (x < 12.0), 0.0, cutting(x / 2.0, y))


def test_a_long_deck_with_a_hidden_end_is_a_bridge_and_a_long_house_in_a_slope_is_not() -> None:
    verdict = verdict_on(largest(footbridge, lambda x, y: cutting(x / 2.0, y)))
    assert verdict is not None
    assert verdict.reason == Reason.BRIDGE
    assert "of one end" in verdict.detail
    house = largest(
        lambda x, y: np.where((np.abs(y) <= 3.0) & (x < 12.0), 0.0, cutting(x / 2.0, y)),
        lambda x, y: cutting(x / 2.0, y),
    )
    assert verdict_on(house) is None


def thing(width_m: float, length_m: float, height_m: float, fence_m: float = 0.0) -> Elevation:
    """An object on flat ground; a fence of some height, 0.6 m thick, stands along one long side of it."""

    def surface(x: FloatArray, y: FloatArray) -> FloatArray:
        fence = np.where((np.abs(y - width_m / 2 - 0.3) <= 0.3) & (np.abs(x) < 12), fence_m, 0.0)
        return np.where((np.abs(x) <= length_m / 2) & (np.abs(y) <= width_m / 2), height_m, fence)

    return surface


def flat(x: FloatArray, y: FloatArray) -> FloatArray:
    return 0.0 * (x + y)


def test_a_hall_that_the_edge_of_the_data_cuts_is_not_a_deck_though_one_side_is_level() -> None:
    def terrace(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.where(x < 9.0, 0.0, -4.0) + 0.0 * y

    assert verdict_on(largest(lambda x, y: np.where(np.abs(y) <= 15, 0.0, terrace(x, y)), terrace)) is None


def on_slope(x: FloatArray, y: FloatArray) -> FloatArray:
    return 0.4 * np.clip(x, -30.0, 30.0) + 0.0 * y


def bank(x: FloatArray, y: FloatArray) -> FloatArray:
    """A bank of 4 m around three sides of a yard of 20 m by 20 m that is open to the west."""
    return np.where((x < 10) & (np.abs(y) < 10), -4.0, 0.0)


@pytest.mark.parametrize(
    ("name", "surface", "ground"),
    [
        ("house on a slope", lambda x, y: np.where((np.abs(x) < 7) & (np.abs(y) < 6), 2.8, on_slope(x, y)), on_slope),
        ("lid of a garage", lambda x, y: np.where((np.abs(x) < 10) & (np.abs(y) < 10), 0.0, bank(x, y)), bank),
        ("house", thing(8.0, 14.0, 5.0), flat),
    ],
)
def test_what_is_level_at_no_or_one_or_three_sides_is_a_candidate(
    name: str, surface: Elevation, ground: Elevation
) -> None:
    sums = largest(surface, ground)
    assert verdict_on(sums) is None, name
    assert shape_figures(sums[None])["end_share"][0] == 0.0


def test_a_share_of_two_lets_every_deck_be_a_candidate() -> None:
    assert verdict_on(largest(deck(8.0), cutting), CandidateSettings(min_deck_end_share=2.0)) is None


@pytest.mark.parametrize("turn_deg", [0.0, 20.0])
@pytest.mark.parametrize(("width_m", "length_m", "height_m"), [(2.1, 5.2, 2.6), (2.3, 7.0, 3.6), (2.3, 14.0, 3.9)])
def test_a_free_narrow_low_object_is_a_vehicle(
    width_m: float, length_m: float, height_m: float, turn_deg: float
) -> None:
    sums = largest(thing(width_m, length_m, height_m), flat, side_m=30.0, spacing_m=0.3, turn_deg=turn_deg)
    verdict = verdict_on(sums)
    assert verdict is not None
    assert verdict.reason == Reason.VEHICLE
    assert "m wide, at most 2.55" in verdict.detail
    assert verdict_on(sums, CandidateSettings(max_vehicle_width_m=0.0)) is None


@pytest.mark.parametrize(
    ("width_m", "length_m", "height_m", "fence_m", "spacing_m"),
    [
        (3.0, 6.0, 2.6, 0.0, 0.3),  # a garage is wider
        (2.3, 3.0, 2.6, 0.0, 0.3),  # a shed is shorter
        (2.3, 10.0, 5.0, 0.0, 0.3),  # a house is higher
        (2.3, 6.0, 2.6, 2.2, 0.3),  # a shed leans on a fence
        (2.3, 6.0, 2.6, 0.0, 1.0),  # where points lie far apart, the width is not known
    ],
)
def test_garages_sheds_and_what_is_not_known_well_are_candidates(
    width_m: float, length_m: float, height_m: float, fence_m: float, spacing_m: float
) -> None:
    assert verdict_on(largest(thing(width_m, length_m, height_m, fence_m), flat, spacing_m=spacing_m)) is None


@pytest.mark.parametrize("turn_deg", [0.0, 35.0])
def test_sizes_come_from_moments_wherever_the_scene_lies(turn_deg: float) -> None:
    sums = [largest(thing(8.0, 14.0, 5.0), flat, turn_deg=turn_deg, corner_mm=corner) for corner in (0, FAR_MM)]
    near, far = (shape_figures(one[None]) for one in sums)
    assert near["across_m"][0] == pytest.approx(8.0, abs=0.3)
    assert near["along_m"][0] == pytest.approx(14.0, abs=0.3)
    assert {name: float(v[0]) for name, v in far.items()} == pytest.approx({n: float(v[0]) for n, v in near.items()})
