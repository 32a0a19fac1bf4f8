"""The scanner measures as configured, and the same whatever the chunks."""

import dataclasses

import numpy as np
import pytest
import shapely
from simulated import scene_on

from pipeline.errors import SettingsError
from pipeline.model import FloatArray, PointCloud
from pipeline.ruler.simulation.als import ScanBlock, ScannerSettings, scan, scan_all, strip_count
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain
from pipeline.ruler.simulation.suites import SUITES, single_building

PLAIN = ScannerSettings(strip_overlap=0.0, strip_spacing_m=100.0, drop_out=0.0)
FIELD = scene_on(Terrain(base_z_m=7.0), 100, origin=(1000.0, 2000.0, 0.0))
SUBURB = SUITES["suburb"].make(3, (120.0, 120.0))


@pytest.fixture(scope="module")
def block() -> ScanBlock:
    return scan_all(SUBURB, SUITES["suburb"].scanner, 3)


def local(block: ScanBlock, scene: Scene) -> FloatArray:
    xyz: FloatArray = block.points.xyz - np.array(scene.origin)
    return xyz


def same(a: ScanBlock, b: ScanBlock) -> bool:
    clouds = all(
        np.array_equal(getattr(a.points, f.name), getattr(b.points, f.name)) for f in dataclasses.fields(PointCloud)
    )
    names = [f.name for f in dataclasses.fields(ScanBlock) if f.name != "points"]
    return clouds and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


@pytest.mark.parametrize("density", [0.77, 4.0, 20.0])
def test_pulses_are_as_dense_as_asked_for(density: float) -> None:
    settings = dataclasses.replace(PLAIN, pulse_density_per_m2=density)
    assert len(scan_all(FIELD, settings, 1)) / 1e4 == pytest.approx(density, rel=0.02)


@pytest.mark.parametrize("noise_m", [0.0, 0.03, 0.1])
def test_noise_over_level_ground_is_as_asked_for(noise_m: float) -> None:
    xyz = local(scan_all(FIELD, dataclasses.replace(PLAIN, range_noise_m=noise_m, altitude_m=5000.0), 1), FIELD)
    assert np.std(xyz[:, 2] - 7.0) == pytest.approx(noise_m, rel=0.02, abs=1e-6)
    assert abs(float(np.mean(xyz[:, 2])) - 7.0) < 0.002


def test_drop_outs_are_as_many_as_asked_for() -> None:
    full = len(scan_all(FIELD, PLAIN, 1))
    left = len(scan_all(FIELD, dataclasses.replace(PLAIN, drop_out=0.2), 1))
    assert left / full == pytest.approx(0.8, abs=0.01)


def test_overlapping_strips_double_the_density_between_them_and_have_their_own_id() -> None:
    settings = ScannerSettings(strip_spacing_m=50.0, strip_overlap=0.2, drop_out=0.0)
    block = scan_all(FIELD, settings, 1)
    assert strip_count(FIELD, settings) == 2
    assert set(block.points.source_id.tolist()) == {1, 2}
    across = local(block, FIELD)[:, 0]
    in_overlap = np.abs(across - 50.0) < 4.5
    assert in_overlap.sum() / 900 == pytest.approx(16.0, rel=0.05)


def test_time_never_runs_backwards(block: ScanBlock) -> None:
    assert np.diff(block.points.gps_time).min() >= 0
    for strip in np.unique(block.points.source_id):
        assert np.ptp(block.points.gps_time[block.points.source_id == strip]) < 10


def test_returns_of_a_pulse_are_numbered_from_the_top(block: ScanBlock) -> None:
    cloud = block.points
    firsts = np.flatnonzero(cloud.return_number == 1)
    assert firsts[0] == 0
    for start, stop in zip(firsts, [*firsts[1:], len(cloud)], strict=True):
        if stop - start > 1:
            assert cloud.return_number[start:stop].tolist() == list(range(1, stop - start + 1))
            assert np.ptp(cloud.gps_time[start:stop]) == 0
            assert np.diff(cloud.xyz[start:stop, 2]).max() < -1.0
        assert (cloud.return_count[start:stop] == stop - start).all()


def test_trees_give_several_returns_and_ground_is_seen_below_them() -> None:
    scene = single_building(RoofShape.GABLE, 5, trees=6)
    block = scan_all(scene, ScannerSettings(pulse_density_per_m2=20.0), 1)
    cloud, xyz = block.points, local(block, scene)
    counts = cloud.return_count[cloud.classification == 5]
    assert 0.4 < (counts > 1).mean() < 0.95
    assert 1.5 < counts.mean() < 3.0
    below = [
        (cloud.classification == 2) & (np.hypot(xyz[:, 0] - tree.x, xyz[:, 1] - tree.y) < 0.7 * tree.crown_radius_m)
        for tree in scene.trees
    ]
    assert min(int(mask.sum()) for mask in below) > 10
    assert (cloud.return_number[np.any(below, axis=0)] > 1).mean() > 0.5


def test_walls_are_seen_from_the_side_only() -> None:
    scene = single_building(RoofShape.FLAT, 5)
    aside = ScannerSettings(altitude_m=300.0, strip_spacing_m=200.0, pulse_density_per_m2=20.0)
    from_above = dataclasses.replace(aside, altitude_m=1e6, beam_radius_m=0.0)
    shifted = dataclasses.replace(scene, extent=(-80.0, 0.0, 40.0, 40.0))  # the strip flies 40 m to the west of it
    assert scan_all(scene, from_above, 1).wall.sum() == 0
    block = scan_all(shifted, aside, 1)
    wall = block.wall & ~block.mixed
    assert wall.sum() > 30
    outline = scene.buildings[0].footprint.exterior
    distance = shapely.distance(outline, shapely.points(local(block, scene)[wall][:, :2]))
    assert np.quantile(distance, 0.95) < 0.15


def test_roof_points_lie_on_the_plane_that_their_label_names(block: ScanBlock) -> None:
    xyz = local(block, SUBURB)
    residuals = []
    for number, building in enumerate(SUBURB.buildings):
        for face, plane in enumerate(building.planes):
            mine = (block.building == number) & (block.face == face) & ~block.mixed
            x, y, z = xyz[mine].T
            residuals.append(z - (plane.a * x + plane.b * y + plane.c))
    pooled = np.concatenate(residuals)
    assert len(pooled) > 5000
    assert np.std(pooled) == pytest.approx(0.03, rel=0.08)
    assert np.abs(pooled).max() < 0.2


def test_classes_follow_what_was_hit(block: ScanBlock) -> None:
    classes = block.points.classification
    assert set(classes.tolist()) == {1, 2, 5, 6}
    assert np.array_equal(classes == 6, block.building >= 0)
    assert (block.face[classes != 6] == -1).all()
    ground = (classes == 2) & ~block.mixed
    x, y, z = local(block, SUBURB)[ground].T
    assert np.std(z - SUBURB.terrain.elevation(x, y)) == pytest.approx(0.03, rel=0.05)


def test_mixed_returns_stand_at_the_edges(block: ScanBlock) -> None:
    assert 0.001 < block.mixed.mean() < 0.05
    roof = block.mixed & (block.face >= 0)
    edges = shapely.union_all([p.exterior for b in SUBURB.buildings for p in b.roof_polygons()])
    at = shapely.points(local(block, SUBURB)[roof][:, :2])
    from_crown = np.min(
        [np.hypot(shapely.get_x(at) - t.x, shapely.get_y(at) - t.y) - t.crown_radius_m for t in SUBURB.trees], axis=0
    )
    assert shapely.distance(shapely.force_2d(edges), at)[from_crown > 0.3].max() < 0.5


def faces_fitted_to_their_points(shape: RoofShape) -> list[float]:
    """The error of each face with enough points in its own deviations.

    Where only a part of a beam meets a face, the return lies on the beam's axis and not on the face: left out.
    """
    suite = SUITES[str(shape)]
    scene = suite.make(suite.seed, suite.size_m)
    block = scan_all(scene, suite.scanner, suite.seed)
    xyz, found = local(block, scene) - (20.0, 20.0, 100.0), []
    whole = ~block.mixed & (block.points.return_count == 1)
    for face, plane in enumerate(scene.buildings[0].planes):
        x, y, z = xyz[(block.face == face) & whole].T
        if len(x) < 12:
            continue
        design = np.column_stack([x, y, np.ones(len(x))])
        (a, b, _), *_ = np.linalg.lstsq(design, z, rcond=None)
        covariance = np.linalg.inv(design.T @ design)[:2, :2] * suite.scanner.range_noise_m**2
        error = np.array([a - plane.a, b - plane.b])
        found.append(float(np.sqrt(error @ np.linalg.solve(covariance, error))))
    return found


@pytest.mark.parametrize("shape", [shape for shape in RoofShape if str(shape) in SUITES])
def test_faces_fitted_to_their_points_are_as_near_to_the_truth_as_noise_allows(shape: RoofShape) -> None:
    errors = faces_fitted_to_their_points(shape)
    assert len(errors) >= 1
    assert max(errors) < 4.5  # Rayleigh: one of 25,000


def test_the_cube_is_that_of_the_paper() -> None:
    suite = SUITES["cube"]
    scene = suite.make(1, suite.size_m)
    block = scan_all(scene, suite.scanner, 1)
    z = block.points.xyz[:, 2]
    assert np.std(z[block.points.classification == 6] - 10.0) == pytest.approx(0.1, rel=0.1)
    assert np.std(z[block.points.classification == 2]) == pytest.approx(0.1, rel=0.05)
    assert set(block.points.classification.tolist()) == {2, 6}
    assert (block.points.return_count == 1).all()
    assert (block.face == 0).sum() == pytest.approx(400, rel=0.1)


def test_strips_have_their_own_shift() -> None:
    settings = ScannerSettings(strip_spacing_m=50.0, strip_overlap=0.0, strip_lift_m=0.5, range_noise_m=0.0)
    block = scan_all(FIELD, settings, 1)
    levels = {float(z) for z in block.points.xyz[:, 2]}
    assert len(levels) == 2
    assert scan_all(FIELD, dataclasses.replace(settings, strip_lift_m=0.0), 1).points.xyz[:, 2].tolist().count(7.0) > 0


def test_the_same_seed_gives_the_same_points_in_any_chunks_and_threads(block: ScanBlock) -> None:
    scanner = SUITES["suburb"].scanner
    assert same(block, scan_all(SUBURB, scanner, 3))
    small = list(scan(SUBURB, scanner, 3, chunk_points=10_000, threads=1))
    assert len(small) > 1
    at = 0
    for part in small:
        assert np.array_equal(part.points.xyz, block.points.xyz[at : at + len(part)])
        assert np.array_equal(part.face, block.face[at : at + len(part)])
        at += len(part)
    assert at == len(block)


def test_impossible_surveys_are_refused_with_all_faults() -> None:
    with pytest.raises(SettingsError, match=r"pulse_density_per_m2 is 0: .*; drop_out is 2: "):
        ScannerSettings(pulse_density_per_m2=0.0, drop_out=2.0)
    with pytest.raises(ValueError, match="no pulse"):
        scan_all(FIELD, dataclasses.replace(PLAIN, drop_out=1.0), 1)


def test_a_larger_town_holds_the_smaller_one_unchanged() -> None:
    small, large = (SUITES["town"].make(9, (size, size)) for size in (150.0, 300.0))
    known = {b.building_id: b for b in large.buildings}
    assert len(small.buildings) > 20
    for building in small.buildings:
        assert np.array_equal(known[building.building_id].vertices, building.vertices)


def test_single_buildings_can_be_of_any_size() -> None:
    scene = single_building(
        RoofShape.GABLE, 1, (60.0, 60.0), RoofDimensions(length_m=20.0, width_m=10.0, pitch_deg=25.0), slope_deg=10.0
    )
    assert scene.buildings[0].footprint.area == pytest.approx(200.0)
    assert scene.buildings[0].planes[0].slope_deg == pytest.approx(25.0)
