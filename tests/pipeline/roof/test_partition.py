"""The partition of the plan: a coverage with one polygon a connected region, wherever labels lie."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from candidates_by_hand import candidate, moved
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import BuildingError
from pipeline.model import IntArray, LabelArray, Plane, Reason, Solid, Tin
from pipeline.prepared_cloud import prepare_cloud
from pipeline.quality.validity import check_solid
from pipeline.roof.partition import MinAreas, RoofPartition, absorb_small_regions, connected_regions, march
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.simplification import simplify_partition, unite_close_vertices
from pipeline.roof.solid import solid_parts
from pipeline.roof.traced_forms import plan_forms
from pipeline.roof.unsupported_faces import cut_at_floor, level_unsupported_faces
from pipeline.tin.delaunay import triangulate

ExactRoofs = Callable[..., Any]
Volume = Callable[[Solid], float]

FLAT = np.zeros((3, 3))


def grid_with_frame(n: int, pitch: int = 500) -> IntArray:
    axis = np.arange(n) * pitch
    inner = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    inner = inner + np.column_stack((inner[:, 1] // pitch % 2 * (pitch // 2), np.zeros(len(inner), np.int64)))
    low, high = -3 * pitch, (n + 3) * pitch
    frame = np.array([(low, low), (high, low - 1), (high + 1, high), (low - 1, high + 1)])
    return np.concatenate((inner, frame)).astype(np.int64)


def labelled(n: int, values: npt.ArrayLike) -> tuple[IntArray, Tin, LabelArray]:
    xy = grid_with_frame(n)
    labels = np.full(len(xy), -1, np.int32)
    labels[: n * n] = np.asarray(values, np.int32).ravel()
    return xy, triangulate(xy), labels


def absorbed(
    xy: IntArray, z: npt.ArrayLike, tin: Tin, labels: LabelArray, levels_m: list[float], areas: MinAreas
) -> LabelArray:
    """The labels without small regions, where every vertex has a point at its elevation; level planes."""
    x, y, z = xy[:, 0].copy(), xy[:, 1].copy(), np.broadcast_to(z, len(xy)).astype(np.float64)
    planes = np.array([(0.0, 0.0, level) for level in levels_m])
    return absorb_small_regions(x, y, z, tin.facets, labels, np.ones(len(xy), np.int32), planes, areas)


def polygons_are_a_coverage(partition: RoofPartition) -> bool:
    array = np.array(partition.polygons, dtype=object)
    return bool(shapely.is_valid(array).all() and shapely.coverage_is_valid(array))


def slow_regions(facets: LabelArray, labels: Any) -> list[frozenset[int]]:
    adjacent = {v: set() for v in range(len(labels))}
    for a, b, c in facets.tolist():
        for p, q in ((a, b), (b, c), (c, a)):
            if labels[p] == labels[q]:
                adjacent[p].add(q)
                adjacent[q].add(p)
    seen, groups = set(), []
    for v in range(len(labels)):
        if v in seen:
            continue
        group, todo = set(), [v]
        while todo:
            w = todo.pop()
            if w not in group:
                group.add(w)
                todo.extend(adjacent[w])
        seen |= group
        groups.append(frozenset(group))
    return groups


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(40), deadline=None)
def test_any_labels_give_a_coverage_with_one_polygon_a_region(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, tin, labels = labelled(7, rng.integers(-1, 3, (7, 7)))
    planes = rng.uniform(-1, 1, (3, 3)) + np.array([0, 0, 5])
    if (labels < 0).all():
        return
    partition = march(xy, tin, labels, planes, 0.4, 0.1)
    assert polygons_are_a_coverage(partition)
    groups = [g for g in slow_regions(tin.facets, labels) if labels[min(g)] >= 0]
    assert len(partition.polygons) == len(groups)
    # every vertex lies in the polygon of its own region and label
    for group in groups:
        inside = [
            k for k, p in enumerate(partition.polygons) if all(shapely.contains_xy(p, *xy[v].tolist()) for v in group)
        ]
        assert len(inside) == 1
        assert partition.labels[inside[0]] == labels[min(group)]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(20), deadline=None)
def test_regions_are_those_of_a_plain_search(seed: int) -> None:
    _, tin, labels = labelled(6, np.random.default_rng(seed).integers(-1, 2, (6, 6)))
    regions, count = connected_regions(tin.facets, labels)
    groups = slow_regions(tin.facets, labels)
    assert count == len(groups)
    assert all(len({int(regions[v]) for v in group}) == 1 for group in groups)


def test_the_border_of_two_planes_runs_where_they_cross() -> None:
    values = np.zeros((8, 8), np.int32)
    values[4:] = 1
    xy, tin, labels = labelled(8, values)
    planes = np.array([[0.0, 0.5, 3.0], [0.0, -0.5, 3.0 + 1.8]])
    partition = march(xy, tin, labels, planes, 0.4, 0.1)
    border = shapely.intersection(*partition.polygons)
    assert np.abs(shapely.get_coordinates(border)[1:-1, 1] - 1800.0).max() <= 1.0


def test_a_lone_vertex_in_a_roof_is_absorbed_and_a_courtyard_stays() -> None:
    values = np.zeros((12, 12), np.int32)
    values[2, 2] = 1
    values[5:10, 5:10] = -1
    xy, tin, labels = labelled(12, values)
    cleaned = absorbed(xy, 5.0, tin, labels, [5.0, 6.0], MinAreas(1.0, 4.0))
    assert (cleaned == 1).sum() == 0
    assert (cleaned[: 12 * 12] == -1).sum() == 25
    filled = absorbed(xy, 5.0, tin, labels, [5.0, 6.0], MinAreas(1.0, 40.0))
    assert (filled[: 12 * 12] == 0).all()
    assert (filled[12 * 12 :] == -1).all()


def test_any_number_of_gaps_in_one_roof_is_closed() -> None:
    values = np.zeros((60, 60), np.int32)
    values[2:-2:4, 2:-2:4] = -1
    assert (values < 0).sum() > 150
    xy, tin, labels = labelled(60, values)
    closed = absorbed(xy, 5.0, tin, labels, [5.0], MinAreas(1.0, 4.0))
    assert (closed[: 60 * 60] == 0).all()


def test_a_small_region_joins_the_plane_that_fits_it() -> None:
    values = np.zeros((9, 9), np.int32)
    values[:, 4] = 2
    values[:, 5:] = 1
    xy, tin, labels = labelled(9, values)
    cleaned = absorbed(xy, np.where(labels == 0, 3.0, 9.0), tin, labels, [3.0, 9.0, 6.0], MinAreas(5.0, 5.0))
    assert (cleaned[np.flatnonzero(labels == 2)] == 1).all()


def test_no_roof_vertex_is_an_error_with_its_reason() -> None:
    xy, tin, labels = labelled(4, np.full((4, 4), -1))
    with pytest.raises(BuildingError) as caught:
        march(xy, tin, labels, FLAT, 0.4, 0.1)
    assert caught.value.reason is Reason.NO_PARTITION


def test_simplification_keeps_the_coverage_and_drops_vertices(exact_roof: ExactRoofs) -> None:
    plan, roof, _ = exact_roof("stepped", noise_m=0.03).partition()
    simple = simplify_partition(plan.raw, roof.spacing_m)
    assert polygons_are_a_coverage(simple)
    before, after = (sum(shapely.get_num_coordinates(list(p.polygons))) for p in (plan.raw, simple))
    assert after < 0.5 * before
    kept = {tuple(v) for p in simple.polygons for v in shapely.get_coordinates(p).tolist()}
    assert kept <= {tuple(v) for p in plan.raw.polygons for v in shapely.get_coordinates(p).tolist()}


def test_vertices_a_few_millimetres_apart_become_one_in_both_polygons() -> None:
    left = shapely.Polygon([(0, 0), (1000, 0), (1003, 500), (1002, 502), (1000, 1000), (0, 1000)])
    right = shapely.Polygon([(1000, 0), (2000, 0), (2000, 1000), (1000, 1000), (1002, 502), (1003, 500)])
    united = unite_close_vertices(RoofPartition(polygons=(left, right), labels=np.array([0, 1], np.int32)), 5.0)
    assert polygons_are_a_coverage(united)
    assert sum(shapely.get_num_coordinates(list(united.polygons))) == 6 + 6


def test_a_shift_by_whole_metres_shifts_the_solid_to_the_bit(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("l", noise_m=0.02, turn_deg=23.0)
    shift = np.array([137.0, -64.0, 0.0])
    planes = tuple(dataclasses.replace(p, c=p.c - p.a * shift[0] - p.b * shift[1]) for p in roof.planes)
    elsewhere = dataclasses.replace(roof, candidate=moved(roof.candidate, shift), planes=planes)
    for here, there in zip(roof.parts(), elsewhere.parts(), strict=True):
        assert here.solid.faces == there.solid.faces
        assert np.array_equal(np.rint((here.solid.vertices + shift) * 1e3), np.rint(there.solid.vertices * 1e3))


def test_the_order_of_points_does_not_matter(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("dormer", noise_m=0.02)

    def faces(some_roof: Any) -> list[tuple[int, str]]:
        return sorted(
            (face.plane, shapely.normalize(face.polygon).wkb_hex) for p in some_roof.parts() for face in p.faces
        )

    order = np.random.default_rng(5).permutation(len(roof.labels))
    mixed = dataclasses.replace(roof.candidate, points=roof.candidate.points[order])
    assert faces(dataclasses.replace(roof, candidate=mixed, labels=roof.labels[order])) == faces(roof)


@pytest.mark.parametrize("kind", ["hip", "l", "dormer"])
def test_a_mirrored_roof_gives_a_valid_solid_of_the_same_volume(
    exact_roof: ExactRoofs, volume: Volume, kind: str
) -> None:
    roof = exact_roof(kind, with_footprint=True)
    footprint = shapely.transform(roof.candidate.footprint, lambda xy: xy * [-1.0, 1.0])
    planes = tuple(dataclasses.replace(p, a=-p.a) for p in roof.planes)
    other = dataclasses.replace(roof.candidate, points=roof.candidate.points * [-1.0, 1.0, 1.0], footprint=footprint)
    mirrored = dataclasses.replace(roof, candidate=other, planes=planes)
    (here,), (there,) = roof.parts(), mirrored.parts()
    assert check_solid(there.solid) == ()
    assert volume(there.solid) == pytest.approx(volume(here.solid), rel=0.004)


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=examples(60), deadline=None)
def test_random_labels_and_planes_always_give_some_valid_form(seed: int, with_footprint: bool) -> None:
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(20, 400)), int(rng.integers(1, 10))
    size = rng.uniform(4.0, 20.0, 2)
    xy, centres = rng.uniform(0, 1, (n, 2)) * size, rng.uniform(0, 1, (k, 2)) * size
    labels = ((xy[:, None] - centres) ** 2).sum(axis=2).argmin(axis=1).astype(np.int32)
    wrong = rng.uniform(size=n) < rng.uniform(0, 0.5)
    labels[wrong] = rng.integers(-1, k, wrong.sum())
    slopes = rng.uniform(-1.5, 1.5, (k, 2)) * rng.integers(0, 2, (k, 1))
    planes = [
        Plane(a=float(a), b=float(b), c=float(rng.uniform(2, 12) - a * x - b * y), n_points=1, rmse_m=0.0)
        for (a, b), (x, y) in zip(slopes, centres, strict=True)
    ]
    a, b, c = np.array([plane.coefficients for plane in planes])[np.maximum(labels, 0)].T
    z = a * xy[:, 0] + b * xy[:, 1] + c
    points = np.rint(np.column_stack((xy, np.maximum(z + rng.normal(0, 0.1, n), 1.6))) * 1e3) / 1e3
    footprint = shapely.affinity.rotate(shapely.box(*(0.05 * size), *(0.9 * size)), rng.uniform(0, 90))
    unordered = dataclasses.replace(candidate([], footprint=footprint if with_footprint else None), points=points)
    roof_settings = RoofSettings()
    roof = roof_points(prepare_cloud(unordered), roof_settings)
    roof = dataclasses.replace(roof, labels=labels[roof.index])
    if not (roof.labels >= 0).any():
        return
    plan = partition_roof(roof, planes, roof_settings)
    for form in plan_forms(plan, roof, roof_settings):
        try:
            drawn, all_planes = level_unsupported_faces(form(), roof, planes, 0.0, roof_settings)
            drawn, all_planes = cut_at_floor(drawn, all_planes, roof_settings.min_clearance_m)
            parts = solid_parts(drawn, all_planes, 0.0)
        except BuildingError:
            continue
        if not any(check_solid(part.solid) for part in parts):
            return
    pytest.fail("no form of the plan is valid")
