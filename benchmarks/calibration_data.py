"""Candidates whose truth is known, for `benchmarks.detection_confidence`: models and rejected objects, right or not.

Simulated ones come from `benchmarks.trust`, where the truth is exact. Those of real surveys are judged by the classes
that the run did not read:

- A candidate is a building if at least three quarters of the last returns within its outline, `ABOVE_FLOOR_M` or more
  above its floor, are of class 6. It is none if at most a quarter is. Others are left out.
- A candidate of mostly unclassified points (0 and 1) is left out unless a third of its points went on to a later
  return: then it is a tree. Files without classes of vegetation have trees and sheds in class 1.
- The outline of a rejected object is the box around it. One whose box overlaps a model by more than `TOUCHES` of
  itself is left out: it may be a piece of that building.
- Candidates without a confidence are left out: some blocks, objects of which no place could be judged.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow.parquet as pq
import shapely
from scipy.spatial import cKDTree

from pipeline.export.geoparquet import read_table
from pipeline.model import BoolArray, FloatArray
from pipeline.quality.detection import AT_FLATNESS_1, AT_NO_ROUGH, LEAST_NOISE_M, MOST, PER_LOG_FLATNESS, PER_LOG_ROUGH
from pipeline.scene import BUILDING_CLASS

ABOVE_FLOOR_M = 1.5
"""Lower points are ground and yard rather than roof or wall."""
MIN_SHARE, MAX_SHARE = 0.75, 0.25
"""Least share of class 6 of a building, and the largest of anything else."""
TREE_SHARE = 1.0 / 3.0
"""Least share of unclassified points that went on to a later return, in a tree."""
TOUCHES = 0.02
"""Share of the box of a rejected object that lies over models, in a piece of a building."""
GROUND_CLASS, UNCLASSIFIED = 2, (0, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Candidates:
    """Candidates whose truth is known, (n,) each."""

    survey: np.ndarray[Any, np.dtype[np.str_]]
    """Name of the real survey; density, returns and step of the simulated one."""
    is_real: BoolArray
    is_model: BoolArray
    """Whether it has a model; rejected otherwise."""
    is_block: BoolArray
    """Whether that model is a block: its figure is that of the doubtful model that it replaced."""
    figure: FloatArray
    """Logarithm of the flatness of a model, or of 1 + the rough places of a rejected object."""
    right: BoolArray
    """Whether it is a building."""

    def __getitem__(self, chosen: BoolArray) -> Candidates:
        return Candidates(**{field.name: getattr(self, field.name)[chosen] for field in dataclasses.fields(self)})

    def __len__(self) -> int:
        return len(self.right)


def together(parts: Sequence[Candidates]) -> Candidates:
    """All of some candidates."""
    names = [field.name for field in dataclasses.fields(Candidates)]
    return Candidates(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def figure_of(row: Mapping[str, Any]) -> float:
    """The figure of a record; nan where its confidence is null."""
    confidence = row["detection_confidence"]
    if confidence is None:
        return math.nan
    # some records lack the figure, but not the confidence that follows from it
    if "object_id" in row:
        return (_log_odds(confidence) - AT_NO_ROUGH) / PER_LOG_ROUGH
    if row["noise_m"] is None:
        return (_log_odds(confidence / MOST) - AT_FLATNESS_1) / PER_LOG_FLATNESS
    width_m = math.sqrt(row["footprint_area_m2"] / row["n_planes"])
    return math.log(width_m / max(LEAST_NOISE_M, row["noise_m"]))


def _log_odds(probability: float) -> float:
    """Log-odds of a rounded probability."""
    probability = min(max(probability, 5e-5), 1.0 - 5e-5)
    return math.log(probability / (1.0 - probability))


def _candidates(rows: Sequence[Mapping[str, Any]], is_real: bool) -> Candidates:
    """Candidates of records with `survey` and `right`, which is None where the truth is not known."""
    known = [(row, figure_of(row)) for row in rows if row["right"] is not None]
    known = [(row, figure) for row, figure in known if not math.isnan(figure)]
    return Candidates(
        survey=np.array([row["survey"] for row, _ in known], np.str_),
        is_real=np.full(len(known), is_real),
        is_model=np.array(["object_id" not in row for row, _ in known], bool),
        is_block=np.array(["object_id" not in row and row["noise_m"] is None for row, _ in known], bool),
        figure=np.array([figure for _, figure in known], float),
        right=np.array([row["right"] for row, _ in known], bool),
    )


MODEL_COLUMNS = ("building_id", "geometry", "ground_z", "noise_m", "n_planes", "footprint_area_m2")
REJECTED_COLUMNS = ("object_id", "geometry")


def simulated(tables: Path) -> Candidates:
    """The candidates of `benchmarks.trust`: `tables` is OUT/SPLIT, without the ending."""
    columns = ["survey", "detection_confidence"]
    models = pq.read_table(f"{tables}.parquet").select([*columns, *MODEL_COLUMNS, "right", "wrong_because"]).to_pylist()
    judged = [
        row | {"right": None if row["right"] is None else row["wrong_because"] != "not_a_building"} for row in models
    ]
    rejected = pq.read_table(f"{tables}_rejected.parquet").select([*columns, *REJECTED_COLUMNS, "is_building"])
    return _candidates([*judged, *(row | {"right": row["is_building"]} for row in rejected.to_pylist())], False)


def real(name: str, run: Path, tiles: Sequence[Path]) -> Candidates:
    """The candidates of a run that ignored the classes of its files, judged by these."""
    points, look = points_of(tiles)
    floors = points[points[:, 3] == GROUND_CLASS]
    floor_at = cKDTree(floors[:, :2])
    rows = []
    columns = ["detection_confidence"]
    models = read_table(str(run), "buildings").select([*columns, *MODEL_COLUMNS]).to_pylist()
    outlines = [None if row["geometry"] is None else shapely.from_wkb(row["geometry"]) for row in models]
    for row, outline in zip(models, outlines, strict=True):
        right = None if outline is None else is_building(look(outline), row["ground_z"])
        rows.append(row | {"survey": name, "right": right})
    plan = shapely.union_all([outline for outline in outlines if outline is not None])
    for row in read_table(str(run), "rejected").select([*columns, *REJECTED_COLUMNS]).to_pylist():
        box = None if row["geometry"] is None else shapely.from_wkb(row["geometry"])
        if box is None or box.area <= 0.0 or plan.intersection(box).area > TOUCHES * box.area:
            continue
        floor = floors[floor_at.query((box.centroid.x, box.centroid.y))[1], 2]
        rows.append(row | {"survey": name, "right": is_building(look(box), floor)})
    return _candidates(rows, True)


def points_of(tiles: Sequence[Path]) -> tuple[FloatArray, Callable[[shapely.Geometry], FloatArray]]:
    """Points (n, 6) by x: place, class, whether last, whether it went on; and a function of those in an outline."""
    parts = []
    for tile in tiles:
        las = laspy.read(tile)
        number, returns = np.asarray(las.return_number), np.asarray(las.number_of_returns)
        columns = [*(np.asarray(getattr(las, axis)) for axis in "xyz"), np.asarray(las.classification)]
        parts.append(np.column_stack([*columns, number >= returns, number < returns]).astype(float))
    points = np.concatenate(parts)
    points = points[np.argsort(points[:, 0], kind="stable")]

    def look(outline: shapely.Geometry) -> FloatArray:
        x0, y0, x1, y1 = outline.bounds
        near = points[np.searchsorted(points[:, 0], x0) : np.searchsorted(points[:, 0], x1, side="right")]
        near = near[(near[:, 1] >= y0) & (near[:, 1] <= y1)]
        inside: FloatArray = near[shapely.intersects_xy(outline, near[:, 0], near[:, 1])]
        return inside

    return points, look


def is_building(points: FloatArray, floor_z: float) -> bool | None:
    """Whether points are those of a building; None where their classes do not say."""
    points = points[points[:, 2] > floor_z + ABOVE_FLOOR_M]
    last = points[points[:, 4] > 0.0]
    if not len(last):
        return None
    share = float(np.mean(last[:, 3] == BUILDING_CLASS))
    if share >= MIN_SHARE:
        return True
    is_unclassified = np.mean(np.isin(last[:, 3], UNCLASSIFIED)) > 0.5
    if share > MAX_SHARE or (is_unclassified and np.mean(points[:, 5]) < TREE_SHARE):
        return None
    return False
