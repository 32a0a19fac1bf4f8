"""Orientation of points in the plane: on whole numbers below 2^31 every test is exact."""

from __future__ import annotations

from pipeline.compiler import kernel
from pipeline.model import IntArray


@kernel
def turn_of(xy: IntArray, a: int, b: int, c: int) -> int:
    """Twice the signed area of the triangle a, b, c of points (n, 2) int64: positive where it turns left."""
    right, up = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
    return int(right * (xy[c, 1] - xy[a, 1]) - up * (xy[c, 0] - xy[a, 0]))


@kernel
def same_place(xy: IntArray, a: int, b: int) -> bool:
    """Whether two points coincide."""
    return bool(xy[a, 0] == xy[b, 0] and xy[a, 1] == xy[b, 1])


@kernel
def comes_before(xyz: IntArray, a: int, b: int) -> bool:
    """Whether point a of (n, 3) comes before b by x, then y, then z."""
    for axis in range(3):
        if xyz[a, axis] != xyz[b, axis]:
            return bool(xyz[a, axis] < xyz[b, axis])
    return False


@kernel
def same_ray(xy: IntArray, a: int, b: int, c: int) -> bool:
    """Whether b and c lie in the same direction from a."""
    if turn_of(xy, a, b, c) != 0:
        return False
    along = (xy[b, 0] - xy[a, 0]) * (xy[c, 0] - xy[a, 0]) + (xy[b, 1] - xy[a, 1]) * (xy[c, 1] - xy[a, 1])
    return bool(along > 0)


@kernel(inline="always")
def lies_between(xy: IntArray, a: int, b: int, p: int) -> bool:
    """Whether p, which is on the line through a and b, is between them or at an end."""
    between_x: bool = min(xy[a, 0], xy[b, 0]) <= xy[p, 0] <= max(xy[a, 0], xy[b, 0])
    between_y: bool = min(xy[a, 1], xy[b, 1]) <= xy[p, 1] <= max(xy[a, 1], xy[b, 1])
    return between_x and between_y


@kernel
def in_cone(xy: IntArray, before: int, node: int, after: int, target: int) -> bool:
    """Whether the way from node to target starts strictly inside the polygon on the left of before, node, after."""
    left_of_first = turn_of(xy, before, node, target)
    left_of_second = turn_of(xy, node, after, target)
    if turn_of(xy, before, node, after) > 0:
        return left_of_first > 0 and left_of_second > 0
    return left_of_first > 0 or left_of_second > 0


@kernel
def segments_meet(xy: IntArray, a: int, b: int, c: int, d: int) -> bool:
    """Whether the closed segments a, b and c, d have a point in common."""
    for axis in range(2):
        if max(xy[a, axis], xy[b, axis]) < min(xy[c, axis], xy[d, axis]):
            return False
        if max(xy[c, axis], xy[d, axis]) < min(xy[a, axis], xy[b, axis]):
            return False
    # boxes that meet and no two ends strictly on one side: on one line, too, the segments then have a common point
    side_c, side_d = turn_of(xy, a, b, c), turn_of(xy, a, b, d)
    if (side_c > 0 and side_d > 0) or (side_c < 0 and side_d < 0):
        return False
    side_a, side_b = turn_of(xy, c, d, a), turn_of(xy, c, d, b)
    return not ((side_a > 0 and side_b > 0) or (side_a < 0 and side_b < 0))
