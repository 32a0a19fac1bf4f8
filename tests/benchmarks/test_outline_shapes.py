"""Outlines beside true ones, drawn by hand."""

import math
from typing import Any

import numpy as np
import pytest
import shapely

from benchmarks.outline_shapes import Judged, corners_of, judged, shape_table, sigma_cells

HOUSE = shapely.box(0.0, 0.0, 10.0, 6.0)


def test_the_true_outline_is_found_whole() -> None:
    found = judged(HOUSE, [HOUSE], [0.1], per_m2=4.0)
    assert (found.iou, found.right, found.found, found.true) == (pytest.approx(1.0), 4, 4, 4)
    assert found.angle_deg == pytest.approx(0.0, abs=1e-4)
    assert sorted(edge[0] for edge in found.edges) == pytest.approx([6.0, 6.0, 10.0, 10.0])
    assert [edge[1:] for edge in found.edges] == [pytest.approx((0.0, 0.1), abs=1e-9)] * 4


def test_houses_of_a_row_are_held_against_their_block() -> None:
    halves = [shapely.box(0.0, 0.0, 4.9, 6.0), shapely.box(5.1, 0.0, 10.0, 6.0)]
    found = judged(HOUSE, halves, [0.1, 0.2], per_m2=4.0)
    assert (found.iou, found.right, found.found) == (pytest.approx(1.0), 4, 4)


def test_an_outline_of_parts_shows_the_edges_and_corners_of_all() -> None:
    parts = shapely.MultiPolygon([HOUSE, shapely.box(20.0, 0.0, 24.0, 6.0)])
    found = judged(HOUSE, [parts], [0.1], per_m2=4.0)
    assert (found.right, found.found, len(corners_of(parts))) == (4, 8, 8)
    assert [edge[1] for edge in found.edges] == pytest.approx([0.0] * 4, abs=1e-9)


def test_distances_are_positive_outwards_and_taken_from_the_nearest_parallel_edge() -> None:
    found = judged(HOUSE, [shapely.box(-0.3, 0.0, 10.0, 5.8)], [0.25], per_m2=4.0)
    distances = sorted(edge[1] for edge in found.edges)
    assert distances == pytest.approx([-0.2, 0.0, 0.0, 0.3])
    cells = sigma_cells([found])
    assert cells[:3] == ["4", "0.000", "0.750"]
    assert float(cells[-1]) == pytest.approx(math.sqrt(0.13 / 4), abs=1e-3)


def test_an_edge_without_a_parallel_one_nearby_is_missed_and_beyond_any_sigma() -> None:
    triangle = shapely.Polygon([(0.0, 0.0), (10.0, 0.0), (10.0, 6.0)])
    found = judged(HOUSE, [triangle], [9.0], per_m2=4.0)
    assert sum(math.isnan(edge[1]) for edge in found.edges) == 2
    assert sigma_cells([found])[1:3] == ["0.500", "0.500"]


def test_a_turned_outline_has_its_angle_and_no_short_edges_are_judged() -> None:
    turned = shapely.transform(HOUSE, lambda xy: xy @ np.array([(0.9986295, 0.0523360), (-0.0523360, 0.9986295)]))
    assert judged(HOUSE, [turned], [math.nan], per_m2=4.0).angle_deg == pytest.approx(3.0, abs=1e-3)
    assert judged(shapely.box(0, 0, 1.9, 1.9), [HOUSE], [math.nan], per_m2=4.0).edges == ()


def test_corners_turn_by_more_than_ten_degrees_and_are_paired_one_to_one() -> None:
    assert len(corners_of(HOUSE)) == 4
    assert len(corners_of(shapely.Point(0.0, 0.0).buffer(5.0, quad_segs=12))) == 0
    notched = shapely.difference(HOUSE, shapely.box(0.0, 0.0, 0.2, 0.2))
    found = judged(HOUSE, [notched], [math.nan], per_m2=4.0)
    assert (found.right, found.found, found.true) == (4, 6, 4)


def test_changes_are_those_of_buildings_that_both_found() -> None:
    labels: dict[str, Any] = {"shape": "bend", "per_m2": 25.0, "angle_deg": 1.0}
    own = [Judged(code="new", building=name, iou=iou, **labels) for name, iou in (("a", 0.9), ("b", 0.8))]
    old = [Judged(code="old", building=name, iou=iou, **labels) for name, iou in (("a", 0.7), ("b", 0.0))]
    line = shape_table([*own, *old], "new", "old").splitlines()[2]
    assert "| 0.2 | bend | 2 of 2 | 0.850 | 0.850 |" in line
    assert "| +0.200 ± 0.000 | 1 of 2 | 0.350 | 0.700 |" in line
