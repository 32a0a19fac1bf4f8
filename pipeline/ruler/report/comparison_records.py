"""The records of several runs over the same candidates, building by building, with their true buildings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import geo_metadata, read_table
from pipeline.model import Status
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.report.comparison_building import ComparedBuilding, ComparedRun, Record, difference_of
from pipeline.runtime.manifest import RunManifest

_COLUMNS = ("status", "reason", "reason_detail", "lod", "roof_type", "n_planes", "rmse_m", "p95_m", "coverage", "valid")
_READ = ("building_id", *_COLUMNS, "footprint_area_m2", "touches_data_edge", "geometry")
_TRUTH = ("true_type", "outcome", "faces_to_find", "faces_found", "faces_wrong", "iou")
_SCHEMA = pa.schema(
    [
        pa.field("building_id", pa.string(), nullable=False),
        pa.field("label", pa.string(), nullable=False),
        pa.field("method", pa.string(), nullable=False),
        pa.field("preset", pa.string(), nullable=False),
        pa.field("status", pa.string(), nullable=False),
        pa.field("reason", pa.string()),
        pa.field("reason_detail", pa.string(), nullable=False),
        pa.field("lod", pa.string()),
        pa.field("roof_type", pa.string(), nullable=False),
        pa.field("n_planes", pa.int32(), nullable=False),
        pa.field("rmse_m", pa.float64()),
        pa.field("p95_m", pa.float64()),
        pa.field("coverage", pa.float64()),
        pa.field("valid", pa.bool_(), nullable=False),
        pa.field("footprint_area_m2", pa.float64()),
        pa.field("seconds", pa.float64()),
        pa.field("difference", pa.float64(), nullable=False),
    ]
)
_TRUTH_FIELDS = (
    pa.field("true_id", pa.string()),
    pa.field("true_type", pa.string()),
    pa.field("outcome", pa.string()),
    pa.field("faces_to_find", pa.int64()),
    pa.field("faces_found", pa.int64()),
    pa.field("faces_wrong", pa.int64()),
    pa.field("iou", pa.float64()),
)


def read_buildings(runs: Sequence[ComparedRun], manifests: Sequence[RunManifest]) -> tuple[list[ComparedBuilding], int]:
    """The buildings that all runs have, by building_id, and the number that a run with failed tiles lacks.

    Raises RunError if the runs have different buildings although none has failed tiles: their candidates differ.
    """
    tables = [_rows_of(run) for run in runs]
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
    rows_of_truth = [_truth_rows(run.evaluation) for run in runs]
    buildings = []
    for name in names:
        records = tuple(
            _record(table[name], run, truth.get(true_ids.get(name), {}))
            for table, run, truth in zip(tables, runs, rows_of_truth, strict=True)
        )
        buildings.append(
            ComparedBuilding(
                building_id=name, records=records, true_id=true_ids.get(name), difference=difference_of(records)
            )
        )
    return buildings, len(anywhere - everywhere)


def _rows_of(run: ComparedRun) -> dict[str, Mapping[str, Any]]:
    """The records of a run, by building_id."""
    table = read_table(run.run_dir, "buildings").select(list(_READ))
    return {row["building_id"]: row for row in table.to_pylist()}


def _record(row: Mapping[str, Any], run: ComparedRun, truth: Mapping[str, Any]) -> Record:
    def figure(name: str) -> float:
        return math.nan if row[name] is None else float(row[name])

    return Record(
        status=Status(row["status"]),
        reason=row["reason"],
        reason_detail=row["reason_detail"],
        lod=row["lod"],
        roof_type=row["roof_type"],
        n_planes=row["n_planes"],
        rmse_m=figure("rmse_m"),
        p95_m=figure("p95_m"),
        coverage=figure("coverage"),
        valid=row["valid"],
        footprint_area_m2=figure("footprint_area_m2"),
        seconds=(run.seconds or {}).get(row["building_id"], math.nan),
        touches_data_edge=row["touches_data_edge"],
        geometry=row["geometry"],
        truth=truth,
    )


def _truth_rows(evaluation: Evaluation | None) -> dict[str | None, Mapping[str, Any]]:
    """Rows of the evaluation's table of reference buildings by their ids."""
    table = None if evaluation is None or evaluation.reference is None else evaluation.tables.get("buildings")
    if table is None:
        return {}
    return {row["building_id"]: row for row in table.select(_known(table)).to_pylist()}


def _known(table: pa.Table) -> list[str]:
    return [name for name in ("building_id", "model_id", *_TRUTH) if name in table.column_names]


def _true_buildings(names: Sequence[str], runs: Sequence[ComparedRun]) -> dict[str, str]:
    """The reference building under each building: one to one, the largest common area first.

    The union of the footprints of all runs is the place of a building, so all runs have one true building.
    """
    reference = next((run.evaluation.reference for run in runs if run.evaluation and run.evaluation.reference), None)
    if reference is None or not reference.buildings or not names:
        return {}
    footprints: dict[str, list[Any]] = {name: [] for name in names}
    for run in runs:
        if run.evaluation is not None:
            for model in (*run.evaluation.models.models, *run.evaluation.models.failed):
                if model.building_id in footprints:
                    footprints[model.building_id].append(model.footprint)
    places = [shapely.union_all(footprints[name]) for name in names]
    true = [building.footprint for building in reference.buildings]
    pairs = shapely.STRtree(true).query(places, predicate="intersects")
    common = [shapely.intersection(places[place], true[number]).area for place, number in pairs.T]
    order = sorted(
        (-round(area, 6), names[place], reference.buildings[number].building_id)
        for area, (place, number) in zip(common, pairs.T.tolist(), strict=True)
    )
    found: dict[str, str] = {}
    taken = set()
    for area, name, true_id in order:
        if area < 0.0 and name not in found and true_id not in taken:
            found[name] = true_id
            taken.add(true_id)
    return found


def buildings_table(
    runs: Sequence[ComparedRun], buildings: Sequence[ComparedBuilding], projjson: Mapping[str, Any] | None
) -> pa.Table:
    """One row per building and run as GeoParquet, with columns of the truth if there are evaluations."""
    schema = _SCHEMA
    if any(run.evaluation is not None and run.evaluation.reference is not None for run in runs):
        for field in _TRUTH_FIELDS:
            schema = schema.append(field)
    schema = schema.append(pa.field("geometry", pa.binary()))
    rows = []
    for building in buildings:
        for run, record in zip(runs, building.records, strict=True):
            row: dict[str, Any] = {name: getattr(record, name) for name in (*_COLUMNS, "footprint_area_m2", "seconds")}
            row |= {name: None for name, value in row.items() if isinstance(value, float) and math.isnan(value)}
            row |= {name: record.truth.get(name) for name in _TRUTH}
            row |= {"building_id": building.building_id, "true_id": building.true_id, "status": record.status.value}
            row |= {"label": run.label, "method": run.method, "preset": run.preset, "geometry": record.geometry}
            rows.append(row | {"difference": round(building.difference.total, 6)})
    table = pa.Table.from_pylist([{name: row[name] for name in schema.names} for row in rows], schema=schema)
    geometries = shapely.from_wkb(np.array([row["geometry"] for row in rows], dtype=object))
    metadata = geo_metadata(geometries, projjson)
    del metadata["columns"]["geometry"]["covering"]
    return table.replace_schema_metadata({"geo": json.dumps(metadata, sort_keys=True, separators=(",", ":"))})


def projjson_of(manifest: RunManifest) -> dict[str, Any] | None:
    """The coordinate reference system of the tables of a run; None if unknown."""
    wkt = (manifest.crs or {}).get("wkt")
    return None if not wkt else dict(pyproj.CRS.from_wkt(wkt).to_json_dict())
