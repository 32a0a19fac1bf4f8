"""The comparison of two epochs from end to end, part by part: match buildings, compare their roofs, judge."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from pipeline.export.stored_coordinates import decimals
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.epochs.agreement import differing_makers
from pipeline.ruler.epochs.change_records import SCHEMA, Change
from pipeline.ruler.epochs.epoch import Buildings, Epoch
from pipeline.ruler.epochs.epoch_matching import Groups, all_pairs, around, grouped, meeting, middles, parts_of
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.epochs.judging import judge, limits
from pipeline.ruler.epochs.roof_raster import (
    ADDED_M2,
    DIFFERENCE_M,
    GAINED_M3,
    LOST_M3,
    LOWERED_M2,
    MAX_DROP_M,
    MAX_RAISE_M,
    MEDIAN_M,
    RAISED_M2,
    REMOVED_M2,
    RoofFaces,
    RoofGroups,
    compare_roofs,
)
from pipeline.ruler.epochs.sides import Side, side_of

GROUPS_PER_PART = 10_000
"""Groups whose models are in memory at once, about."""
ALIKE_IOU = 0.4
"""Only the box of a rejected object is known: from this overlap of the boxes on it may be the building."""
ALIKE_TIMES = 2.0
"""Its area and height must also be at most this many times, and at least 1 / this, of those of the building."""
_DIGITS = 3
"""Decimals of the table: millimetres."""

_OF_EPOCHS = ("ids", "source_ids", "area_m2", "height_m", "volume_m3", "roof_type")
"""Columns of both epochs."""

OnPart = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Members:
    """Buildings of an epoch that belong to a part of the groups or reach into it."""

    buildings: Buildings
    """The groups' own buildings, and neighbours that reach into them."""
    own: IntArray
    """(m,) int64, places of the groups' own buildings among them."""
    own_group: IntArray
    """(m,) int64, their groups within the part."""
    guests: IntArray
    """(k,) int64, places of the neighbours; a building occurs once per group that it reaches into."""
    guest_group: IntArray
    """(k,) int64, these groups."""


def compare_epochs(old: Epoch, new: Epoch, settings: DiffSettings, on_part: OnPart) -> Iterator[pa.Table]:
    """Compare two epochs with one CRS, as `pipeline.ruler.epochs.agreement` checks.

    Yields tables with the schema of `records`: one part of the plan after the other, `change_id` ascending within each.
    Rows without geometry come last. `on_part` is called with the groups done and all groups after every part.
    """
    pairs, old_m2, new_m2 = all_pairs(old, new)
    groups = grouped(pairs, old_m2, new_m2, settings)
    boxes = _boxes(groups, old.boxes, new.boxes)
    by_group = tuple(np.argsort(of, kind="stable") for of in (groups.of_old, groups.of_new))
    coverages = tuple(epoch.coverage.shrunk(settings.edge_m) for epoch in (old, new))
    done = 0
    for part in parts_of(middles(boxes), GROUPS_PER_PART):
        sides = [_members(epoch, k, groups, by_group[k], part) for k, epoch in enumerate((old, new))]
        before, after = (
            side_of(_own(one), one.own_group, len(part), epoch.reference.vertical_unit_m)
            for one, epoch in zip(sides, (old, new), strict=True)
        )
        limit = limits(before, after, settings)
        figures = _figures(old, new, sides, before, after, boxes[part], limit, settings)
        seen = _circumstances(old, new, before, after, coverages, groups, part)
        verdicts = judge(before, after, figures, limit["least_height_change_m"], seen, settings)
        done += len(part)
        yield _table(old, before, after, figures, limit | verdicts, groups.common_m2[part])
        on_part(done, groups.count)


def _boxes(groups: Groups, old: FloatArray, new: FloatArray) -> FloatArray:
    """Bounds (g, 4) of all groups; nan without geometry."""
    low, high = np.full((groups.count, 2), np.inf), np.full((groups.count, 2), -np.inf)
    for of, boxes in ((groups.of_old, old), (groups.of_new, new)):
        known = np.isfinite(boxes).all(axis=1)
        np.minimum.at(low, of[known], boxes[known, :2])
        np.maximum.at(high, of[known], boxes[known, 2:])
    boxes = np.concatenate([low, high], axis=1)
    boxes[~np.isfinite(boxes).all(axis=1)] = np.nan
    return boxes


def _members(epoch: Epoch, which: int, groups: Groups, by_group: IntArray, part: IntArray) -> _Members:
    """The buildings of one epoch (0 the earlier, 1 the later) for a part of the groups (ascending)."""
    of = (groups.of_old, groups.of_new)[which]
    starts, ends = (np.searchsorted(of, part, side=side, sorter=by_group) for side in ("left", "right"))
    counts = ends - starts
    own = by_group[_ranges(starts, counts)]
    own_group = np.repeat(np.arange(len(part)), counts)
    here, there = (groups.pairs.old, groups.pairs.new) if which == 0 else (groups.pairs.new, groups.pairs.old)
    other = (groups.of_old, groups.of_new)[1 - which][there]
    place = np.minimum(np.searchsorted(part, other), len(part) - 1)
    reaching = (other != of[here]) & (part[place] == other)
    guests, guest_group = here[reaching], place[reaching]
    rows = np.unique(np.concatenate([own, guests]))
    return _Members(
        buildings=epoch.buildings(rows),
        own=np.searchsorted(rows, own),
        own_group=own_group,
        guests=np.searchsorted(rows, guests),
        guest_group=guest_group,
    )


def _own(members: _Members) -> Buildings:
    """The groups' own buildings, in the order of `own`."""
    all_of = members.buildings
    return Buildings(
        rows=all_of.rows[members.own],
        table=all_of.table.take(pa.array(members.own)),
        footprints=all_of.footprints[members.own],
    )


def _ranges(starts: IntArray, counts: IntArray) -> IntArray:
    """The whole numbers of many ranges one after the other."""
    ends = np.cumsum(counts)
    ranges: IntArray = (
        np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts) + np.repeat(starts, counts)
    )
    return ranges


def _figures(
    old: Epoch,
    new: Epoch,
    sides: list[_Members],
    before: Side,
    after: Side,
    boxes: FloatArray,
    limit: Mapping[str, FloatArray],
    settings: DiffSettings,
) -> FloatArray:
    """The figures of `compare_roofs`; groups that exist in one epoch alone are compared as empty."""
    both = (before["count"] > 0) & (after["count"] > 0)
    found = [epoch.roofs(one.buildings) for epoch, one in zip((old, new), sides, strict=True)]
    columns: list[list[npt.NDArray[Any]]] = [[], [], [], []]
    first = 0
    for which, (one, (faces, owner)) in enumerate(zip(sides, found, strict=True)):
        begin = np.searchsorted(owner, np.arange(len(one.buildings.rows) + 1))
        for places, of_group, own in ((one.own, one.own_group, True), (one.guests, one.guest_group, False)):
            counts = begin[places + 1] - begin[places]
            face = _ranges(begin[places], counts) + first
            for column, values in zip(
                columns,
                (np.repeat(of_group, counts), face, np.full(len(face), which == 1), np.full(len(face), own)),
                strict=True,
            ):
                column.append(values)
        first += len(faces.faces) - 1
    group, face, is_new, is_own = (np.concatenate(column) for column in columns)
    kept = both[group]
    order = np.argsort(group[kept], kind="stable")
    group, face, is_new, is_own = (values[kept][order] for values in (group, face, is_new, is_own))
    ground = np.nan_to_num(np.column_stack([before["ground_m"], after["ground_m"]]))
    return compare_roofs(
        _joined(found[0][0], found[1][0]),
        RoofGroups(
            starts=np.searchsorted(group, np.arange(len(both) + 1)).astype(np.int64),
            face=face.astype(np.int64),
            is_new=is_new,
            is_own=is_own,
            boxes=np.where(both[:, None], boxes, 0.0),
            width_m=limit["least_width_m"],
            height_m=limit["least_height_change_m"],
            ground_m=ground,
        ),
        settings.uniform_share,
        settings.vertical_shift_m,
    )


def _joined(old: RoofFaces, new: RoofFaces) -> RoofFaces:
    """The faces of both epochs, those of the later one after the others."""
    return RoofFaces(
        xy=np.concatenate([old.xy, new.xy]),
        rings=np.concatenate([old.rings, new.rings[1:] + len(old.xy)]),
        faces=np.concatenate([old.faces, new.faces[1:] + len(old.rings) - 1]),
        planes=np.concatenate([old.planes, new.planes]),
        is_rough=np.concatenate([old.is_rough, new.is_rough]),
    )


def _circumstances(
    old: Epoch, new: Epoch, before: Side, after: Side, coverages: tuple[Any, ...], groups: Groups, part: IntArray
) -> dict[str, Any]:
    """What each epoch knows about the buildings that only the other one has."""
    count = len(part)
    known: dict[str, Any] = {}
    for name, epoch, coverage, side, missing in (
        ("old", old, coverages[0], after, before["count"] == 0),
        ("new", new, coverages[1], before, after["count"] == 0),
    ):
        alone = np.flatnonzero(missing & ~shapely.is_missing(side["footprints"]))
        covered, failed, rejected = np.ones(count), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        covered[alone] = coverage.share(side["footprints"][alone])
        failed[alone] = coverage.touches_failed(side["footprints"][alone])
        rejected[alone] = _rejected_alike(
            epoch, side["footprints"][alone], side["area_m2"][alone], side["height_m"][alone]
        )
        known |= {f"covered_{name}": covered, f"tile_failed_{name}": failed, f"rejected_{name}": rejected}
    pairs = groups.pairs
    overlap = np.zeros(count)
    first, second = groups.of_old[pairs.old], groups.of_new[pairs.new]
    for group in (first, second):
        place = np.minimum(np.searchsorted(part, group), count - 1)
        kept = (first != second) & (part[place] == group)
        overlap += np.bincount(place[kept], weights=pairs.common_m2[kept], minlength=count)
    area_m2 = np.nan_to_num(before["area_m2"]) + np.nan_to_num(after["area_m2"])
    overlapped = np.divide(overlap, area_m2, out=np.zeros(count), where=area_m2 > 0.0)
    return known | {"overlapped": overlapped, "made_otherwise": bool(differing_makers(old, new))}


def _rejected_alike(epoch: Epoch, footprints: Any, area_m2: FloatArray, height_m: FloatArray) -> BoolArray:
    """Where an epoch rejected an object of similar extent and height as a building."""
    found = np.zeros(len(footprints), np.bool_)
    rejected = epoch.rejected
    if len(footprints) == 0 or len(rejected.boxes) == 0:
        return found
    mine = shapely.bounds(footprints)
    near = np.flatnonzero(meeting(rejected.boxes, around(mine)))
    if len(near) == 0:
        return found
    boxes = rejected.boxes[near]
    i, j = shapely.STRtree(shapely.box(*boxes.T)).query(shapely.box(*mine.T))
    sides = np.minimum(mine[i, 2:], boxes[j, 2:]) - np.maximum(mine[i, :2], boxes[j, :2])
    common = np.prod(np.maximum(sides, 0.0), axis=1)
    sizes = [np.prod(one[:, 2:] - one[:, :2], axis=1) for one in (mine[i], boxes[j])]
    iou = common / np.maximum(sizes[0] + sizes[1] - common, 1e-9)
    alike = iou >= ALIKE_IOU
    for own, other in ((area_m2[i], rejected.area_m2[near][j]), (height_m[i], rejected.height_m[near][j])):
        alike &= (other >= own / ALIKE_TIMES) & (other <= own * ALIKE_TIMES)
    found[i[alike]] = True
    return found


def _table(
    epoch: Epoch, before: Side, after: Side, figures: FloatArray, verdicts: Mapping[str, Any], common_m2: FloatArray
) -> pa.Table:
    """The rows of a part of the groups, `change_id` ascending; `verdicts` are columns as they are."""
    both = (before["count"] > 0) & (after["count"] > 0)
    compared = both & ~(before["has_failed"] | after["has_failed"])
    is_new, is_gone = verdicts["change"] == Change.NEW.value, verdicts["change"] == Change.GONE.value
    union = np.nan_to_num(before["area_m2"]) + np.nan_to_num(after["area_m2"]) - common_m2
    columns = {
        f"{prefix}_{name}": side[name] for prefix, side in (("old", before), ("new", after)) for name in _OF_EPOCHS
    }
    # A figure of the raster if both epochs have a model; the whole building if it is new or gone.
    for name, column, alone, whole in (
        ("added_m2", ADDED_M2, is_new, after["area_m2"]),
        ("removed_m2", REMOVED_M2, is_gone, before["area_m2"]),
        ("raised_m2", RAISED_M2, False, 0.0),
        ("lowered_m2", LOWERED_M2, False, 0.0),
        ("gained_m3", GAINED_M3, is_new, after["volume_m3"]),
        ("lost_m3", LOST_M3, is_gone, before["volume_m3"]),
    ):
        values = np.where(compared, figures[:, column], np.where(is_new | is_gone, 0.0, np.nan))
        columns[name] = np.where(alone, whole, values)
    for name, mask, values in (
        ("height_change_m", compared, figures[:, MEDIAN_M]),
        ("ridge_change_m", compared, after["ridge_m"] - before["ridge_m"]),
        ("ground_change_m", compared, after["ground_m"] - before["ground_m"]),
        ("max_raise_m", compared & (figures[:, MAX_RAISE_M] > 0.0), figures[:, MAX_RAISE_M]),
        ("max_drop_m", compared & (figures[:, MAX_DROP_M] > 0.0), figures[:, MAX_DROP_M]),
        ("roof_difference_m", compared, figures[:, DIFFERENCE_M]),
        ("least_height_change_m", compared, verdicts["least_height_change_m"]),
        ("least_width_m", compared, verdicts["least_width_m"]),
    ):
        columns[name] = np.where(mask, values, np.nan)
    for unit in ("area_change_m2", "volume_change_m3"):  # a new or gone building counts as 0 in the other epoch
        name = unit.replace("_change", "")
        columns[unit] = np.where(is_gone, 0.0, after[name]) - np.where(is_new, 0.0, before[name])
    iou = np.where(both & (union > 0.0), common_m2 / np.where(union > 0.0, union, 1.0), np.nan)
    return _sorted_table(
        {
            **verdicts,
            **columns,
            "iou": _rounded(iou, 4),
            "old_acquired": before["acquired_to"],
            "new_acquired": after["acquired_from"],
            "geometry": _wkb(before, after, epoch.reference.horizontal_unit_m),
            "change_id": _change_ids(before, after),
        }
    )


def _sorted_table(columns: dict[str, Any]) -> pa.Table:
    """Columns as a table with rounded figures, `change_id` ascending."""
    rounded = {
        name: _rounded(values, _DIGITS) if isinstance(values, np.ndarray) and values.dtype.kind == "f" else values
        for name, values in columns.items()
    }
    arrays = [pa.array(rounded[field.name], type=field.type) for field in SCHEMA]
    return pa.table(arrays, schema=SCHEMA).sort_by("change_id")


def _rounded(values: FloatArray, digits: int) -> pa.Array:
    """Figures as the table holds them: null if unknown, no negative zero."""
    return pa.array(np.round(values, digits) + 0.0, mask=~np.isfinite(values))


def _change_ids(before: Side, after: Side) -> npt.NDArray[np.object_]:
    """The name of each group: from its first building in the later epoch, else in the earlier one."""
    found = np.full(len(before["count"]), None, object)
    for prefix, side, of in (("o-", before, before["count"] > 0), ("n-", after, after["count"] > 0)):
        starts = side["ids"].offsets.to_numpy()[:-1][of]
        names = side["ids"].values.take(pa.array(starts)).to_pylist()
        found[of] = [prefix + name for name in names]
    return found


def _wkb(before: Side, after: Side, unit_m: float) -> Any:
    """The geometries of the rows in units of the CRS, in one canonical form."""
    geometry = np.where(after["count"] > 0, after["footprints"], before["footprints"])
    if unit_m != 1.0:
        geometry = shapely.transform(geometry, lambda xy: np.round(xy / unit_m, decimals(unit_m)))
    canonical = shapely.orient_polygons(shapely.normalize(geometry))
    return shapely.to_wkb(canonical, flavor="iso")
