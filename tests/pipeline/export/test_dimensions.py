"""Dimensions of delivered solids against textbook figures, a sampled twin and an independent hull."""

import dataclasses

import numpy as np
import pytest
import shapely
import small_buildings as small
from scipy.spatial import ConvexHull
from small_buildings import Builder

from pipeline.export.dimensions import dimensions, roof_percentiles, volume
from pipeline.model import FaceKind, Solid, SolidFace


def moved(solid: Solid, *by: float) -> Solid:
    return dataclasses.replace(solid, vertices=solid.vertices + np.array(by))


def tower_on_a_slab() -> Solid:
    """A slab of 20 m by 20 m, 4 m high, with a tower of 6 m by 6 m up to 15 m in its middle."""
    slab = [(0.0, 0.0, 4.0), (20.0, 0.0, 4.0), (20.0, 20.0, 4.0), (0.0, 20.0, 4.0)]
    foot = [(7.0, 7.0, 4.0), (7.0, 13.0, 4.0), (13.0, 13.0, 4.0), (13.0, 7.0, 4.0)]
    around = small.roofed_solid(slab, [[[0, 1, 2, 3]]], 0.0)
    first = len(around.vertices)
    vertices = np.vstack([around.vertices, foot, [(x, y, 15.0) for x, y, _ in foot]])
    hole = tuple(range(first, first + 4))
    low = dataclasses.replace(around.faces[0], rings=(*around.faces[0].rings, hole))
    walls = [
        SolidFace(rings=((first + (i + 1) % 4, first + i, first + 4 + i, first + 4 + (i + 1) % 4),), kind=FaceKind.WALL)
        for i in range(4)
    ]
    top = SolidFace(rings=(tuple(range(first + 7, first + 3, -1)),), kind=FaceKind.ROOF, plane=1)
    return Solid(vertices=vertices, faces=(low, top, *walls, *around.faces[1:]))


def test_a_gable_has_its_textbook_dimensions() -> None:
    measured = dimensions(small.gable().solids)
    assert measured.eave_z_m == 3.0
    assert measured.ridge_z_m == 6.0
    assert measured.roof_z_m == pytest.approx((3.0, 4.5, 5.1, 6.0))
    assert measured.roof_area_m2 == pytest.approx(100.0)
    assert measured.volume_m3 == pytest.approx(360.0)


def test_the_high_edge_of_a_pent_roof_is_no_eave() -> None:
    assert dimensions(small.pent().solids).eave_z_m == 3.0


def test_a_courtyard_is_no_part_of_the_volume() -> None:
    measured = dimensions(small.courtyard().solids)
    assert measured.volume_m3 == pytest.approx(300.0 * 9.0)
    assert measured.roof_area_m2 == pytest.approx(300.0)


def test_walls_that_stand_on_a_roof_have_no_eaves() -> None:
    measured = dimensions([tower_on_a_slab()])
    assert measured.eave_z_m == 4.0
    assert measured.ridge_z_m == 15.0
    assert measured.volume_m3 == pytest.approx(400.0 * 4.0 + 36.0 * 11.0)
    assert measured.roof_z_m == (4.0, 4.0, 4.0, 15.0)


def test_a_jump_between_level_roofs_is_answered_by_one_of_them() -> None:
    low_share = (400.0 - 36.0) / 400.0
    below, above = roof_percentiles([tower_on_a_slab()], (low_share - 0.01, low_share + 0.01))
    assert (below, above) == (4.0, 15.0)


def test_the_eave_is_that_of_the_larger_roof_face() -> None:
    low = small.gable_solid(30.0)
    high = moved(small.pent().solids[0], 0.0, 0.0, 7.0)
    assert dimensions([low, high]).eave_z_m == 3.0


def test_no_solid_has_no_dimensions() -> None:
    measured = dimensions([])
    assert np.isnan([measured.eave_z_m, measured.ridge_z_m, *measured.roof_z_m]).all()
    assert (measured.roof_area_m2, measured.volume_m3) == (0.0, 0.0)


@pytest.mark.parametrize("build", [small.gable, small.pent, small.two_parts])
def test_volume_is_that_of_the_convex_hull_where_the_solid_is_convex(build: Builder) -> None:
    for solid in build().solids:
        assert volume(solid) == pytest.approx(ConvexHull(solid.vertices).volume)


@pytest.mark.parametrize("seed", range(4))
def test_percentiles_are_those_of_a_finely_sampled_roof(seed: int) -> None:
    rng = np.random.default_rng(seed)
    notched = [(0, 0), (12, 0), (12, 9), (7, 9), (7, 5), (4, 5), (4, 9), (0, 9)]
    slope, level = rng.uniform(-0.5, 0.5, 2), rng.uniform(5, 9)
    tilted = [(float(x), float(y), float(level + x * slope[0] + y * slope[1])) for x, y in notched]
    solids = [small.roofed_solid(tilted, [[list(range(8))]], -20.0), small.gable_solid(40.0), tower_on_a_slab()]
    samples = []
    for solid in solids:
        for face in (face for face in solid.faces if face.kind is FaceKind.ROOF):
            rings = [solid.vertices[list(ring)] for ring in face.rings]
            polygon = shapely.Polygon(rings[0], rings[1:])
            west, south, east, north = polygon.bounds
            x, y = (a.ravel() for a in np.meshgrid(np.arange(west, east, 0.05) + 0.025, np.arange(south, north, 0.05)))
            inside = shapely.contains_xy(polygon, x, y + 0.025)
            plane = small.plane_of(solid, face)
            samples.append(plane.a * x[inside] + plane.b * (y[inside] + 0.025) + plane.c)
    wanted = np.quantile(np.concatenate(samples), [0.1, 0.5, 0.7, 0.9])
    assert roof_percentiles(solids, (0.1, 0.5, 0.7, 0.9)) == pytest.approx(wanted, abs=0.02)


def test_moving_a_building_moves_its_elevations_only() -> None:
    still = dimensions(small.gable().solids)
    solid = small.gable_solid()
    elsewhere = dimensions([moved(solid, 1000.0, -500.0, 12.0)])
    assert elsewhere.eave_z_m == still.eave_z_m + 12.0
    assert elsewhere.roof_z_m == pytest.approx([z + 12.0 for z in still.roof_z_m])
    assert elsewhere.volume_m3 == pytest.approx(still.volume_m3)


def test_a_building_without_eaves_takes_its_lowest_roof_point() -> None:
    only_high_edge = small.pent().solids[0]
    kept = tuple(f for f in only_high_edge.faces if f.kind is not FaceKind.GROUND)
    assert dimensions([dataclasses.replace(only_high_edge, faces=kept)]).eave_z_m == 3.0
