"""Planes and roof faces made by hand, and what holds for the rings of every closed solid."""

import collections
from collections.abc import Iterable, Sequence

import numpy as np
import shapely

from pipeline.model import Plane
from pipeline.roof.partition import RoofPartition


def plane(a: float, b: float, c: float) -> Plane:
    """Z = a x + b y + c, metres."""
    return Plane(a=a, b=b, c=c, n_points=1, rmse_m=0.0)


def level(z: float) -> Plane:
    return plane(0.0, 0.0, z)


def partition_of(polygons: Iterable[shapely.Polygon]) -> RoofPartition:
    """Faces with a plane each, from polygons in metres."""
    in_mm = tuple(shapely.transform(polygon, lambda xy: np.rint(xy * 1e3)) for polygon in polygons)
    return RoofPartition(polygons=in_mm, labels=np.arange(len(in_mm), dtype=np.int32))


def assert_closed(rings: Iterable[Sequence[int]]) -> None:
    """Every edge of the rings of a solid belongs to two of them that run it both ways."""
    edges = collections.Counter(edge for ring in rings for edge in zip(ring, [*ring[1:], ring[0]], strict=True))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
