"""An evaluation made by hand: a simulated suburb, copies of its houses with known damage, and points on its roofs."""

import dataclasses
import math

import numpy as np
import pyarrow as pa
import shapely
from roofs_by_hand import lifted, models_of_scene, moved, points_of

from pipeline.model import RoofType, Status
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.measure import Measure
from pipeline.ruler.evaluation.models import ModelSet, RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.simulation.solids import building_solid
from pipeline.ruler.simulation.suburb import suburb

WITHIN_M = 0.2
KINDS: tuple[dict[str, bool], ...] = (
    {},
    {"points": False},
    {"has_faces": False},
    {"has_faces": False, "points": False},
    {"reference": False},
)
"""Truth with points, truth alone, footprints with points, footprints alone, no reference."""


def true_models() -> list[RoofModel]:
    """The houses of a simulated suburb."""
    scene = dataclasses.replace(suburb(3, size_m=(160.0, 120.0)), origin=(0.0, 0.0, 0.0))
    return [
        dataclasses.replace(model, solids=(building_solid(building),))
        for model, building in zip(models_of_scene(scene), scene.buildings, strict=True)
    ]


def damaged(truth: list[RoofModel]) -> list[RoofModel]:
    """Copies: every seventh is missing, others are raised, turned to a block, or lose a face; one stands elsewhere."""
    made = []
    for number, model in enumerate(truth):
        name = f"model-{number}"
        copy = dataclasses.replace(model, building_id=name)
        if number % 7 == 3:
            continue
        if number % 7 == 1:
            surfaces = tuple(lifted(surface, 0.4) for surface in model.surfaces)
            raised = [solid.vertices + np.array([0.0, 0.0, 0.4]) for solid in model.solids]
            solids = tuple(
                dataclasses.replace(solid, vertices=v) for solid, v in zip(model.solids, raised, strict=True)
            )
            copy = dataclasses.replace(copy, surfaces=surfaces, solids=solids)
        if number % 7 == 5:
            top = max(s.coefficients[2] for s in model.surfaces)
            x, y = model.footprint.centroid.x, model.footprint.centroid.y
            height = float(np.nanmean(model.top(np.array([x]), np.array([y])))) - 1.0
            block = RoofSurface(polygon=model.footprint, coefficients=(0.0, 0.0, min(height, top + 1e6)), plane_id=0)
            outcome = {"roof_type": RoofType.FLAT, "status": Status.FALLBACK, "lod": "1.2"}
            copy = dataclasses.replace(copy, surfaces=(block,), solids=(), **outcome)
        if number % 7 == 6 and len(model.surfaces) > 1:
            copy = dataclasses.replace(copy, surfaces=model.surfaces[1:], solids=())
        made.append(copy)
    elsewhere = moved(truth[0], -25.0, -20.0, 0.0)
    return [*made, dataclasses.replace(elsewhere, building_id="model-elsewhere", solids=())]


def roof_points(truth: list[RoofModel], density: float = 3.0) -> ReferencePoints:
    """Points on the true roofs with a noise of 0.03 m."""
    random = np.random.default_rng(5)
    parts, owners = [], []
    for number, model in enumerate(truth):
        west, south, east, north = model.footprint.bounds
        n = round(density * (east - west) * (north - south))
        x, y = random.uniform(west, east, n), random.uniform(south, north, n)
        z = model.top(x, y) + random.normal(0.0, 0.03, n)
        on = np.isfinite(z)
        parts.append(np.column_stack([x, y, z])[on])
        owners.append(np.full(int(on.sum()), number, np.int32))
    xyz, building = np.concatenate(parts), np.concatenate(owners)
    return points_of(xyz, 6, "roofs", building=building, is_roof=True)


def reference_of(truth: list[RoofModel], *, points: bool = True, has_faces: bool = True) -> Reference:
    """The suburb as a reference."""
    buildings = truth if has_faces else [dataclasses.replace(one, surfaces=()) for one in truth]
    held = roof_points(truth)
    return Reference(
        name="suburb",
        kind="truth" if has_faces else "points",
        buildings=tuple(buildings),
        has_faces=has_faces,
        outlines="truth" if has_faces else "given",
        tiles=(lambda: held,) if points else (),
        crs="EPSG:28992",
        notes=("The reference is <made> by hand.",),
    )


def model_set(models: list[RoofModel]) -> ModelSet:
    """The damaged copies as what a program delivered."""
    return ModelSet(name="copies", kind="run", path="copies", models=tuple(models), notes=("Units were assumed.",))


def damaged_evaluation(*, points: bool = True, has_faces: bool = True, reference: bool = True) -> Evaluation:
    """The evaluation of the damaged copies, its tables computed straight from what was damaged."""
    truth = true_models()
    models = damaged(truth)
    if not reference:
        table = pa.table({"model_id": [m.building_id for m in models], "role": [None] * len(models)})
        share = Measure(name="delivery.lod2", value=0.9, n=len(models))
        tables = {"models": table}
        return Evaluation(models=model_set(models), reference=None, measures=(share,), tables=tables, notes=())
    held = reference_of(truth, points=points, has_faces=has_faces)
    rows = [building_row(number, one, models, held) for number, one in enumerate(truth)]
    names = [m.building_id for m in models]
    roles = ["false" if name == "model-elsewhere" else "matched" for name in names]
    tables = {"buildings": pa.Table.from_pylist(rows), "models": pa.table({"model_id": names, "role": roles})}
    if has_faces:
        tables |= face_tables(truth, models)
        tables["outcomes"] = outcome_table(rows)
        tables["confusion"] = confusion_table(rows)
    if points:
        tables["residual_histogram"] = histogram_table(rows, truth, models)
    measures = measures_of(rows, tables)
    return Evaluation(
        models=model_set(models), reference=held, measures=tuple(measures), tables=tables, notes=("One | note.",)
    )


def model_of(number: int, models: list[RoofModel]) -> RoofModel | None:
    """The copy of a house; None where it was dropped."""
    return next((m for m in models if m.building_id == f"model-{number}"), None)


def building_row(number: int, one: RoofModel, models: list[RoofModel], held: Reference) -> dict[str, object]:
    """A row of the table of buildings."""
    model = model_of(number, models)
    kind = "correct"
    if model is None or number % 7 == 5:
        kind = "false"
    elif number % 7 == 6 and len(one.surfaces) > 1:
        kind = "passable"
    row: dict[str, object] = {
        "building_id": one.building_id,
        "touches_data_edge": False,
        "footprint_area_m2": one.footprint.area,
        "x": one.footprint.centroid.x,
        "y": one.footprint.centroid.y,
        "model_id": None if model is None else model.building_id,
        "model_type": None if model is None else model.roof_type.value,
        "model_status": None if model is None else model.status.value,
        "iou": 0.0 if model is None else 1.0 - 0.01 * (number % 5),
        "area_bias": None if model is None else 0.01 * (number % 5 - 2),
    }
    if held.has_faces:
        row |= {
            "true_type": one.roof_type.value,
            "shape": one.roof_type.value,
            "defects": ["dormers"] if number % 3 == 0 else [],
            "good": number % 3 != 0,
            "outcome": kind,
            "faces_to_find": len(one.surfaces),
            "faces_found": 0 if kind == "false" else len(one.surfaces) - (kind == "passable"),
            "faces_wrong": 1 if number % 7 == 5 else 0,
        }
    if held.tiles:
        residual = residuals_of(number, models, held)
        covered = residual[np.isfinite(residual)]
        row |= {
            "n_points": len(residual),
            "n_covered": len(covered),
            "n_within": int((np.abs(covered) <= WITHIN_M).sum()),
            "point_rmse_m": math.sqrt(float(np.mean(covered**2))) if len(covered) else None,
        }
    return row


def residuals_of(number: int, models: list[RoofModel], held: Reference) -> np.ndarray:
    """Point minus roof of the points of a house; nan where no roof is."""
    chunk = next(held.points())
    xyz = chunk.xyz[chunk.building == number]
    model = model_of(number, models)
    return np.full(len(xyz), np.nan) if model is None else xyz[:, 2] - model.top(xyz[:, 0], xyz[:, 1])


def face_tables(truth: list[RoofModel], models: list[RoofModel]) -> dict[str, pa.Table]:
    """Faces of truth and of models."""
    true_faces, model_faces = [], []
    for number, one in enumerate(truth):
        model = model_of(number, models)
        for surface in one.surfaces:
            lost = model is None or number % 7 in {1, 5} or (number % 7 == 6 and surface.plane_id == 0)
            true_faces.append(
                {
                    "building_id": one.building_id,
                    "plane_id": surface.plane_id,
                    "area_m2": surface.area_m2,
                    "slope_deg": math.degrees(math.acos(surface.normal[2])),
                    "to_be_found": surface.area_m2 >= 10.0,
                    "found": not lost,
                    "angle_deg": 0.1 * (number % 30),
                    "offset_m": 0.005 * (number % 20 - 10),
                    "geometry": shapely.to_wkb(surface.polygon),
                }
            )
    for model in models:
        is_wrong = model.building_id == "model-elsewhere" or model.status is Status.FALLBACK
        model_faces += [
            {
                "model_id": model.building_id,
                "plane_id": surface.plane_id,
                "wrong": is_wrong,
                "geometry": shapely.to_wkb(surface.polygon),
            }
            for surface in model.surfaces
        ]
    return {"true_faces": pa.Table.from_pylist(true_faces), "model_faces": pa.Table.from_pylist(model_faces)}


def outcome_table(rows: list[dict[str, object]]) -> pa.Table:
    counted = []
    for kind in sorted({str(row["true_type"]) for row in rows}):
        own = [row["outcome"] for row in rows if row["true_type"] == kind]
        counts = {name: own.count(name) for name in ("correct", "passable", "false")}
        counted.append({"subset": "all", "true_type": kind, **counts})
    return pa.Table.from_pylist(counted)


def confusion_table(rows: list[dict[str, object]]) -> pa.Table:
    """Pairs of types."""
    pairs = [(str(row["true_type"]), str(row["model_type"] or "none")) for row in rows]
    counts = [{"true_type": a, "model_type": b, "buildings": pairs.count((a, b))} for a, b in sorted(set(pairs))]
    return pa.Table.from_pylist(counts)


def histogram_table(rows: list[dict[str, object]], truth: list[RoofModel], models: list[RoofModel]) -> pa.Table:
    """Absolute residuals."""
    held = reference_of(truth)
    everything = np.concatenate([residuals_of(number, models, held) for number in range(len(rows))])
    covered = np.abs(everything[np.isfinite(everything)])
    edges = np.concatenate([np.arange(0.0, 2.0, 0.01), [2.0, 1e5]])
    counts = np.histogram(covered, edges)[0]
    return pa.table({"low_m": edges[:-1], "high_m": edges[1:], "count": counts, "count_top": counts // 2})


def measures_of(rows: list[dict[str, object]], tables: dict[str, pa.Table]) -> list[Measure]:
    """Figures over the rows."""
    n = len(rows)
    found = sum(row["model_id"] is not None for row in rows)
    made = [
        Measure(name="delivery.lod2", value=found / n, low=found / n - 0.05, high=found / n + 0.05, n=n),
        Measure(name="delivery.false_models", value=1.0, n=1),
        Measure(name="footprints.iou_median", value=0.98, low=0.97, high=0.99, n=n),
    ]
    if "n_points" in rows[0]:
        points, within = (sum(int(row[name]) for row in rows) for name in ("n_points", "n_within"))
        made += [
            Measure(name="residuals.within_0_2m", value=within / points, low=0.55, high=0.85, n=points),
            Measure(name="residuals.rmse", value=0.2345, low=0.2225, high=0.2465, n=points),
            Measure(name="residuals.bias", value=0.0123, low=-0.0101, high=0.0347, n=points),
        ]
    if "true_faces" in tables:
        good = [row for row in rows if row["good"]]
        correct = sum(row["outcome"] == "correct" for row in rows) / n
        of_good = sum(row["outcome"] == "correct" for row in good) / len(good)
        made += [
            Measure(name="faces.completeness_10m2", value=0.71, low=0.6, high=0.8, n=tables["true_faces"].num_rows),
            Measure(name="roof_types.correct", value=correct, low=correct - 0.1, high=correct + 0.1, n=n),
            Measure(name="roof_types.correct", value=of_good, n=len(good), subset="good"),
        ]
    return made
