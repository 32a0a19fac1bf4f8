"""The records of several runs over the same candidates, building by building, with their true buildings."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import geo_metadata, read_table, stored_schema
from pipeline.model import Status
from pipeline.ruler.evaluation.building_matching import one_to_one
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.runtime.manifest import RunManifest

FULL_RESIDUAL_M = 0.2
"""A difference of RMSE that counts in full."""
_COLUMNS = (
    *("status", "reason", "reason_detail", "lod", "roof_type", "n_planes", "rmse_m", "p95_m", "coverage", "valid"),
    "footprint_area_m2",
)
_READ = ("building_id", *_COLUMNS, "touches_data_edge", "geometry")
_TRUTH = {
    "true_id": pa.string(),
    "true_type": pa.string(),
    "outcome": pa.string(),
    "faces_to_find": pa.int64(),
    "faces_found": pa.int64(),
    "faces_wrong": pa.int64(),
    "iou": pa.float64(),
}

Record = Mapping[str, Any]
"""The record of a building in one run: columns of its table `buildings`; `seconds`; `is_model`, whether the model of
the method was delivered; and `_TRUTH` from the evaluation's row of its true building. None if unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A run that is compared."""

    label: str
    method: str
    preset: str
    run_dir: str
    seconds: Mapping[str, float] | None = None
    """Seconds per building, by building_id; missing ones are unknown."""
    evaluation: Evaluation | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedBuilding:
    """A building in all runs."""

    building_id: str
    records: tuple[Record, ...]
    true_id: str | None
    """Id of the reference building under it; None without one."""
    difference: Mapping[str, float]
    """Differences of the runs by kind, see `differences`."""

    @property
    def total(self) -> float:
        """Sum of all differences."""
        return sum(self.difference.values())


def differences(records: Sequence[Record]) -> dict[str, float]:
    """Differences between the records of one building, each from 0 (all agree) to 1.

    Shares of pairs of runs with different `status`, different `outcome` where judged, and different `roof_type` among
    the runs with a model of their own, as the next two; `faces`: largest minus smallest number of planes over the
    largest; `residual`: largest minus smallest RMSE, 0.2 m counting in full.
    """
    modelled = [record for record in records if record["is_model"]]
    planes = [record["n_planes"] for record in modelled]
    rmse = [record["rmse_m"] for record in modelled if record["rmse_m"] is not None]
    return {
        "status": _pairs_apart([record["status"] for record in records]),
        "outcome": _pairs_apart([record["outcome"] for record in records if record["outcome"] is not None]),
        "roof_type": _pairs_apart([record["roof_type"] for record in modelled]),
        "faces": (max(planes) - min(planes)) / max(*planes, 1) if planes else 0.0,
        "residual": min(1.0, (max(rmse) - min(rmse)) / FULL_RESIDUAL_M) if rmse else 0.0,
    }


def _pairs_apart(values: Sequence[Hashable]) -> float:
    """Share of pairs that are not equal; 0 without a pair."""
    pairs = list(itertools.combinations(values, 2))
    return sum(a != b for a, b in pairs) / len(pairs) if pairs else 0.0


def read_buildings(runs: Sequence[ComparedRun], manifests: Sequence[RunManifest]) -> tuple[list[ComparedBuilding], int]:
    """The buildings that all runs have, by building_id, and the number that a run with failed tiles lacks.

    Raises RunError if the runs have different buildings although none has failed tiles: their candidates differ.
    """
    tables = []
    for run in runs:
        rows = read_table(run.run_dir, "buildings").select(list(_READ)).to_pylist()
        tables.append({row["building_id"]: row for row in rows})
    everywhere = set(tables[0]).intersection(*tables)
    anywhere = set(tables[0]).union(*tables)
    if everywhere != anywhere and not any(manifest.failed_tiles for manifest in manifests):
        stray = min(anywhere - everywhere)
        with_it, without = (
            next(run.label for run, table in zip(runs, tables, strict=True) if (stray in table) is held)
            for held in (True, False)
        )
        raise RunError(
            f"{len(anywhere - everywhere)} buildings are not in all runs: {with_it} has {stray}, {without} has not. "
            "Give runs over the same candidates, as gablework compare makes them"
        )
    names = sorted(everywhere)
    true_ids = _true_buildings(names, runs)
    truths = [_truth_rows(run.evaluation) for run in runs]
    buildings = []
    for name in names:
        true_id = true_ids.get(name)
        records = tuple(
            {
                **dict.fromkeys(_TRUTH),
                **truth.get(true_id, {}),
                **table[name],
                "true_id": true_id,
                "seconds": (run.seconds or {}).get(name),
                "is_model": Status(table[name]["status"]).has_roof,
            }
            for table, run, truth in zip(tables, runs, truths, strict=True)
        )
        buildings.append(
            ComparedBuilding(building_id=name, records=records, true_id=true_id, difference=differences(records))
        )
    return buildings, len(anywhere - everywhere)


def reference_of(runs: Sequence[ComparedRun]) -> Any | None:
    """The reference of the evaluations; None without one."""
    return next((run.evaluation.reference for run in runs if run.evaluation and run.evaluation.reference), None)


def _truth_rows(evaluation: Evaluation | None) -> dict[str | None, Mapping[str, Any]]:
    """Rows of the evaluation's table of reference buildings by their ids."""
    table = None if evaluation is None or evaluation.reference is None else evaluation.tables.get("buildings")
    if table is None:
        return {}
    known = [name for name in ("building_id", *_TRUTH) if name in table.column_names]
    return {row["building_id"]: row for row in table.select(known).to_pylist()}


def _true_buildings(names: Sequence[str], runs: Sequence[ComparedRun]) -> dict[str, str]:
    """The reference building under each building: one to one, the largest common area first.

    The union of the footprints of all runs is the place of a building, so all runs have one true building.
    """
    reference = reference_of(runs)
    if reference is None or not reference.buildings or not names:
        return {}
    footprints: dict[str, list[Any]] = {name: [] for name in names}
    for run in runs:
        if run.evaluation is not None:
            for model in (*run.evaluation.models.models, *run.evaluation.models.failed):
                if model.building_id in footprints:
                    footprints[model.building_id].append(model.footprint)
    places = np.array([shapely.union_all(footprints[name]) for name in names], object)
    true = np.array([building.footprint for building in reference.buildings], object)
    place, number = shapely.STRtree(true).query(places, predicate="intersects")
    common = shapely.area(shapely.intersection(places[place], true[number])).round(6)
    held = np.flatnonzero(common > 0.0)
    kept = held[one_to_one(place[held], number[held], common[held])]
    return {names[k]: reference.buildings[n].building_id for k, n in zip(place[kept], number[kept], strict=True)}


def buildings_table(
    runs: Sequence[ComparedRun], buildings: Sequence[ComparedBuilding], projjson: Mapping[str, Any] | None
) -> pa.Table:
    """One row per building and run as GeoParquet, with columns of the truth if there are evaluations."""
    stored = stored_schema("buildings")
    fields = [pa.field(name, pa.string(), nullable=False) for name in ("building_id", "label", "method", "preset")]
    fields += [stored.field(name).remove_metadata() for name in _COLUMNS]
    fields += [pa.field("seconds", pa.float64()), pa.field("difference", pa.float64(), nullable=False)]
    if reference_of(runs) is not None:
        fields += [pa.field(name, kind) for name, kind in _TRUTH.items()]
    schema = pa.schema([*fields, pa.field("geometry", pa.binary())])
    rows = [
        {**record, "label": run.label, "method": run.method, "preset": run.preset, "difference": round(one.total, 6)}
        for one in buildings
        for run, record in zip(runs, one.records, strict=True)
    ]
    table = pa.Table.from_pylist([{name: row[name] for name in schema.names} for row in rows], schema=schema)
    geometries = shapely.from_wkb(np.array([row["geometry"] for row in rows], dtype=object))
    metadata = geo_metadata(geometries, projjson)
    del metadata["columns"]["geometry"]["covering"]
    return table.replace_schema_metadata({"geo": json.dumps(metadata, sort_keys=True, separators=(",", ":"))})


def projjson_of(manifest: RunManifest) -> dict[str, Any] | None:
    """The coordinate reference system of the tables of a run; None if unknown."""
    wkt = (manifest.crs or {}).get("wkt")
    return None if not wkt else dict(pyproj.CRS.from_wkt(wkt).to_json_dict())
