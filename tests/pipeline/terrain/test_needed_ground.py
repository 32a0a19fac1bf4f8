"""The ground that a scene's TIN needs: what lies beside objects stays as it is, and wide open ground is left out."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import BoolArray, IntArray, Tin
from pipeline.terrain.facets import SceneVertices, VertexKind
from pipeline.terrain.needed_ground import needed_vertices
from pipeline.terrain.point_assignment import ScenePoints
from pipeline.terrain.surfaces import fragments_of
from pipeline.terrain.terrain_settings import SurfaceSettings
from pipeline.tin.delaunay import triangulate

SIDE_MM = 60_000
SETTINGS = SurfaceSettings()
FILLED = (0.25, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plain:
    """Flat ground with a few huts, shrubs and gaps."""

    vertices: SceneVertices
    needed: BoolArray


def one_per_cell(random: np.random.Generator, side_mm: int) -> IntArray:
    """As few vertices as fill all cells: the first lies in a corner, so that cells start there."""
    axis = np.arange(0, SIDE_MM, side_mm)
    corners = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    xy = corners + random.integers(0, side_mm, corners.shape)
    xy[0] = 0
    return xy


def plain(seed: int, per_m2: float, objects: int, gaps: int, radius_m: float = 6.0) -> Plain:
    """Random vertices, or one per cell of 1 / per_m2; objects are 1 to 9 m wide, gaps 2 to 20 m."""
    random = np.random.default_rng(seed)
    if per_m2 in FILLED:
        xy = one_per_cell(random, round(1000 / per_m2**0.5))
    else:
        xy = np.unique(random.integers(0, SIDE_MM, (round(per_m2 * (SIDE_MM / 1000) ** 2), 2)), axis=0)
    for corner in random.integers(0, SIDE_MM, (gaps, 2)):
        width = random.integers(2_000, 20_000)
        xy = xy[~((xy >= corner) & (xy < corner + width)).all(axis=1)]
    height = random.integers(0, 200, len(xy))
    for corner in random.integers(SIDE_MM // 4, 3 * SIDE_MM // 4, (objects, 2)):
        width = random.integers(1_000, 9_000)
        height[((xy >= corner) & (xy < corner + width)).all(axis=1)] += random.integers(600, 8_000)
    kind = np.where(height >= 500, VertexKind.OBJECT, VertexKind.GROUND).astype(np.int8)
    x, y = np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1])
    return Plain(
        vertices=SceneVertices(
            x_mm=x, y_mm=y, z_mm=height, height_mm=height, kind=kind, planar=np.ones(len(x), np.int8)
        ),
        needed=needed_vertices(x, y, kind, 1000.0 * radius_m, SETTINGS.far_mm),
    )


def tin_of(vertices: SceneVertices) -> Tin:
    return triangulate(np.column_stack((vertices.x_mm, vertices.y_mm)))


def beside_objects(vertices: SceneVertices, radius_m: float) -> set[tuple[int, ...]]:
    """The facets, by the places of their vertices, with an object and no wide circumcircle."""
    facets = tin_of(vertices).facets
    xy = np.column_stack((vertices.x_mm, vertices.y_mm))[facets].astype(np.float64)
    a, b, c = (np.hypot(*(xy[:, k] - xy[:, (k + 1) % 3]).T) for k in range(3))
    (ux, uy), (vx, vy) = (xy[:, 1] - xy[:, 0]).T, (xy[:, 2] - xy[:, 0]).T
    radius = a * b * c / (2 * np.abs(ux * vy - uy * vx))
    chosen = (radius <= 1000 * radius_m) & (vertices.kind[facets] != VertexKind.GROUND).any(axis=1)
    return {tuple(corners.ravel().astype(int).tolist()) for corners in xy[chosen]}


@settings(deadline=None)
@given(
    seed=st.integers(0, 10_000),
    per_m2=st.sampled_from([0.1, 0.25, 0.5, 1.0, 4.0, 8.0]),
    objects=st.integers(1, 5),
    gaps=st.integers(0, 4),
    radius_m=st.sampled_from([1.0, 6.0]),
)
def test_facets_beside_objects_do_not_change(
    seed: int, per_m2: float, objects: int, gaps: int, radius_m: float
) -> None:
    scene = plain(seed, per_m2, objects, gaps, radius_m)
    assert scene.needed[scene.vertices.kind != VertexKind.GROUND].all()
    less = SceneVertices(*(values[scene.needed] for values in scene.vertices))
    assert beside_objects(less, radius_m) == beside_objects(scene.vertices, radius_m)


@pytest.mark.parametrize("per_m2", [0.25, 0.5, 1.0, 4.0])
@pytest.mark.parametrize("seed", range(4))
def test_surfaces_and_their_points_do_not_change(per_m2: float, seed: int) -> None:
    scene = plain(seed, per_m2, objects=5, gaps=3)
    random = np.random.default_rng(seed)
    v = scene.vertices

    def near_vertices(values: IntArray, spread: int) -> IntArray:
        return np.repeat(values, 3) + random.integers(-spread, spread, 3 * len(values))

    z = near_vertices(v.z_mm, 900)
    points = ScenePoints(
        x_mm=near_vertices(v.x_mm, 1500),
        y_mm=near_vertices(v.y_mm, 1500),
        z_mm=z,
        height_mm=z,
        last=random.random(len(z)) < 0.8,
        several=random.random(len(z)) < 0.3,
        allowed=np.ones(len(z), np.int8),
    )
    core = (SIDE_MM // 4, SIDE_MM // 4, 3 * SIDE_MM // 4, 3 * SIDE_MM // 4)
    less = SceneVertices(*(values[scene.needed] for values in v))
    assert len(less.x_mm) < len(v.x_mm)
    (whole, labels), (cut, cut_labels) = (
        fragments_of(tin_of(some), some, points, core, SETTINGS, canopy_m=1.0, ground_m=0.5) for some in (v, less)
    )
    for field in dataclasses.fields(whole):
        np.testing.assert_array_equal(getattr(cut, field.name), getattr(whole, field.name))
    np.testing.assert_array_equal(cut_labels, labels)
    assert (labels >= 0).any()


def test_an_open_field_needs_no_ground() -> None:
    scene = plain(1, per_m2=4.0, objects=1, gaps=0)
    assert scene.needed.mean() < 0.2
    bare = plain(1, per_m2=4.0, objects=0, gaps=0)
    assert not bare.needed.any()
    nothing = np.empty(0, np.int64)
    assert len(needed_vertices(nothing, nothing, np.empty(0, np.int8), 6000.0, 1000)) == 0
