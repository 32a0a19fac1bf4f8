"""A simulated data set as a reference: exact models, and points with the surface that they hit."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from pipeline.errors import InconsistentInputError, InputError
from pipeline.io import ReadOptions, open_source
from pipeline.model import FloatArray, LabelArray, PointCloud
from pipeline.quality.residuals import TopSurface, plan_index
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference import Conditions, Reference, ReferencePoints
from pipeline.ruler.evaluation.survey_shift import mean_shifts, moved_buildings, strip_shifts

FIX = "Give the folder `truth` that `gablework simulate` wrote, with the point files where it wrote them"

_ALL_POINTS = ReadOptions(keep_withheld=True, drop_classes=())
"""Labels match by position: every point must be read."""
_LABELS_A_BATCH = 1_000_000
_NOTE = "Returns that melt echoes of two surfaces are roof points where their label is a roof face: they were measured."


def read_truth_reference(truth_dir: str | Path, *, as_surveyed: bool = False) -> Reference:
    """The truth of one simulated data set; its points are read tile by tile on demand.

    The folder `truth` that `simulate` wrote has models as a run directory, scene.json, labels, and optionally
    conditions.parquet. scene.json lists the point files; otherwise it is the one LAZ beside the folder. `as_surveyed`
    moves each building by the mean shift of the strips of its points, to where the survey saw it.

    Roof points hit a roof face and lie inside the footprint of its building: no model can explain a return that the
    survey put outside. Faces carry their groups. Raises InputError if scene.json, labels or points are missing or
    unreadable, or do not belong together.
    """
    folder = Path(truth_dir)
    scene = _scene(folder)
    models = read_models(folder)
    conditions, groups = _conditions(folder / "conditions.parquet")
    buildings = tuple(_grouped(model, groups.get(model.building_id, ())) for model in models.models)
    pairs = _tile_files(folder, scene)
    number_of = {building.building_id: number for number, building in enumerate(buildings)}
    notes = (*models.notes, _NOTE)
    if as_surveyed:
        shifts = strip_shifts(scene, str(folder / "scene.json"))
        shift = mean_shifts(len(buildings), (_roof_strips(*pair, number_of) for pair in pairs), shifts)
        buildings = moved_buildings(buildings, shift)
        notes = (*notes, _shift_note(shift))
    footprints = plan_index([building.footprint for building in buildings])
    name = folder.parent.name if folder.name == "truth" else folder.name
    return Reference(
        name=f"{scene.get('suite', name)} (truth{', as surveyed' if as_surveyed else ''})",
        kind="truth",
        buildings=buildings,
        has_faces=True,
        outlines="truth",
        tiles=tuple(functools.partial(_read_tile, laz, labels, number_of, footprints) for laz, labels in pairs),
        bounds=tuple(_plan_bounds(laz) for laz, _ in pairs),
        conditions=conditions,
        face_points=_points_of_faces([labels for _, labels in pairs]),
        extent=shapely.box(*scene["extent"]),
        has_ground=True,
        crs=scene.get("crs"),
        notes=notes,
    )


def _shift_note(shift: FloatArray) -> str:
    away = np.hypot(shift[:, 0], shift[:, 1])
    plan, up = (float(np.median(values)) if len(shift) else 0.0 for values in (away, np.abs(shift[:, 2])))
    return (
        "True buildings stand where the survey saw them: moved by the mean shift of the strips of their points, in the "
        f"median {plan:.2f} m in plan and {up:.2f} m in elevation."
    )


def _roof_strips(laz: Path, labels: Path, number_of: Mapping[str, int]) -> tuple[LabelArray, LabelArray]:
    """Building and strip, from 0, of the points on roofs of one tile."""
    table, clouds = _labelled(laz, labels)
    building = np.concatenate([_numbers(ids, number_of, labels) for ids in table["building_id"].chunks])
    strip = np.concatenate([np.zeros(0, np.int32), *(cloud.source_id.astype(np.int32) - 1 for cloud in clouds)])
    on_roof = (building >= 0) & (table["face"].to_numpy() >= 0)
    return building[on_roof], strip[on_roof]


def _scene(folder: Path) -> dict[str, Any]:
    try:
        scene: dict[str, Any] = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(str(folder), f"no readable scene.json ({error})", FIX) from error
    extent = scene.get("extent")
    if not (isinstance(extent, list) and len(extent) == 4 and extent[0] < extent[2] and extent[1] < extent[3]):
        raise InputError(str(folder / "scene.json"), f"extent is {extent}, not x_min, y_min, x_max, y_max", FIX)
    return scene


def _tile_files(folder: Path, scene: Mapping[str, Any]) -> list[tuple[Path, Path]]:
    """Points and labels of each tile."""
    if scene.get("tiles"):
        pairs = [(folder / tile["laz"], folder / tile["labels"]) for tile in scene["tiles"]]
    else:
        beside = sorted(folder.parent.glob("*.laz"))
        if len(beside) != 1:
            raise InputError(
                str(folder.parent), f"{len(beside)} LAZ files beside the truth and no tiles in scene.json", FIX
            )
        pairs = [(beside[0], folder / "labels.parquet")]
    missing = [str(path) for pair in pairs for path in pair if not path.is_file()]
    if missing:
        raise InputError(missing[0], f"not there, and {len(missing) - 1} more of the data set's files", FIX)
    return pairs


def _plan_bounds(laz: Path) -> tuple[float, float, float, float]:
    x0, y0, _, x1, y1, _ = open_source(laz, _ALL_POINTS).info.bounds_m
    return x0, y0, x1, y1


def _conditions(path: Path) -> tuple[dict[str, Conditions], dict[str, Sequence[int]]]:
    """Conditions and groups of faces by building_id; empty without such a table."""
    if not path.is_file():
        return {}, {}
    try:
        rows = pq.read_table(path).to_pylist()
        conditions = {
            row["building_id"]: Conditions(
                shape=row["shape"],
                good=row["good"],
                defects=tuple(row["defects"]),
                pitch_deg=row["pitch_deg"],
                terrain_slope_deg=row["terrain_slope_deg"],
            )
            for row in rows
        }
        return conditions, {row["building_id"]: row["groups"] for row in rows}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(str(path), f"not a table of conditions ({error})", FIX) from error


def _grouped(model: RoofModel, groups: Sequence[int]) -> RoofModel:
    """The model with the group of each plane on its surfaces."""
    surfaces = tuple(
        dataclasses.replace(surface, group=int(groups[surface.plane_id]))
        if 0 <= surface.plane_id < len(groups)
        else surface
        for surface in model.surfaces
    )
    return dataclasses.replace(model, surfaces=surfaces)


def _points_of_faces(tables: Sequence[Path]) -> dict[tuple[str, int], int]:
    """Points on each true roof face, by building_id and plane_id: one pass over the labels, some at a time."""
    counts: dict[tuple[str, int], int] = {}
    for path in tables:
        for names, holder, face in _label_batches(path):
            on_roof = (holder >= 0) & (face >= 0)
            if not on_roof.any():
                continue
            stride = int(face.max()) + 1
            found, number = np.unique(holder[on_roof].astype(np.int64) * stride + face[on_roof], return_counts=True)
            for key, count in zip(found.tolist(), number.tolist(), strict=True):
                place = names[key // stride], key % stride
                counts[place] = counts.get(place, 0) + count
    return counts


def _label_batches(path: Path) -> Any:
    """Names, index into them (-1 for none), and face of the labels, batch by batch."""
    try:
        with pq.ParquetFile(path, read_dictionary=["building_id"]) as table:
            for batch in table.iter_batches(_LABELS_A_BATCH, columns=["building_id", "face"]):
                ids = batch.column("building_id")
                yield ids.dictionary.to_pylist(), _indices(ids), np.asarray(batch.column("face"))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(str(path), f"not a table of labels ({error})", FIX) from error


def _indices(ids: pa.DictionaryArray) -> LabelArray:
    """Indices into the dictionary, (n,) int32; -1 for null."""
    return np.asarray(ids.indices.fill_null(-1)).astype(np.int32)


def _read_tile(laz: Path, labels: Path, number_of: Mapping[str, int], footprints: TopSurface) -> ReferencePoints:
    """The points of one tile with their labels, which are in the same order."""
    table, clouds = _labelled(laz, labels)
    xyz = np.concatenate([cloud.xyz for cloud in clouds]) if clouds else np.zeros((0, 3))
    building = np.concatenate([_numbers(ids, number_of, labels) for ids in table["building_id"].chunks])
    face = table["face"].to_numpy().astype(np.int32)
    is_roof = (building >= 0) & (face >= 0)
    hits = np.flatnonzero(is_roof)
    is_roof[hits] = footprints.face(xyz[hits, 0], xyz[hits, 1]) == building[hits]
    return_number = np.concatenate([cloud.return_number for cloud in clouds])
    return ReferencePoints(
        name=laz.name,
        xyz=xyz,
        classification=table["class"].to_numpy().astype(np.int32),
        building=building,
        face=face,
        is_roof=is_roof,
        last=np.concatenate([cloud.return_number >= cloud.return_count for cloud in clouds]),
        return_number=return_number,
    )


def _labelled(laz: Path, labels: Path) -> tuple[pa.Table, list[PointCloud]]:
    """Labels and points of a tile, equal in number."""
    try:
        table = pq.read_table(labels, columns=["class", "building_id", "face"], read_dictionary=["building_id"])
    except (OSError, ValueError, KeyError) as error:
        raise InputError(str(labels), f"not a table of labels ({error})", FIX) from error
    clouds = list(open_source(laz, _ALL_POINTS).chunks())
    points = sum(len(cloud) for cloud in clouds)
    if points != len(table):
        raise InconsistentInputError(str(labels), f"{len(table)} labels for the {points} points of {laz}", FIX)
    return table, clouds


def _numbers(ids: pa.DictionaryArray, number_of: Mapping[str, int], path: Path) -> LabelArray:
    """Index into the true buildings of every label."""
    names = ids.dictionary.to_pylist()
    indices = _indices(ids)
    used = np.unique(indices[indices >= 0]).tolist()
    strangers = [names[number] for number in used if names[number] not in number_of]
    if strangers:
        raise InconsistentInputError(
            str(path), f"{len(strangers)} labelled buildings have no true model, {strangers[0]!r} for one", FIX
        )
    table = np.array([number_of.get(name, -1) for name in names] + [-1], np.int32)
    return table[indices]
