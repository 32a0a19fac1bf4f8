"""Tiles of a survey give together what the whole gives; wet roofs and survey faults do what they say."""

import dataclasses

import numpy as np
import pytest
from simulated import placed, scene_on

from pipeline.model import BoolArray, FloatArray
from pipeline.ruler.simulation.als import ScanBlock, ScannerSettings, joined, reach_m, scan, scan_all, strip_count
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import (
    FaultKind,
    Scene,
    SurveyFault,
    Terrain,
    WetSpot,
    undulating_terrain,
)
from pipeline.ruler.simulation.strips import flight_lines, lines_over, strip_shifts_m
from pipeline.ruler.simulation.town import town

WHOLE = (0.0, 0.0, 220.0, 160.0)
TOWN = dataclasses.replace(town(5, size_m=WHOLE[2:]), survey_extent=WHOLE)
SURVEY = ScannerSettings(
    pulse_density_per_m2=6.0,
    altitude_m=700.0,
    strip_spacing_m=90.0,
    strip_overlap=0.2,
    strip_shift_m=0.1,
    strip_lift_m=0.05,
    wrong_row_share=0.01,
    wrong_row_lift_m=0.7,
)
TALLEST_M = 30.0
FIELD = scene_on(Terrain(base_z_m=7.0), 100)
QUIET = ScannerSettings(range_noise_m=0.0, drop_out=0.0, altitude_m=2000.0, strip_spacing_m=60.0)


def tile_of(scene: Scene, extent: tuple[float, float, float, float], settings: ScannerSettings) -> Scene:
    """What a tile must hold, and no more."""
    reach = reach_m(scene.terrain, extent, settings, TALLEST_M)

    def is_near(plan: FloatArray, radius_m: float = 0.0) -> bool:
        (x0, y0), (x1, y1) = plan[:, :2].min(axis=0) - radius_m, plan[:, :2].max(axis=0) + radius_m
        return x0 < extent[2] + reach and y0 < extent[3] + reach and x1 > extent[0] - reach and y1 > extent[1] - reach

    return dataclasses.replace(
        scene,
        extent=extent,
        buildings=tuple(one for one in scene.buildings if is_near(one.vertices)),
        boxes=tuple(one for one in scene.boxes if is_near(one.corners)),
        trees=tuple(one for one in scene.trees if is_near(np.array([[one.x, one.y]]), one.crown_radius_m)),
        survey_faults=tuple(one for one in scene.survey_faults if is_near(np.reshape(one.extent, (2, 2)))),
    )


def rows(block: ScanBlock, scene: Scene) -> list[tuple[object, ...]]:
    """Every return with all that is known of it, sorted; buildings by name."""
    names = [*(building.building_id for building in scene.buildings), ""]
    cloud = block.points
    return sorted(
        zip(
            cloud.gps_time.tolist(),
            cloud.return_number.tolist(),
            cloud.return_count.tolist(),
            *cloud.xyz.T.tolist(),
            cloud.source_id.tolist(),
            cloud.classification.tolist(),
            block.intensity.tolist(),
            block.scan_angle_deg.tolist(),
            [names[k] for k in block.building.tolist()],
            block.face.tolist(),
            block.mixed.tolist(),
            strict=True,
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "azimuth_deg", [37.0, 251.0, *(pytest.param(along, marks=pytest.mark.slow) for along in (0.0, 90.0))]
)
def test_the_tiles_of_a_survey_give_together_the_returns_of_the_whole(azimuth_deg: float) -> None:
    fault = SurveyFault(extent=(60, 40, 130, 90), kind=FaultKind.STRIP_SHIFT, shift=(0.4, 0.2, -0.1), azimuth_deg=20.0)
    row_fault = SurveyFault(extent=(100, 70, 190, 140), kind=FaultKind.WRONG_ROWS, shift=(0, 0, 0.9), share=0.2)
    scene = dataclasses.replace(TOWN, survey_faults=(fault, row_fault))
    settings = dataclasses.replace(SURVEY, flight_azimuth_deg=azimuth_deg)
    whole = scan_all(scene, settings, 4)
    assert whole.points.classification.tolist().count(5) > 2000
    assert set(whole.points.source_id.tolist()) == set(range(1, strip_count(scene, settings) + 1))
    found: list[tuple[object, ...]] = []
    for x0, x1 in ((0.0, 73.3), (73.3, 150.0), (150.0, 220.0)):
        for y0, y1 in ((0.0, 91.7), (91.7, 160.0)):
            tile = tile_of(scene, (x0, y0, x1, y1), settings)
            assert len(tile.trees) < 0.75 * len(scene.trees)
            assert strip_count(tile, settings) == strip_count(scene, settings)
            found += rows(joined(list(scan(tile, settings, 4, chunk_points=20_000))), tile)
    assert sorted(found) == rows(whole, scene)


@pytest.mark.slow
def test_tiles_of_a_steep_survey_hold_what_their_beams_can_reach() -> None:
    random = np.random.default_rng(8)
    terrain = undulating_terrain(100.0, 25.0, 100.0, 2.0, 200.0, random)
    size = RoofDimensions(length_m=12.0, width_m=9.0, pitch_deg=35.0)
    houses = tuple(
        placed(RoofShape.GABLE, size, at=(x, y), azimuth_deg=float(random.uniform(0, 360)), terrain=terrain)
        for x, y in random.uniform(10, 150, (30, 2)).tolist()
    )
    houses = tuple(dataclasses.replace(one, building_id=str(k)) for k, one in enumerate(houses))
    scene = dataclasses.replace(TOWN, terrain=terrain, buildings=houses, trees=(), boxes=())
    settings = dataclasses.replace(SURVEY, altitude_m=300.0)
    whole = scan_all(scene, settings, 1)
    found: list[tuple[object, ...]] = []
    for x0, x1 in ((0.0, 110.0), (110.0, 220.0)):
        tile = tile_of(scene, (x0, 0.0, x1, 160.0), settings)
        found += rows(scan_all(tile, settings, 1), tile)
    assert sorted(found) == rows(whole, scene)
    assert (whole.building >= 0).sum() > 5000


def test_a_tile_runs_only_the_scan_lines_that_can_touch_it() -> None:
    survey = (0.0, 0.0, 40_000.0, 40_000.0)
    tile = dataclasses.replace(FIELD, survey_extent=survey, extent=(20_000.0, 20_000.0, 20_100.0, 20_100.0))
    for azimuth_deg in (0.0, 90.0, 33.0):
        settings = dataclasses.replace(QUIET, flight_azimuth_deg=azimuth_deg, strip_spacing_m=200.0)
        lines = [lines_over(flight, tile, settings) for flight in flight_lines(tile, settings, 1)]
        assert sum(len(needed) > 0 for needed in lines) <= 2
        assert max(len(needed) for needed in lines) < 150.0 / settings.pulse_spacing_m
        assert len(scan_all(tile, settings, 1)) == pytest.approx(80_000, rel=0.2)


def test_a_scene_of_its_own_is_scanned_as_its_own_survey() -> None:
    plain = dataclasses.replace(FIELD, terrain=TOWN.terrain, buildings=TOWN.buildings, boxes=TOWN.boxes)
    as_tile = dataclasses.replace(plain, survey_extent=plain.extent)
    assert rows(scan_all(plain, SURVEY, 2), plain) == rows(scan_all(as_tile, SURVEY, 2), as_tile)


def with_hall(*wet_spots: WetSpot) -> Scene:
    """The field with a flat roof of 30 x 20 m."""
    size, stand = RoofDimensions(length_m=30.0, width_m=20.0), {"azimuth_deg": 90.0, "eave_height_m": 6.0}
    dry = placed(RoofShape.FLAT, size, at=(50.0, 50.0), terrain=FIELD.terrain, **stand)
    return dataclasses.replace(FIELD, buildings=(dataclasses.replace(dry, wet_spots=wet_spots),))


def test_a_wet_spot_takes_the_returns_of_its_roof_and_no_others() -> None:
    spots = (WetSpot(x=45.0, y=52.0, radius_m=3.0), WetSpot(x=65.0, y=50.0, radius_m=2.5))
    dry, wet = scan_all(with_hall(), QUIET, 1), scan_all(with_hall(*spots), QUIET, 1)
    roof = np.isin(dry.building, 0) & (dry.face == 0)

    def in_spot(xyz: FloatArray) -> BoolArray:
        within: BoolArray = np.zeros(len(xyz), bool)
        for spot in spots:
            within |= np.hypot(xyz[:, 0] - spot.x, xyz[:, 1] - spot.y) < spot.radius_m
        return within

    taken = in_spot(dry.points.xyz)
    assert (taken & roof).sum() > 200
    assert (taken & ~roof).sum() > 50  # the second spot reaches over the edge of the roof
    kept = {row[3:6] for row in rows(wet, with_hall(*spots))}
    single = dry.points.return_count == 1
    expected = [tuple(xyz) for xyz in dry.points.xyz[single & ~(taken & roof) & ~dry.mixed].tolist()]
    assert kept >= set(expected)
    assert not (in_spot(wet.points.xyz) & (wet.face == 0) & ~wet.mixed).any()
    assert (in_spot(wet.points.xyz) & (wet.points.classification == 2)).sum() > 50


def test_a_wet_roof_does_not_hide_what_lies_beside_it_in_a_beam() -> None:
    """Half of a beam at the eave still gives the return of the ground."""
    drowned = with_hall(WetSpot(x=50.0, y=50.0, radius_m=60.0))
    block = scan_all(drowned, dataclasses.replace(QUIET, beam_radius_m=0.5), 1)
    assert not (block.face == 0).any()
    x, y = block.points.xyz[:, 0], block.points.xyz[:, 1]
    beside = (np.abs(np.abs(x - 50.0) - 15.0) < 0.3) & (np.abs(y - 50.0) < 9.0)
    assert beside.sum() > 20
    full = block.intensity.max()
    assert (block.intensity[beside] < 0.95 * full).mean() > 0.3
    assert ((block.points.classification == 2) | block.wall).all()


def test_a_shift_of_strips_moves_what_lies_right_of_its_border() -> None:
    shift = (0.5, -0.25, 0.3)
    fault = SurveyFault(extent=(20, 30, 80, 70), kind=FaultKind.STRIP_SHIFT, shift=shift, azimuth_deg=45.0)
    before = scan_all(FIELD, QUIET, 1).points.xyz
    after = scan_all(dataclasses.replace(FIELD, survey_faults=(fault,)), QUIET, 1).points.xyz
    x, y = before[:, 0], before[:, 1]
    wrong = (x >= 20) & (x < 80) & (y >= 30) & (y < 70) & (x - 50 > y - 50)  # north-east is the border's direction
    assert wrong.sum() > 5000
    near = np.abs((x - 50) - (y - 50)) < 0.01
    assert np.abs(after - before - wrong[:, None] * np.array(shift))[~near].max() < 0.0011


def test_returns_of_another_strip_carry_its_number_and_its_shift_is_known() -> None:
    shift = (0.5, -0.25, 0.3)
    fault = SurveyFault(extent=(5, 30, 35, 70), kind=FaultKind.STRIP_SHIFT, shift=shift, azimuth_deg=45.0)
    named = dataclasses.replace(FIELD, survey_faults=(dataclasses.replace(fault, other_strip=0),))
    survey = dataclasses.replace(QUIET, strip_spacing_m=60.0, strip_overlap=0.0, strip_shift_m=0.2, strip_lift_m=0.1)
    before = scan_all(FIELD, survey, 1).points
    unnamed = scan_all(dataclasses.replace(FIELD, survey_faults=(fault,)), survey, 1).points
    after = scan_all(named, survey, 1).points
    assert np.array_equal(after.xyz, unnamed.xyz)
    assert np.array_equal(unnamed.source_id, before.source_id)
    flown = strip_count(FIELD, survey)
    moved = (after.xyz != before.xyz).any(axis=1)
    assert np.array_equal(after.source_id == flown + 1, moved)
    assert np.array_equal(after.source_id[~moved], before.source_id[~moved])
    shifts = np.array(strip_shifts_m(named, survey, 1))
    assert len(shifts) == flown + 1
    over = np.bincount(before.source_id[moved]).argmax() - 1
    assert shifts[flown] == pytest.approx(shifts[over] + shift)


def test_wrong_rows_are_whole_rows_and_as_many_as_asked_for() -> None:
    fault = SurveyFault(extent=(20, 30, 80, 70), kind=FaultKind.WRONG_ROWS, shift=(0.0, 0.0, 0.8), share=0.25)
    plain, faulty = scan_all(FIELD, QUIET, 3), scan_all(dataclasses.replace(FIELD, survey_faults=(fault,)), QUIET, 3)
    x, y = plain.points.xyz[:, 0], plain.points.xyz[:, 1]
    inside = (x >= 20) & (x < 80) & (y >= 30) & (y < 70)
    rise = faulty.points.xyz[:, 2] - plain.points.xyz[:, 2]
    assert not rise[~inside].any()
    assert set(np.round(rise[inside], 3).tolist()) == {0.0, 0.8}
    assert (rise[inside] > 0).mean() == pytest.approx(0.25, abs=0.06)
    starts = np.array([flight.time for flight in flight_lines(FIELD, QUIET, 3)])
    seconds = plain.points.gps_time - starts[plain.points.source_id - 1]
    row = np.floor(seconds * QUIET.speed_m_s / QUIET.pulse_spacing_m) + 10_000 * plain.points.source_id
    shares = [float((rise[inside & (row == one)] > 0).mean()) for one in np.unique(row[inside])]
    assert all(share < 0.03 or share > 0.97 for share in shares)  # one at the rectangle's edge may be rounded


def test_wrong_rows_all_over_the_survey_are_lifted() -> None:
    settings = dataclasses.replace(QUIET, wrong_row_share=0.05, wrong_row_lift_m=1.5)
    plain, lifted = scan_all(FIELD, QUIET, 3), scan_all(FIELD, settings, 3)
    rise = lifted.points.xyz[:, 2] - plain.points.xyz[:, 2]
    assert set(np.round(rise, 3).tolist()) == {0.0, 1.5}
    assert (rise > 0).mean() == pytest.approx(0.05, abs=0.025)
    assert np.array_equal(lifted.points.xyz[:, :2], plain.points.xyz[:, :2])
