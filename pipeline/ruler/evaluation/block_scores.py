"""True buildings that touch, joined to blocks, for runs without footprints.

Without given footprints, the points do not show where one house of a row ends and the next begins. The source_id of
every simulated building is its block.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import shapely

from pipeline.kernels.union_find import united
from pipeline.model import IntArray, LabelArray, RoofType
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import Conditions, Reference, ReferencePoints

BLOCK_SHAPE = "block"
"""Shape of a block of several buildings, in their conditions."""
_TOUCH_M = 0.02
"""Surfaces that are closer touch, or lie in one plane; well above the rounding of 1 mm."""
_MIN_BORDER_M = 0.5
"""Least length of a common border: corners do not count."""


def joined_reference(reference: Reference) -> Reference:
    """The reference with buildings that share a source_id joined; single ones, or those without one, stay unchanged.

    The roof type of a block is that of its parts if they agree, else combination; it has the defects of all. Faces keep
    their planes and groups under new numbers. Touching faces of one plane become one group, since the points do not
    separate them.
    """
    numbers = block_numbers(reference.buildings)
    groups: dict[int, list[int]] = {}
    for number, block in enumerate(numbers.tolist()):
        groups.setdefault(block, []).append(number)
    if len(groups) == len(reference.buildings):
        return reference
    block_of = np.full(len(reference.buildings) + 1, -1, np.int32)  # the last one is for index -1: no building
    shift_of = np.zeros(len(reference.buildings) + 1, np.int32)
    buildings: list[RoofModel] = []
    conditions: dict[str, Conditions] = {}
    face_points: dict[tuple[str, int], int] = {}
    for block, members in enumerate(groups.values()):
        parts = [reference.buildings[number] for number in members]
        name = parts[0].building_id
        shift = 0
        surfaces: list[RoofSurface] = []
        for number, part in zip(members, parts, strict=True):
            block_of[number], shift_of[number] = block, shift
            surfaces += [_shifted(surface, shift) for surface in part.surfaces]
            for surface in part.surfaces:
                count = reference.face_points.get((part.building_id, surface.plane_id))
                if count is not None:
                    face_points[name, surface.plane_id + shift] = count
            shift += 1 + max((max(s.plane_id, s.group) for s in part.surfaces), default=-1)
        buildings.append(parts[0] if len(parts) == 1 else joined_building(parts, _with_common_groups(surfaces)))
        known = [reference.conditions[p.building_id] for p in parts if p.building_id in reference.conditions]
        if known:
            conditions[name] = known[0] if len(parts) == 1 else _together(known)
    joined = (
        f"{len(reference.buildings)} true buildings were joined to {len(buildings)}: those that touch count as one "
        "block, for nothing says that the models follow given footprints"
    )
    return dataclasses.replace(
        reference,
        buildings=tuple(buildings),
        tiles=tuple(_renumbered(read, block_of, shift_of) for read in reference.tiles),
        conditions=conditions,
        face_points=face_points,
        notes=(*reference.notes, joined),
    )


def block_numbers(buildings: Sequence[RoofModel]) -> IntArray:
    """The number of the block of each building, (r,), from 0 in the order of first members: one block per source_id."""
    seen: dict[str, int] = {}
    names = [building.source_id or f"alone {number}" for number, building in enumerate(buildings)]
    return np.array([seen.setdefault(name, len(seen)) for name in names], np.int64)


def _shifted(surface: RoofSurface, shift: int) -> RoofSurface:
    plane_id = surface.plane_id + shift if surface.plane_id >= 0 else -1
    group = surface.group + shift if surface.group >= 0 else -1
    return dataclasses.replace(surface, plane_id=plane_id, group=group)


def _with_common_groups(surfaces: Sequence[RoofSurface]) -> list[RoofSurface]:
    """The surfaces, those of one plane that touch in one group, together with the groups that they had."""
    first_of: dict[int, int] = {}
    pairs = [(first_of.setdefault(surface.group, k), k) for k, surface in enumerate(surfaces) if surface.group >= 0]
    polygons = np.array([surface.polygon for surface in surfaces], dtype=object)
    tree = shapely.STRtree(polygons)
    for one, other in tree.query(polygons, predicate="dwithin", distance=_TOUCH_M).T.tolist():
        if one < other and _one_plane(surfaces[one], surfaces[other]) and _touch(polygons[one], polygons[other]):
            pairs.append((one, other))
    roots = united(len(surfaces), *np.array(pairs, np.int64).reshape(-1, 2).T).tolist()
    shared = {k for k, count in Counter(roots).items() if count > 1}
    return [
        dataclasses.replace(surface, group=surfaces[k].plane_id) if k in shared else surface
        for surface, k in zip(surfaces, roots, strict=True)
    ]


def _one_plane(one: RoofSurface, other: RoofSurface) -> bool:
    """Whether the planes agree at all corners of both."""
    for surface in (one, other):
        x, y = shapely.get_coordinates(surface.polygon).T
        if float(np.abs(one.elevation(x, y) - other.elevation(x, y)).max()) > _TOUCH_M:
            return False
    return True


def _touch(one: shapely.Polygon, other: shapely.Polygon) -> bool:
    """Whether two polygons have a piece of border in common, not a corner alone."""
    return bool(shapely.length(shapely.intersection(one.buffer(_TOUCH_M), other.exterior)) > _MIN_BORDER_M)


def joined_building(parts: Sequence[RoofModel], surfaces: Sequence[RoofSurface]) -> RoofModel:
    """Several buildings as one under the name of the first, with all their surfaces and without solids.

    Its roof type is that of the parts if they agree, else combination.
    """
    types = {part.roof_type for part in parts}
    return dataclasses.replace(
        parts[0],
        footprint=shapely.union_all([part.footprint for part in parts], grid_size=0.001),
        roof_type=types.pop() if len(types) == 1 else RoofType.COMBINATION,
        surfaces=tuple(surfaces),
        touches_data_edge=any(part.touches_data_edge for part in parts),
        solids=(),
    )


def _together(parts: Sequence[Conditions]) -> Conditions:
    shapes = {part.shape for part in parts}
    return Conditions(
        shape=shapes.pop() if len(shapes) == 1 else BLOCK_SHAPE,
        good=all(part.good for part in parts),
        defects=tuple(sorted({defect for part in parts for defect in part.defects})),
        pitch_deg=max(part.pitch_deg for part in parts),
        terrain_slope_deg=max(part.terrain_slope_deg for part in parts),
    )


def _renumbered(
    read: Callable[[], ReferencePoints], block_of: LabelArray, shift_of: LabelArray
) -> Callable[[], ReferencePoints]:
    """A reader of a tile whose points name blocks, and the faces of blocks."""

    def renumbered() -> ReferencePoints:
        points = read()
        face = np.where(points.face >= 0, points.face + shift_of[points.building], -1).astype(np.int32)
        return dataclasses.replace(points, building=block_of[points.building], face=face)

    return renumbered
