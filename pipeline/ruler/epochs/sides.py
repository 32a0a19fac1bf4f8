"""The side of one epoch in each group: sums, extremes and names of its buildings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline.model import BoolArray, FloatArray, IntArray, Status
from pipeline.ruler.epochs.epoch import Buildings, floats

Side = Mapping[str, Any]
"""Columns on the buildings of an epoch in g groups; nan and null if it has none.

Sums and extremes have the names of `buildings.parquet`. `sigma_m` is the standard deviation of the roofs' elevations,
of the worst model, 0 if unknown, as is `spacing_m`. `footprints` are shapely geometries in metres, several united, None
without one. `has_failed`, `has_block`, `has_doubtful` and `at_edge` hold if they do for some building.
"""


def side_of(buildings: Buildings, group: IntArray, count: int, vertical_unit_m: float) -> Side:
    """Aggregate the buildings of an epoch by group, (n,) int64 numbers from 0 to count - 1."""
    table = buildings.table
    by_name = pc.sort_indices(
        pa.table({"group": pa.array(group), "name": table["building_id"].combine_chunks()}),
        sort_keys=[("group", "ascending"), ("name", "ascending")],
    )
    order = by_name.to_numpy()
    table, group, footprints = table.take(by_name), group[order], buildings.footprints[order]
    starts = np.searchsorted(group, np.arange(count + 1))
    numbers = np.diff(starts)
    status = table["status"].to_numpy(zero_copy_only=False)
    is_block = status == Status.FALLBACK.value
    area_m2 = np.nan_to_num(shapely.area(footprints))

    def extreme(values: FloatArray, ufunc: np.ufunc, start: float) -> FloatArray:
        found = np.full(count, start)
        known = np.isfinite(values)
        ufunc.at(found, group[known], values[known])
        found[~np.isfinite(found)] = np.nan
        return found

    def total(values: FloatArray) -> FloatArray:
        known = np.isfinite(values)
        sums = np.bincount(group[known], weights=values[known], minlength=count).astype(np.float64)
        sums[np.bincount(group[known], minlength=count) == 0] = np.nan
        return sums

    def some(flags: BoolArray) -> BoolArray:
        return np.greater(np.bincount(group[flags], minlength=count), 0)

    spread = np.fmax(floats(table["noise_m"]), floats(table["ridge_z_sigma_m"]))
    sigma_m = np.nan_to_num(np.where(is_block | np.isnan(spread), floats(table["rmse_m"]), spread))
    return {
        "count": numbers.astype(np.int64),
        "area_m2": np.where(numbers > 0, np.bincount(group, weights=area_m2, minlength=count), np.nan),
        "volume_m3": total(floats(table["volume_m3"])),
        "height_m": extreme(floats(table["height_m"]), np.maximum, -np.inf),
        "ground_m": extreme(floats(table["ground_z"]) * vertical_unit_m, np.minimum, np.inf),
        "ridge_m": extreme(floats(table["ridge_z"]) * vertical_unit_m, np.maximum, -np.inf),
        "sigma_m": extreme(sigma_m, np.maximum, 0.0),
        "spacing_m": extreme(floats(table["point_spacing_m"]), np.maximum, 0.0),
        "unexplained_m2": np.nan_to_num(total(floats(table["unexplained_m2"]))),
        "has_failed": some(status == Status.FAILED.value),
        "has_block": some(is_block),
        "has_doubtful": some(status == Status.DOUBTFUL.value),
        "at_edge": some(table["touches_data_edge"].to_numpy(zero_copy_only=False).astype(np.bool_)),
        "roof_type": _of_largest(table["roof_type"].to_numpy(zero_copy_only=False), area_m2, group, count),
        "ids": _lists(table["building_id"], starts),
        "source_ids": _lists(table["source_id"], starts),
        "acquired_from": _times(table["acquired_from"], group, count, np.minimum),
        "acquired_to": _times(table["acquired_to"], group, count, np.maximum),
        "footprints": _united(footprints, starts, numbers),
    }


def _lists(column: pa.ChunkedArray, starts: IntArray) -> pa.ListArray:
    return pa.ListArray.from_arrays(pa.array(starts, pa.int32()), column.combine_chunks())


def _of_largest(
    values: npt.NDArray[np.object_], area_m2: FloatArray, group: IntArray, count: int
) -> npt.NDArray[np.object_]:
    """The value of the largest building of each group; the first name wins among equal ones."""
    found = np.full(count, None, object)
    order = np.lexsort((-np.arange(len(values)), area_m2))  # the last one stays
    found[group[order]] = values[order]
    return found


def _times(column: pa.ChunkedArray, group: IntArray, count: int, ufunc: np.ufunc) -> pa.Array:
    """The extreme time of each group; null if unknown."""
    known = np.asarray(column.is_valid().to_numpy(), np.bool_)
    micros = column.cast(pa.int64()).fill_null(0).to_numpy()
    start = np.iinfo(np.int64).max if ufunc is np.minimum else np.iinfo(np.int64).min
    found = np.full(count, start, np.int64)
    ufunc.at(found, group[known], micros[known])
    return pa.array(found, mask=found == start).cast(column.type)


def _united(footprints: Any, starts: IntArray, numbers: IntArray) -> Any:
    """One geometry per group."""
    found = np.full(len(numbers), None, object)
    single = np.flatnonzero(numbers == 1)
    found[single] = footprints[starts[single]]
    for group in np.flatnonzero(numbers > 1).tolist():
        united = shapely.union_all(footprints[starts[group] : starts[group + 1]])
        found[group] = None if united.is_empty else united
    return found
