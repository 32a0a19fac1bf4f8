"""LoD2.3: roofs that hang over their walls, closed and valid, as large as geometry says."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import shapely
from examples import examples
from faces_by_hand import assert_closed, level, partition_of, plane
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.extras.lods.facades import FacadePoints
from pipeline.extras.lods.overhangs import UndrawableError, floor_m2, overhanging_solids
from pipeline.extras.lods.wider_eaves import wider_parts
from pipeline.model import FaceKind, FloatArray, NoOverhang, Plane, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.solid import SolidPart, solid_parts

ExactRoofs = Callable[..., Any]
Volume = Callable[[Solid], float]

KINDS = ["flat", "pent", "gable", "hip", "l", "stepped", "courtyard", "dormer", "tower"]
THICK_M = 0.2
NONE: FloatArray = np.zeros((0, 3))
GABLE = [shapely.box(0, 0, 10, 4), shapely.box(0, 4, 10, 8)], [plane(0.0, 0.75, 5.0), plane(0.0, -0.75, 11.0)]


def in_mm(walls: shapely.Geometry) -> MultiPolygon:
    drawn = shapely.set_precision(shapely.transform(walls, lambda xy: xy * 1e3), 1.0)
    return MultiPolygon([part for part in shapely.get_parts(drawn).tolist() if part.area > 0.0])


def hung(parts: Sequence[SolidPart], planes: Sequence[Plane], walls: shapely.Geometry, **changes: Any) -> list[Solid]:
    """Valid solids over parts with their floor at 0; walls in metres."""
    arguments = {"thickness_m": THICK_M, "lowest_m": 0.1} | changes
    solids = overhanging_solids(parts, planes, in_mm(walls), is_sound=lambda solid: not check_solid(solid), **arguments)
    for solid in solids:
        assert check_solid(solid) == ()
        assert_closed(ring for face in solid.faces for ring in face.rings)
        assert np.array_equal(np.rint(solid.vertices * 1e3) / 1e3, solid.vertices)
    return solids


def faces_in_plan(solid: Solid, kind: FaceKind) -> list[tuple[Polygon, FloatArray]]:
    """The faces of a kind: in plan, and their corners."""
    found = []
    for face in solid.faces:
        if face.kind is kind:
            rings = [solid.vertices[list(ring)] for ring in face.rings]
            found.append((Polygon(rings[0][:, :2], [ring[:, :2] for ring in rings[1:]]), np.concatenate(rings)))
    return found


def area(solid: Solid, kind: FaceKind) -> float:
    return math.fsum(polygon.area for polygon, _ in faces_in_plan(solid, kind))


def beneath(solid: Solid) -> float:
    """Volume between the undersides and the height 0."""
    total = 0.0
    for polygon, corners in faces_in_plan(solid, FaceKind.CEILING):
        columns = np.column_stack((corners[:, :2], np.ones(len(corners))))
        a, b, c = np.linalg.lstsq(columns, corners[:, 2], rcond=None)[0]
        total += polygon.area * (a * polygon.centroid.x + b * polygon.centroid.y + c)
    return total


def test_a_gable_with_a_known_overhang_has_the_volume_and_the_undersides_of_geometry(volume: Volume) -> None:
    polygons, planes = GABLE
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    (solid,) = hung([part], planes, shapely.box(0.5, 0.5, 9.5, 7.5))
    # inside the walls, 9 m by 7 m, the roof rises from 5.375 m to 8 m; the rest of the plan is THICK_M thick
    assert volume(solid) == pytest.approx(63.0 * (5.375 + 8.0) / 2.0 + 17.0 * THICK_M, abs=1e-6)
    assert [area(solid, kind) for kind in (FaceKind.ROOF, FaceKind.GROUND, FaceKind.CEILING)] == pytest.approx(
        [80.0, 63.0, 17.0]
    )
    undersides = [face for face in solid.faces if face.kind is FaceKind.CEILING]
    assert [face.plane for face in undersides] == [-1, -1]
    roofs = [face for face in solid.faces if face.kind is FaceKind.ROOF]
    assert [len(face.rings[0]) for face in roofs] == [4, 4]
    fascia = [v for v in solid.vertices.tolist() if v[:2] == [0.0, 0.0]]
    assert [z for _, _, z in fascia] == [4.8, 5.0]


def test_where_walls_and_eaves_coincide_the_wall_goes_up_to_the_roof(volume: Volume) -> None:
    polygons, planes = GABLE
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    (solid,) = hung([part], planes, shapely.box(0, 0.5, 10, 8))
    assert volume(solid) == pytest.approx(volume(part.solid) - 5.0 * (5.1875 - THICK_M))
    gable_end = [v for v in solid.vertices.tolist() if v[0] == 0.0 and v[1] == 8.0]
    assert [z for _, _, z in gable_end] == [0.0, 5.0]


def test_a_step_between_roof_faces_goes_on_over_the_overhang(volume: Volume) -> None:
    # the upper slab leaves the lower one at the step: between them is air
    polygons, planes = [shapely.box(0, 0, 5, 6), shapely.box(5, 0, 10, 6)], [level(7.0), level(4.0)]
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    (solid,) = hung([part], planes, shapely.box(0, 1, 10, 6))
    assert volume(solid) == pytest.approx(25.0 * 7.0 + 25.0 * 4.0 + 10.0 * THICK_M)
    assert area(solid, FaceKind.CEILING) == pytest.approx(10.0)


def test_a_step_as_high_as_the_thickness_is_no_fault(volume: Volume) -> None:
    # the underside of one slab would be in one edge with the roof of the other
    polygons, planes = [shapely.box(0, 0, 5, 6), shapely.box(5, 0, 10, 6)], [level(5.0), level(5.0 - THICK_M)]
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    (solid,) = hung([part], planes, shapely.box(0, 1, 10, 6))
    assert volume(solid) == pytest.approx(25.0 * 5.0 + 25.0 * (5.0 - THICK_M) + 10.0 * THICK_M, abs=0.1)


def test_planes_that_cross_through_a_slab_get_vertices_there(volume: Volume) -> None:
    polygons, planes = [shapely.box(0, 0, 5, 6), shapely.box(5, 0, 10, 6)], [plane(0.0, 1.0, 4.0), level(4.5)]
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    (solid,) = hung([part], planes, shapely.box(0, 1.5, 10, 6))
    assert volume(solid) == pytest.approx(volume(part.solid) - beneath(solid))
    assert area(solid, FaceKind.CEILING) == pytest.approx(15.0)
    assert [5.0, 0.3, 4.3] in solid.vertices.tolist()  # underside on the right, roof on the left


def test_an_overhang_all_around_is_one_underside_with_a_hole() -> None:
    (part,) = solid_parts(partition_of([shapely.box(0, 0, 8, 6)]), [level(4.0)], 0.0)
    (solid,) = hung([part], [level(4.0)], shapely.box(1, 1, 7, 5))
    (underside,) = [face for face in solid.faces if face.kind is FaceKind.CEILING]
    assert len(underside.rings) == 2


def test_walls_of_two_houses_under_one_roof_have_a_floor_each() -> None:
    (part,) = solid_parts(partition_of([shapely.box(0, 0, 9, 6)]), [level(4.0)], 0.0)
    (solid,) = hung([part], [level(4.0)], shapely.union(shapely.box(0, 0, 3, 6), shapely.box(5, 0, 9, 6)))
    assert sorted(polygon.area for polygon, _ in faces_in_plan(solid, FaceKind.GROUND)) == [18.0, 24.0]


def test_what_hangs_on_no_wall_stands_on_the_floor() -> None:
    # the high face is wholly outside the walls and touches nothing that stands
    polygons, planes = [shapely.box(0, 0, 8, 5), shapely.box(0, 5, 8, 6)], [level(4.0), level(9.0)]
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    for depth in (5.0, 4.5):  # the overhang beside it stays
        (solid,) = hung([part], planes, shapely.box(0, 0.5, 8, depth))
        assert floor_m2(solid) == pytest.approx(8.0 * (depth - 0.5) + 8.0)


def test_reasons_say_why_there_is_no_overhang() -> None:
    polygons, planes = GABLE
    (part,) = solid_parts(partition_of(polygons), planes, 0.0)
    cases: list[tuple[shapely.Geometry, dict[str, Any], NoOverhang]] = [
        (shapely.box(0, 0, 10, 8), {}, NoOverhang.WALLS_BREAK),
        (shapely.box(0.5, 0.5, 9.5, 7.5), {"lowest_m": 8.0}, NoOverhang.TOO_LOW),
    ]
    for walls, changes, reason in cases:
        with pytest.raises(UndrawableError) as raised:
            hung([part], planes, walls, **changes)
        assert raised.value.reason is reason
    with pytest.raises(UndrawableError, match="no form of the overhangs is valid") as raised:
        overhanging_solids([part], planes, in_mm(shapely.box(1, 1, 9, 7)), THICK_M, 0.1, lambda _: False)
    assert raised.value.reason is NoOverhang.INVALID_SOLID


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
def test_every_kind_of_roof_hangs_over_all_around(
    exact_roof: ExactRoofs, volume: Volume, kind: str, turn_deg: float
) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, with_footprint=True)
    (part,) = roof.parts()
    walls = shapely.buffer(roof.footprint, -0.4, join_style="mitre")
    (solid,) = hung([part], roof.planes, walls)
    assert area(solid, FaceKind.GROUND) == pytest.approx(walls.area, abs=0.02)
    assert area(solid, FaceKind.CEILING) == pytest.approx(roof.footprint.area - walls.area, abs=0.05)
    assert volume(solid) == pytest.approx(volume(part.solid) - beneath(solid), abs=0.02)


def test_turning_and_mirroring_a_roof_turns_and_mirrors_its_overhangs(exact_roof: ExactRoofs, volume: Volume) -> None:
    roof = exact_roof("l", with_footprint=True)
    (part,) = roof.parts()
    walls = shapely.buffer(roof.footprint, -0.37, join_style="mitre")
    (solid,) = hung([part], roof.planes, walls)
    # a quarter turn, (x, y) to (-y, x), and a reflection, (x, y) to (-x, y), keep the grid
    for matrix in ([0, -1, 1, 0], [-1, 0, 0, 1]):
        a, b, c, d = matrix
        polygons = [shapely.affinity.affine_transform(shapely.force_2d(f.polygon), [*matrix, 0, 0]) for f in part.faces]
        own = [roof.planes[face.plane] for face in part.faces]
        planes = [plane(a * p.a + b * p.b, c * p.a + d * p.b, p.c) for p in own]
        (moved,) = solid_parts(partition_of(polygons), planes, 0.0)
        (other,) = hung([moved], planes, shapely.affinity.affine_transform(walls, [*matrix, 0, 0]))
        assert volume(other) == pytest.approx(volume(solid), abs=0.02)
        there = {(a * x + b * y, c * x + d * y, z) for x, y, z in solid.vertices.tolist()}
        back = shapely.MultiPoint([place[:2] for place in there])
        assert shapely.hausdorff_distance(back, shapely.MultiPoint(other.vertices[:, :2])) < 0.003


@st.composite
def plans(draw: st.DrawFn) -> tuple[list[Polygon], list[Plane], shapely.Geometry]:
    """Roof faces in a random plan, cut by random lines, with random planes, and a random wall outline."""
    number = st.integers
    width, depth = draw(number(4000, 12000)), draw(number(4000, 12000))
    whole: Polygon = shapely.box(0, 0, width, depth)
    if draw(st.booleans()):
        whole = whole.difference(shapely.box(draw(number(1500, 3000)), 2500, 20000, 20000))
    if draw(st.booleans()):
        whole = whole.difference(shapely.box(500, 600, 1300, 2100))
    whole = shapely.set_precision(shapely.affinity.rotate(whole, draw(number(0, 89)), origin=(0, 0)), 1.0)
    lines = [whole.boundary]
    for _ in range(draw(number(0, 4))):
        x, y, angle = draw(number(-8000, 12000)), draw(number(0, 12000)), math.radians(draw(number(0, 179)))
        far = np.array([math.cos(angle), math.sin(angle)]) * 3e4
        lines.append(shapely.intersection(shapely.LineString(np.add(np.outer((1.0, -1.0), far), (x, y))), whole))
    cells = shapely.get_parts(shapely.polygonize([shapely.union_all(lines, grid_size=1.0)])).tolist()
    cells = [cell for cell in cells if whole.contains(shapely.point_on_surface(cell))]
    slope = st.sampled_from([0.0, 0.0, 0.3, -0.5, 0.8])
    planes = [plane(draw(slope), draw(slope), draw(st.sampled_from([14.0, 14.2, 14.5, 15.0, 17.0]))) for _ in cells]
    walls = whole
    for polygon in (whole.exterior, *whole.interiors):
        for a, b in itertools.pairwise(polygon.coords):
            strip = shapely.buffer(shapely.LineString([a, b]), draw(number(0, 900)), cap_style="flat")
            walls = shapely.difference(walls, strip, grid_size=1.0)
    to_m = [shapely.transform(cell, lambda xy: xy / 1e3) for cell in cells]
    return to_m, planes, shapely.transform(walls, lambda xy: xy / 1e3)


@settings(max_examples=examples(60), deadline=None)
@given(plan=plans(), thickness_mm=st.sampled_from([50, 200, 300]))
def test_random_roofs_over_random_walls_are_valid_or_refused_with_a_reason(
    plan: tuple[list[Polygon], list[Plane], shapely.Geometry], thickness_mm: int, volume: Volume
) -> None:
    polygons, planes, walls = plan
    assume(not walls.is_empty)
    try:
        parts = solid_parts(partition_of(polygons), planes, 0.0)
    except BuildingError:
        assume(False)
    assume(not any(check_solid(part.solid) for part in parts))
    try:
        solids = hung(parts, planes, walls, thickness_m=thickness_mm / 1e3)
    except UndrawableError:
        return
    for part, solid in zip(parts, solids, strict=True):
        assert volume(solid) == pytest.approx(volume(part.solid) - beneath(solid), abs=0.1)
        assert area(solid, FaceKind.CEILING) + floor_m2(solid) == pytest.approx(part.footprint.area, abs=0.1)
        assert floor_m2(solid) >= shapely.intersection(part.footprint, walls).area - 0.1


def street(footprint: Polygon) -> FacadePoints:
    """Ground all around a footprint, under a flat roof."""
    x0, y0, x1, y1 = footprint.bounds
    ground = np.random.default_rng(0).uniform((x0 - 3, y0 - 3, 0), (x1 + 3, y1 + 3, 0), (6000, 3))
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(x0, x1, 0.4), np.arange(y0, y1, 0.4)))
    outside = ~shapely.contains_xy(footprint, ground[:, 0], ground[:, 1])
    return FacadePoints.of(ground[outside], NONE, np.column_stack((x, y, np.full(len(x), 6.0))), NONE, 0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
def test_a_given_overhang_reaches_beyond_a_given_footprint(
    exact_roof: ExactRoofs, volume: Volume, kind: str, turn_deg: float
) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, with_footprint=True)
    parts = roof.parts()
    wider = wider_parts(parts, list(roof.planes), street(roof.footprint), 0.4, 0.0)
    eaves = shapely.buffer(roof.footprint, 0.4, join_style="mitre")
    assert [len(part.faces) for part in wider] == [len(part.faces) for part in parts]
    (solid,) = hung(wider, roof.planes, parts[0].footprint)
    assert area(solid, FaceKind.ROOF) == pytest.approx(eaves.area, abs=0.05)
    assert floor_m2(solid) == pytest.approx(roof.footprint.area, abs=0.05)
    assert volume(solid) == pytest.approx(
        volume(parts[0].solid) + THICK_M * (eaves.area - roof.footprint.area), abs=0.02
    )
    for polygon, corners in faces_in_plan(solid, FaceKind.ROOF):
        assert polygon.is_valid
        assert (
            min(np.abs(p.a * corners[:, 0] + p.b * corners[:, 1] + p.c - corners[:, 2]).max() for p in roof.planes)
            < 0.02
        )


def test_a_given_footprint_without_open_ground_has_no_overhang() -> None:
    polygons, planes = GABLE
    parts = solid_parts(partition_of(polygons), planes, 0.0)
    nothing = FacadePoints.of(NONE, NONE, np.array([[5.0, 4.0, 8.0]]), NONE, 0.0)
    with pytest.raises(UndrawableError) as raised:
        wider_parts(parts, planes, nothing, 0.4, 0.0)
    assert raised.value.reason is NoOverhang.NO_OPEN_GROUND
