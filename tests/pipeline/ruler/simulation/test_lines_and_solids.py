"""What lines hit, against the triangles of the closed solids (Moeller and Trumbore 1997) and steep terrain."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated import hits_of_lines, placed, scene_on

from pipeline.errors import SettingsError
from pipeline.model import FaceKind, FloatArray, IntArray
from pipeline.ruler.simulation.additions import can_have_dormers, random_dormers, random_superstructures
from pipeline.ruler.simulation.als import ScannerSettings, scan_all
from pipeline.ruler.simulation.first_hit import ROOF, WALL
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.scene_arrays import scene_arrays
from pipeline.ruler.simulation.simulated_scene import Building, Scene, Terrain, undulating_terrain
from pipeline.ruler.simulation.solids import building_solid

LEAN = 0.45
LINES = 3000


def scene_of(shape: RoofShape, seed: int, slope_deg: float = 4.0) -> Scene:
    """One random building with all that can stand on it, on a slope."""
    random = np.random.default_rng([seed, list(RoofShape).index(shape)])
    terrain = undulating_terrain(50.0, slope_deg, float(random.uniform(0, 360)), 0.5, 150.0, random)
    size = random_dimensions(shape, random)
    boxes = random_superstructures(shape, size, random)
    size = dataclasses.replace(size, additions=boxes)
    if can_have_dormers(shape):
        size = dataclasses.replace(size, additions=(*boxes, *random_dormers(shape, size, random, besides=boxes)))
    azimuth = float(random.uniform(0, 360))
    house = placed(shape, size, at=(40.0, 40.0), azimuth_deg=azimuth, eave_height_m=5.0, terrain=terrain)
    return scene_on(terrain, 80, house)


def aimed_lines(building: Building, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Places in and around the building, and leans."""
    random = np.random.default_rng(seed)
    low, high = building.vertices.min(axis=0) - 6.0, building.vertices.max(axis=0) + 6.0
    places = random.uniform((*low[:2], building.floor_z_m), high, (count, 3))
    return places, random.uniform(-1.0, 1.0, (count, 2)) * LEAN / math.sqrt(2.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolidHits:
    """What the twin found for n lines."""

    z: FloatArray
    """Elevation of the hit; -inf for none."""
    plane: IntArray
    """Its roof plane; -1 for a wall or the floor."""
    incidence: FloatArray
    """How far the line comes nearer to the face for a metre up."""
    from_edge: FloatArray
    """Distance of the hit to the nearest edge of the solid."""


def solid_hits(building: Building, places: FloatArray, leans: FloatArray) -> SolidHits:
    """The twin: highest hit of each line with the solid's faces.

    Every ring is a fan of triangles whose signed hits add up to 1 inside of a face, whatever its form and its holes.
    """
    solid = building_solid(building)
    way = np.column_stack([leans, np.ones(len(leans))])
    best, owner, margin = np.full(len(places), -np.inf), np.full(len(places), -2), np.full(len(places), np.inf)
    incidence = np.ones(len(places))
    for face in solid.faces:
        winding, z_sum, hit_count = np.zeros(len(places)), np.zeros(len(places)), np.zeros(len(places))
        for ring in face.rings:
            corners = solid.vertices[list(ring)]
            for second, third in itertools.pairwise(corners[1:]):
                edge1, edge2 = second - corners[0], third - corners[0]
                across = np.cross(way, edge2)
                determinant = across @ edge1
                with np.errstate(divide="ignore", invalid="ignore"):
                    away = places - corners[0]
                    u = np.einsum("ij,ij->i", away, across) / determinant
                    turned = np.cross(away, edge1)
                    v = np.einsum("ij,ij->i", way, turned) / determinant
                    t = turned @ edge2 / determinant
                    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (np.abs(determinant) > 1e-12)
                winding[inside] += np.sign(determinant[inside])
                z_sum[inside] += (places[:, 2] + t)[inside]
                hit_count[inside] += 1
        met = np.abs(winding) > 0.5
        z = np.where(met, z_sum / np.maximum(hit_count, 1), -np.inf)
        is_higher = z > best
        best[is_higher] = z[is_higher]
        owner[is_higher] = face.plane if face.kind is FaceKind.ROOF else -1
        ends = solid.vertices[list(face.rings[0])] - solid.vertices[face.rings[0][0]]
        normal = np.cross(ends[:-1], ends[1:]).sum(axis=0)
        incidence[is_higher] = np.abs(way @ (normal / np.linalg.norm(normal)))[is_higher]
    at = places + (np.where(np.isfinite(best), best, places[:, 2]) - places[:, 2])[:, None] * way
    for face in solid.faces:
        for ring in face.rings:
            corners = solid.vertices[list(ring)]
            for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                edge = end - start
                along = np.clip((at - start) @ edge / (edge @ edge), 0.0, 1.0)
                margin = np.minimum(margin, np.linalg.norm(at - start - along[:, None] * edge, axis=1))
    return SolidHits(z=best, plane=owner, incidence=incidence, from_edge=margin)


@pytest.mark.parametrize("shape", list(RoofShape))
def test_lines_hit_the_faces_of_the_closed_solid(shape: RoofShape) -> None:
    for seed in (1, 2):
        scene = scene_of(shape, seed)
        building = scene.buildings[0]
        places, leans = aimed_lines(building, LINES, seed)
        hits = hits_of_lines(scene_arrays(scene, max_lean=LEAN), places, leans)
        twin = solid_hits(building, places, leans)
        does_hit = np.isfinite(twin.z)
        at = places + np.where(does_hit, twin.z - places[:, 2], 0.0)[:, None] * np.column_stack([leans, np.ones(LINES)])
        above_ground = twin.z > scene.terrain.elevation(at[:, 0], at[:, 1]) + 0.02
        # The solid's vertices are rounded to whole millimetres.
        clear = does_hit & above_ground & (twin.from_edge > 0.02) & (twin.incidence > 0.005)
        assert clear.sum() > 0.1 * LINES
        assert (np.abs(hits.z - twin.z) * twin.incidence)[clear].max() < 0.002
        assert (hits.building[clear] == 0).all()
        assert np.array_equal(hits.face[clear], twin.plane[clear])
        assert {-1, 0} <= set(twin.plane[clear].tolist())
        assert not np.isin(hits.kind[~does_hit], (ROOF, WALL)).any()


@settings(max_examples=examples(60), deadline=None)
@given(
    slope_deg=st.floats(0.0, 30.0),
    aspect_deg=st.floats(0.0, 360.0),
    lean=st.floats(0.0, 1.1),
    turn=st.floats(0.0, 2 * math.pi),
    seed=st.integers(0, 1000),
)
def test_lines_land_on_steep_waving_terrain(
    slope_deg: float, aspect_deg: float, lean: float, turn: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    terrain = undulating_terrain(100.0, slope_deg, aspect_deg, 3.0, 240.0, random)
    scene = scene_on(terrain, 500)
    places = np.column_stack([random.uniform(0, 500, (200, 2)), np.full(200, 100.0)])
    leans = np.tile([lean * math.cos(turn), lean * math.sin(turn)], (200, 1))
    hits = hits_of_lines(scene_arrays(scene, max_lean=lean), places, leans)
    x, y, z = hits.xyz.T
    assert np.abs(terrain.elevation(x, y) - z).max() < 1e-5
    assert np.abs(hits.xyz[:, :2] - places[:, :2] - (z - 100.0)[:, None] * leans).max() < 1e-9


@pytest.mark.parametrize("shift_m", np.arange(0.0, 5.0, 0.5).tolist())
def test_a_house_on_a_steep_slope_is_hit_by_lines_that_land_far_below_it(shift_m: float) -> None:
    """The grid must enter the house into cells down the slope: the cells' borders lie at any distance from it."""
    terrain = Terrain(base_z_m=50.0, slope_x=math.tan(math.radians(30.0)))
    size = RoofDimensions(length_m=10.0, width_m=10.0)
    stand = {"azimuth_deg": 0.0, "eave_height_m": 6.0, "terrain": terrain}
    house = placed(RoofShape.FLAT, size, at=(60.0 + shift_m, 60.0), **stand)
    scene = scene_on(terrain, 120, house)
    y = np.linspace(56.0, 64.0, 50)
    places = np.column_stack([np.full(50, house.x - 5.0 + 0.01), y, np.full(50, house.eave_z_m)])
    hits = hits_of_lines(scene_arrays(scene, max_lean=LEAN, margin_m=0.0), places, np.tile([LEAN, 0.0], (50, 1)))
    assert (hits.kind == ROOF).all()


def test_beams_that_graze_the_terrain_are_refused_before_the_first_pulse() -> None:
    scene = scene_on(Terrain(base_z_m=0.0, slope_y=1.0), 50)
    with pytest.raises(SettingsError, match=r"beams that lean 54 deg graze terrain of up to 45 deg: raise altitude_m"):
        scan_all(scene, ScannerSettings(altitude_m=50.0), 1)
