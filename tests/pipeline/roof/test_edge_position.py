"""Where an edge is put: without bias for any pattern of points, drawn back by what mixed pulses add, and no more."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from candidates_by_hand import turned_plan
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.roof.edge_position import EdgePoints, mixed_pulse_reach_mm, outward_shift_mm
from pipeline.roof.lines import Run
from pipeline.roof.outlines.exterior import straighten
from pipeline.roof.roof_settings import RoofSettings

LENGTH_M, DEPTH_M = 14.0, 9.0
BOX_MM = shapely.box(0.0, 0.0, LENGTH_M * 1e3, DEPTH_M * 1e3)
Pattern = Callable[[np.random.Generator, float], FloatArray]
"""Positions over a square of 40 m about the origin, at a spacing in metres."""


def strewn(rng: np.random.Generator, spacing_m: float) -> FloatArray:
    return rng.uniform(-20.0, 20.0, (round((40.0 / spacing_m) ** 2), 2))


def lattice(rng: np.random.Generator, spacing_m: float) -> FloatArray:
    steps = np.arange(-30.0, 30.0, spacing_m)
    xy = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) + rng.uniform(0.0, spacing_m, 2)
    return turned_plan(xy, rng.uniform(0.0, 180.0))


def scan_rows(rng: np.random.Generator, spacing_m: float) -> FloatArray:
    """Rows three times as far apart as the points in them."""
    along, across = spacing_m / math.sqrt(3.0), spacing_m * math.sqrt(3.0)
    xy = np.stack(np.meshgrid(np.arange(-30.0, 30.0, along), np.arange(-30.0, 30.0, across)), -1).reshape(-1, 2)
    xy = xy + rng.uniform(0.0, 1.0, 2) * (along, across) + rng.normal(0.0, 0.1 * along, xy.shape)
    return turned_plan(xy, rng.uniform(0.0, 180.0))


def in_mm(xy: FloatArray) -> IntArray:
    return np.rint(xy * 1e3).astype(np.int64)


def edge_of(xy: FloatArray, split: BoolArray, spacing_m: float, reach_m: float = 0.0, raw_m: float = 0.0) -> float:
    """Where the lower edge of a box around x in (0, LENGTH_M), y in (0, DEPTH_M) is put, metres outwards of y = 0."""
    border = np.array([[0.0, 0.0], [LENGTH_M, 0.0], [LENGTH_M, DEPTH_M], [0.0, DEPTH_M]]) * 1e3
    border[:2, 1] -= raw_m * 1e3
    run = Run(first=0, last=1, x=0.5 * LENGTH_M * 1e3, y=-raw_m * 1e3, direction=0.0, length=LENGTH_M * 1e3)
    shift = outward_shift_mm(border, run, EdgePoints.of(in_mm(xy), split, spacing_m), reach_m * 1e3)
    assert shift is not None
    return raw_m + shift * 1e-3


def in_box(xy: FloatArray, grown_m: float = 0.0) -> BoolArray:
    inside: BoolArray = (
        (xy[:, 0] > -grown_m) & (xy[:, 0] < LENGTH_M + grown_m) & (xy[:, 1] > -grown_m) & (xy[:, 1] < DEPTH_M + grown_m)
    )
    return inside


@pytest.mark.parametrize("pattern", [strewn, lattice, scan_rows])
@pytest.mark.parametrize("spacing_m", [0.25, 1.0])
def test_the_edge_of_sampled_points_is_put_without_bias(pattern: Pattern, spacing_m: float) -> None:
    found, outermost = [], []
    for seed in range(60):
        xy = pattern(np.random.default_rng(seed), spacing_m)
        xy = xy[in_box(xy)]
        found.append(edge_of(xy, np.zeros(len(xy), np.bool_), spacing_m, raw_m=0.1 * spacing_m))
        outermost.append(-xy[:, 1].min())
    error = np.std(found) / math.sqrt(len(found))
    assert abs(np.mean(found)) < 0.03 * spacing_m + 2.5 * error
    assert np.std(found) < 0.45 * spacing_m
    assert max(outermost) < 0.0


def test_where_the_raw_line_lay_does_not_matter() -> None:
    xy = strewn(np.random.default_rng(5), 0.5)
    xy = xy[in_box(xy)]
    split = np.zeros(len(xy), np.bool_)
    places = [edge_of(xy, split, 0.5, raw_m=raw) for raw in (-0.1, 0.0, 0.1, 0.3)]
    assert np.ptp(places) < 0.01


def scanned(seed: int, spacing_m: float, reach_m: float) -> tuple[FloatArray, BoolArray]:
    """A box as a beam of some radius sees it: points up to the radius outside, split up to the radius inside."""
    xy = strewn(np.random.default_rng(seed), spacing_m)
    xy = xy[in_box(xy, reach_m)]
    return xy, ~in_box(xy, -reach_m)


@pytest.mark.parametrize("reach_m", [0.1, 0.3])
@pytest.mark.parametrize("spacing_m", [0.25, 0.7])
def test_split_pulses_tell_how_far_the_roof_is_seen_too_large(spacing_m: float, reach_m: float) -> None:
    reaches, edges = [], []
    for seed in range(30):
        xy, split = scanned(seed, spacing_m, reach_m)
        points = EdgePoints.of(in_mm(xy), split, spacing_m)
        reaches.append(mixed_pulse_reach_mm(BOX_MM, points) * 1e-3)
        edges.append(edge_of(xy, split, spacing_m, reach_m=reaches[-1]))
    assert np.mean(reaches) == pytest.approx(reach_m, rel=0.12)
    assert abs(np.mean(edges)) < 0.05 * spacing_m + 0.1 * reach_m


def test_without_split_pulses_nothing_is_drawn_back() -> None:
    xy, split = scanned(1, 0.3, 0.2)
    assert mixed_pulse_reach_mm(BOX_MM, EdgePoints.of(in_mm(xy), np.zeros_like(split), 0.3)) == 0.0
    found = [edge_of(xy, np.zeros(len(xy), np.bool_), 0.3) for xy, _ in (scanned(seed, 0.3, 0.2) for seed in range(20))]
    assert np.mean(found) == pytest.approx(0.2, abs=0.03)


def test_split_pulses_all_over_a_roof_are_not_taken_for_its_edge() -> None:
    rng = np.random.default_rng(2)
    xy = strewn(rng, 0.25)
    xy = xy[in_box(xy)]
    split = rng.uniform(size=len(xy)) < 0.1
    assert mixed_pulse_reach_mm(BOX_MM, EdgePoints.of(in_mm(xy), split, 0.25)) < 25.0


def test_an_edge_to_a_neighbour_without_split_pulses_is_not_drawn_back() -> None:
    free, party = [], []
    for seed in range(20):
        xy, split = scanned(seed, 0.25, 0.2)
        free.append(edge_of(xy, split, 0.25, reach_m=0.2))
        # the neighbour's points begin at y = 0, and no pulse reaches the ground there
        own = in_box(xy) | (xy[:, 1] > 1.0)
        party.append(edge_of(xy[own], (split & (xy[:, 1] > 1.0))[own], 0.25, reach_m=0.2))
    assert np.mean(free) == pytest.approx(0.0, abs=0.02)
    assert np.mean(party) == pytest.approx(0.0, abs=0.02)


def test_a_stretch_too_short_or_too_empty_is_left_where_it_is() -> None:
    border = np.array([[0.0, 0.0], [2000.0, 0.0], [2000.0, 2000.0]])
    run = Run(first=0, last=1, x=1000.0, y=0.0, direction=0.0, length=2000.0)
    xy = in_mm(np.random.default_rng(0).uniform(0.0, 2.0, (50, 2)))
    split = np.zeros(50, np.bool_)
    assert outward_shift_mm(border, run, EdgePoints.of(xy, split, 1.0), 0.0) is None
    assert outward_shift_mm(border, run, EdgePoints.of(xy, split, 0.3), 0.0) is not None
    assert outward_shift_mm(border, run, EdgePoints.of(xy + 90_000, split, 0.3), 0.0) is None


def test_the_order_of_the_points_does_not_matter() -> None:
    xy, split = scanned(4, 0.5, 0.1)
    order = np.random.default_rng(9).permutation(len(xy))
    assert edge_of(xy, split, 0.5, 0.1) == edge_of(xy[order], split[order], 0.5, 0.1)


def shift_by_loops(xy: IntArray, spacing: float, first: float, last: float) -> float:
    """The scalar twin for a line along y = 0 with the roof above it, millimetres, without split pulses."""
    first, last = first + 0.6 * spacing, last - 0.6 * spacing
    strips = math.floor((last - first) / (2.0 * spacing))
    width = (last - first) / strips
    depth = max(6.0 * spacing, 4.0 * (500.0 + 0.25 * spacing))
    columns: list[list[float]] = [[] for _ in range(strips)]
    for x, y in xy.tolist():
        if first <= x < last and -1.5 * spacing <= y <= depth:
            columns[min(int((x - first) / width), strips - 1)].append(-y)
    mean = spacing**2 / width
    total, squares, places = 8.0 * mean, 8.0 * 1.5 * mean**2, []
    for column in columns:
        column.sort(reverse=True)
        places += column[:1]
        for a, b in itertools.pairwise(column):
            if a - b > 2.5 * spacing:
                break
            total += a - b
            squares += (a - b) ** 2
    age = squares / (2.0 * total)
    middle = sorted(places)[len(places) // 2]
    near = [place for place in places if abs(place - middle) <= max(4.0 * age, spacing)]
    return sum(near) / len(near) + age


@pytest.mark.parametrize("seed", range(6))
def test_the_shift_is_that_of_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = strewn(rng, 0.6)
    xy = xy[in_box(xy) & ~((xy[:, 0] > 4.0) & (xy[:, 0] < 6.0) & (xy[:, 1] > 0.8) & (xy[:, 1] < 3.4))]
    twin = shift_by_loops(in_mm(xy), 600.0, 0.0, LENGTH_M * 1e3)
    assert edge_of(xy, np.zeros(len(xy), np.bool_), 0.6) * 1e3 == pytest.approx(twin, abs=1e-6)


@pytest.mark.parametrize("turn_deg", [0.0, 33.0])
def test_a_straightened_outline_has_the_area_of_the_roof(turn_deg: float) -> None:
    truth = shapely.affinity.rotate(shapely.box(0, 0, LENGTH_M, DEPTH_M), turn_deg, origin=(0, 0))
    bias = []
    for seed in range(12):
        xy, split = scanned(seed, 0.5, 0.15)
        xy = turned_plan(xy, turn_deg)
        raw = MultiPolygon([Polygon(np.rint(shapely.get_coordinates(truth.buffer(0.2, join_style="mitre")) * 1e3))])
        drawn = straighten(raw, 0.5, RoofSettings(), EdgePoints.of(in_mm(xy), split, 0.5))
        assert drawn.is_valid
        assert len(shapely.get_coordinates(drawn)) == 5
        bias.append(drawn.area * 1e-6 / truth.area - 1.0)
    assert abs(np.mean(bias)) < 0.01
    assert np.max(np.abs(bias)) < 0.05
