"""Candidates made of points, as a run makes them: on the millimetre grid and in canonical order."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.model import Candidate, FloatArray, IntArray, LabelArray

Matrix = tuple[tuple[int, int], tuple[int, int]]
Plane = tuple[float, float, float]

TURNS: list[Matrix] = [((-1, 0), (0, 1)), ((0, -1), (1, 0)), ((0, 1), (1, 0))]
"""Mirrored, turned by 90 degrees, both axes swapped."""


def candidate(points: npt.ArrayLike, **fields: Any) -> Candidate:
    """A candidate over the floor 0 with these points, (n, 3) metres; `fields` are further ones of `Candidate`.

    As in a run, a given footprint says that there is a building.
    """
    points = np.rint(np.asarray(points, np.float64).reshape(-1, 3) * 1e3) / 1e3
    points = points[np.lexsort((points[:, 2], points[:, 1], points[:, 0]))]
    values = {
        "building_id": "b",
        "origin": (84_000.0, 447_000.0, 0.0),
        "points": points,
        "ground": np.zeros((0, 3)),
        "ground_z_m": 0.0,
        "is_known": fields.get("footprint") is not None,
    }
    return Candidate(**(values | fields))


def moved(one: Candidate, shift: FloatArray) -> Candidate:
    """The candidate elsewhere, by whole metres (3,)."""
    points, ground = (np.rint((part + shift) * 1e3) / 1e3 for part in (one.points, one.ground))
    return dataclasses.replace(one, points=points, ground=ground, ground_z_m=one.ground_z_m + float(shift[2]))


def turned(one: Candidate, matrix: Matrix) -> tuple[Candidate, IntArray]:
    """The candidate with its plan multiplied by one of TURNS, and the former number of each of its points."""
    points, ground = one.points.copy(), one.ground.copy()
    points[:, :2], ground[:, :2] = points[:, :2] @ np.array(matrix).T, ground[:, :2] @ np.array(matrix).T
    order = np.lexsort(points.T[::-1])
    return dataclasses.replace(one, points=points[order], ground=ground), order


def turned_plan(uv: FloatArray, degrees: float) -> FloatArray:
    """Places (n, 2) turned anticlockwise about the origin."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return uv @ np.array([[cos, sin], [-sin, cos]])


def strewn(
    height: Callable[[FloatArray, FloatArray], FloatArray],
    *,
    length: float = 14.0,
    width: float = 8.0,
    density: float,
    noise: float,
    seed: int,
    turn_deg: float = 17.0,
) -> FloatArray:
    """Points (n, 3) strewn over a turned rectangle about the origin, with heights by its own axes u and v, metres."""
    random = np.random.default_rng(seed)
    uv = random.uniform(-0.5, 0.5, (random.poisson(density * length * width), 2)) * [length, width]
    z = height(uv[:, 0], uv[:, 1]) + random.normal(0, noise, len(uv))
    return np.column_stack([turned_plan(uv, turn_deg), z])


def lowest_of(planes: Sequence[Plane]) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Heights of the lowest of some planes z = a u + b v + c."""
    return lambda u, v: np.min([a * u + b * v + c for a, b, c in planes], axis=0)


def gable_planes(pitch_deg: float = 35.0, other_deg: float | None = None) -> list[Plane]:
    """Two planes with their ridge along u, 8 m high."""
    first, second = (math.tan(math.radians(deg)) for deg in (pitch_deg, pitch_deg if other_deg is None else other_deg))
    return [(0, first, 8.0), (0, -second, 8.0)]


def hip_planes() -> list[Plane]:
    """Four planes of 35 degrees over 14 x 8 m."""
    rise = math.tan(math.radians(35.0))
    return [*gable_planes(), (-rise, 0, 5 + 7 * rise), (rise, 0, 5 + 7 * rise)]


def same_partition(a: LabelArray, b: LabelArray) -> bool:
    """Whether two labellings (n,) make the same groups, whatever they call them."""
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return len(pairs) == len(set(a.tolist())) == len(set(b.tolist()))
