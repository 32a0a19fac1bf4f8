"""The vocabulary of the results: classes of changes, closed lists of reasons and doubts, columns of the table."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

import pyarrow as pa


class Change(StrEnum):
    """The change of a building, or of several that belong together."""

    NEW = "new"
    GONE = "gone"
    RAISED = "raised"
    LOWERED = "lowered"
    RESHAPED = "reshaped"
    UNCHANGED = "unchanged"
    NOT_COMPARABLE = "not_comparable"


CHANGES: Mapping[Change, str] = {
    Change.NEW: "stands in NEW alone, where OLD has data",
    Change.GONE: "stood in OLD alone, where NEW has data",
    Change.RAISED: "nearly all of its roof lies higher",
    Change.LOWERED: "nearly all of its roof lies lower",
    Change.RESHAPED: "a part of its plan was added or removed, or has another roof",
    Change.UNCHANGED: "no change reaches its limit",
    Change.NOT_COMPARABLE: "one epoch has too little information; `reason` says why",
}
"""Meanings of the classes."""


class Relation(StrEnum):
    """How many buildings of OLD and NEW belong together."""

    ONE_TO_ONE = "one_to_one"
    SPLIT = "split"
    MERGED = "merged"
    MANY_TO_MANY = "many_to_many"
    ONLY_OLD = "only_old"
    ONLY_NEW = "only_new"


RELATIONS: Mapping[Relation, str] = {
    Relation.ONE_TO_ONE: "one building in each",
    Relation.SPLIT: "one in OLD, several in NEW",
    Relation.MERGED: "several in OLD, one in NEW",
    Relation.MANY_TO_MANY: "several in both",
    Relation.ONLY_OLD: "one in OLD, none in NEW",
    Relation.ONLY_NEW: "one in NEW, none in OLD",
}
"""Meanings of the relations."""


class Incomparable(StrEnum):
    """Why a building is not comparable; the first reason of this list counts."""

    FAILED_IN_OLD = "failed_in_old"
    FAILED_IN_NEW = "failed_in_new"
    TILE_FAILED_IN_OLD = "tile_failed_in_old"
    TILE_FAILED_IN_NEW = "tile_failed_in_new"
    OUTSIDE_OLD = "outside_old"
    OUTSIDE_NEW = "outside_new"
    EDGE_OF_OLD = "edge_of_old"
    EDGE_OF_NEW = "edge_of_new"
    REJECTED_IN_OLD = "rejected_in_old"
    REJECTED_IN_NEW = "rejected_in_new"


INCOMPARABLE: Mapping[Incomparable, str] = {
    Incomparable.FAILED_IN_OLD: "OLD has a candidate there, but no model",
    Incomparable.FAILED_IN_NEW: "NEW has a candidate there, but no model",
    Incomparable.TILE_FAILED_IN_OLD: "a tile of OLD failed there",
    Incomparable.TILE_FAILED_IN_NEW: "a tile of NEW failed there",
    Incomparable.OUTSIDE_OLD: "OLD has no data there, or ends nearby",
    Incomparable.OUTSIDE_NEW: "NEW has no data there, or ends nearby",
    Incomparable.EDGE_OF_OLD: "the data of OLD end at this building: it may be cut",
    Incomparable.EDGE_OF_NEW: "the data of NEW end at this building: it may be cut",
    Incomparable.REJECTED_IN_OLD: "OLD has an object of similar extent and height that was rejected as a building",
    Incomparable.REJECTED_IN_NEW: "NEW has an object of similar extent and height that was rejected as a building",
}
"""Meanings of the reasons."""


class Doubt(StrEnum):
    """A reason why a verdict is less certain."""

    BLOCK_IN_OLD = "block_in_old"
    BLOCK_IN_NEW = "block_in_new"
    DOUBTFUL_IN_OLD = "doubtful_in_old"
    DOUBTFUL_IN_NEW = "doubtful_in_new"
    ROUGH_PART = "rough_part"
    UNEXPLAINED_PART = "unexplained_part"
    NEAR_LIMIT = "near_limit"
    OVERLAPS_ANOTHER = "overlaps_another"
    OTHER_UNITS = "other_units"
    OTHER_VERSION = "other_version"


DOUBTS: Mapping[Doubt, str] = {
    Doubt.BLOCK_IN_OLD: "the model of OLD is a block in place of its roof (`fallback`)",
    Doubt.BLOCK_IN_NEW: "the model of NEW is a block in place of its roof (`fallback`)",
    Doubt.DOUBTFUL_IN_OLD: "the points of OLD do not support its model (`doubtful`): it may not be a building",
    Doubt.DOUBTFUL_IN_NEW: "the points of NEW do not support its model (`doubtful`): it may not be a building",
    Doubt.ROUGH_PART: "most of the changed area is roof faces with scattered points: it may be a tree",
    Doubt.UNEXPLAINED_PART: "a model has roof without points (`unexplained_m2`) over at least half of the changed area",
    Doubt.NEAR_LIMIT: "`change_ratio` is between 2/3 and 3/2: a small difference would change the verdict",
    Doubt.OVERLAPS_ANOTHER: "new or gone, and more than a tenth of it overlaps a building of the other epoch",
    Doubt.OTHER_UNITS: "the epochs divide the same place into different numbers of buildings",
    Doubt.OTHER_VERSION: "reshaped, and the runs differ in version, method or settings: its outline may be drawn anew",
}
"""Meanings of the doubts."""

_TIME = pa.timestamp("us", tz="UTC")
_NAMES = pa.list_(pa.string())

COLUMNS: tuple[tuple[str, pa.DataType, str], ...] = (
    ("change_id", pa.string(), "`n-` and the smallest building_id of NEW; `o-` and that of OLD if NEW has none"),
    ("change", pa.string(), "the class, see above"),
    ("is_raised", pa.bool_(), "nearly all of the roof lies higher, even if `change` is `reshaped`"),
    ("is_lowered", pa.bool_(), "nearly all of the roof lies lower"),
    ("is_reshaped", pa.bool_(), "plan or roof differ, even if `change` is `raised` or `lowered`"),
    ("reason", pa.string(), "why it is not comparable; null if it is"),
    ("doubts", _NAMES, "why the verdict is less certain, from the list above"),
    ("relation", pa.string(), "how many buildings belong together, see above"),
    ("old_ids", _NAMES, "building_id of all that belong together in OLD, sorted"),
    ("new_ids", _NAMES, "the same in NEW"),
    ("old_source_ids", _NAMES, "their `source_id` in OLD, in the order of `old_ids`, if footprints were given"),
    ("new_source_ids", _NAMES, "the same in NEW"),
    ("iou", pa.float64(), "common area of both sides over the area of both together; null if one side is missing"),
    ("old_area_m2", pa.float64(), "plan area in OLD"),
    ("new_area_m2", pa.float64(), "plan area in NEW"),
    ("area_change_m2", pa.float64(), "NEW less OLD"),
    ("old_height_m", pa.float64(), "height above ground in OLD, of the highest building"),
    ("new_height_m", pa.float64(), "the same in NEW"),
    ("height_change_m", pa.float64(), "median difference of the roof elevations where both epochs have a roof"),
    ("ridge_change_m", pa.float64(), "difference of the highest roof points"),
    ("ground_change_m", pa.float64(), "difference of the floor elevations"),
    ("old_volume_m3", pa.float64(), "volume of the solids in OLD"),
    ("new_volume_m3", pa.float64(), "the same in NEW"),
    ("volume_change_m3", pa.float64(), "NEW less OLD"),
    ("added_m2", pa.float64(), "plan area of added parts; the whole building if new"),
    ("removed_m2", pa.float64(), "plan area of removed parts; the whole building if gone"),
    ("raised_m2", pa.float64(), "plan area of parts whose roof lies higher"),
    ("lowered_m2", pa.float64(), "plan area of parts whose roof lies lower"),
    ("gained_m3", pa.float64(), "volume of added and raised parts; the whole building if new"),
    ("lost_m3", pa.float64(), "volume of removed and lowered parts; the whole building if gone"),
    ("max_raise_m", pa.float64(), "largest difference in a part that lies higher"),
    ("max_drop_m", pa.float64(), "largest difference in a part that lies lower, positive"),
    ("roof_difference_m", pa.float64(), "mean absolute difference of the roofs, whatever its size"),
    ("least_height_change_m", pa.float64(), "least difference at which this roof counts as higher or lower"),
    ("least_width_m", pa.float64(), "least width at which a part of this building counts"),
    ("change_ratio", pa.float64(), "the largest measured change over its limit: changed from 1 on"),
    ("old_roof_type", pa.string(), "roof type in OLD, of the largest building"),
    ("new_roof_type", pa.string(), "the same in NEW"),
    ("old_acquired", _TIME, "latest acquisition in OLD"),
    ("new_acquired", _TIME, "earliest acquisition in NEW"),
    ("geometry", pa.binary(), "footprint in NEW, in OLD if NEW has none; the union of several that belong together"),
)
"""Name, type and meaning of every column of `changes.parquet`."""

SCHEMA = pa.schema([pa.field(name, kind) for name, kind, _ in COLUMNS])
"""One row per building, or per group of buildings that belong together."""
