"""Detection of buildings by area and by object (Rutzinger, Rottensteiner, Pfeifer 2009).

By area: on the raster of `building_raster`, with and without the ring of one cell on either side of the edges of the
reference, which alone has 9 to 15 % of the area. Given footprints may be incomplete: then cells count inside them only,
and there is neither correctness nor quality.

By object: a reference building is found if models cover at least half of its area, whatever their number; a model is
right if at least half of its area lies on reference buildings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from shapely import Polygon

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Share, Statistic, Sums, quality, share
from pipeline.ruler.evaluation.building_matching import (
    excused_models,
    mostly_on,
    overlapping,
    share_covered,
    sound_polygons,
    where_judged,
)
from pipeline.ruler.evaluation.building_raster import CELL_M, CellWindow, PlanRaster, PointRaster, edge_ring, windows_of
from pipeline.ruler.evaluation.measure import Definition, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Columns, Subset, measured_all, summed_over_units
from pipeline.scene import BUILDING_CLASS

MIN_OVERLAP = 0.5
"""Least share of its own area of a found building or a right model."""
OBJECT_AREAS_M2 = (0.0, 10.0, 50.0)
"""Least areas of the objects that are measured."""
BLOCK_CELLS = 100
"""Side of the blocks of 50 m that are the units of the bootstrap by area."""

_LAYERS = ("both", "reference", "found", "both_without_ring", "reference_without_ring", "found_without_ring")
_EVERYWHERE = (-np.inf, -np.inf, np.inf, np.inf)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Detection:
    """All rows of the measures of detection."""

    blocks: Columns
    """Blocks of 50 m with any building cell inside the extent of the reference: `row` and `column`, 0 at the origin of
    the CRS, ascending; cells that are building in `reference`, `found` by the models, or `both`, and the same
    `_without_ring`: without the cells at the edges of the reference."""
    buildings: Columns
    """Reference buildings: `building`, their index; `area_m2`; `overlap`, the share of it on models; `counts`, False if
    it touches the edge of the data."""
    models: Columns
    """Models: `building` with the largest common area, -1 for none; `area_m2`; `overlap` with reference buildings;
    `counts`, False if it lies on a cut building, at the edge of the data, or where the reference is incomplete."""
    has_correctness: bool
    """False if the reference is complete nowhere, so no model can be wrong."""


def detect(models: Sequence[RoofModel], reference: Reference) -> Detection:
    """Compare the places of models and buildings; given footprints need one pass over the points."""
    buildings, right = _objects(models, reference)
    return Detection(
        blocks=_blocks(models, reference),
        buildings=buildings,
        models=right,
        has_correctness=reference.extent is not None,
    )


# ----------------------------------------------------------------------------------------------------------- by area


def _blocks(models: Sequence[RoofModel], reference: Reference) -> Columns:
    """Count cells per block, window by window."""
    outlines = [building.footprint for building in reference.buildings]
    found = [model.footprint for model in models]
    names = ("row", "column", *_LAYERS)
    blocks = [np.zeros((0, len(names)), np.int64)]
    if outlines or reference.extent is not None:
        judged = outlines if reference.extent is None else [reference.extent]
        of_models, known = PlanRaster(found), PlanRaster(_polygons(judged))
        of_reference = _class_raster(reference) if reference.outlines == "given" else PlanRaster(outlines)
        for window in windows_of(_bounds_within([*outlines, *found], judged)):
            around = of_reference.window(window.grown(1))
            ring = edge_ring(around)[1:-1, 1:-1]
            counted = known.window(window)
            blocks.append(_count(window, around[1:-1, 1:-1] & counted, of_models.window(window) & counted, ring))
    rows = np.concatenate(blocks)
    return dict(zip(names, rows[np.lexsort((rows[:, 1], rows[:, 0]))].T, strict=True))


def _bounds_within(areas: Sequence[shapely.Geometry], known: Sequence[shapely.Geometry]) -> FloatArray:
    """(n, 4) bounds of areas, cut at the bounds of the known areas: no cell counts beyond them."""
    bounds = shapely.bounds(np.array([*areas], dtype=object)).reshape(-1, 4)
    whole = shapely.total_bounds(np.array([*known], dtype=object))
    low, high = np.maximum(bounds[:, :2], whole[:2]), np.minimum(bounds[:, 2:], whole[2:])
    cut: FloatArray = np.hstack((low, high))[(low <= high).all(axis=1)]
    return cut


def _class_raster(reference: Reference) -> PointRaster:
    """The raster of class 6: one pass over the points."""
    raster = PointRaster()
    for number, tile in enumerate(reference.points()):
        raster.add(tile.xyz, tile.classification == BUILDING_CLASS)
        raster.finish(reference.bounds[number + 1 :] if reference.bounds else [_EVERYWHERE])
    raster.finish()
    return raster


def _count(window: CellWindow, reference: BoolArray, found: BoolArray, ring: BoolArray) -> IntArray:
    """Row, column and `_LAYERS` of the blocks of a window with any building cell, (n, 8)."""
    layers = []
    for counted in (np.ones_like(ring), ~ring):
        layers += [reference & found & counted, reference & counted, found & counted]
    n_rows, n_columns = window.rows // BLOCK_CELLS, window.columns // BLOCK_CELLS
    sums = np.array(layers).reshape(-1, n_rows, BLOCK_CELLS, n_columns, BLOCK_CELLS).sum(axis=(2, 4), dtype=np.int64)
    rows, columns = np.nonzero(sums[1] + sums[2])
    place = (window.row // BLOCK_CELLS + rows, window.column // BLOCK_CELLS + columns)
    return np.column_stack([*place, *sums[:, rows, columns]])


# --------------------------------------------------------------------------------------------------------- by object


def _objects(models: Sequence[RoofModel], reference: Reference) -> tuple[Columns, Columns]:
    """Reference buildings and models with the share of their area on the other kind."""
    truth = sound_polygons([building.footprint for building in reference.buildings])
    made = sound_polygons([model.footprint for model in models])
    pairs = overlapping(truth, made)
    best = mostly_on(len(made), pairs)
    cut = np.array([*(building.touches_data_edge for building in reference.buildings), False], np.bool_)
    known = np.zeros(len(made), np.bool_)
    if reference.extent is not None:
        known = where_judged(made, truth, pairs, reference.extent)
        known &= ~np.where(best >= 0, cut[best], excused_models(models, reference))
    return (
        {
            "building": np.arange(len(truth)),
            "area_m2": shapely.area(truth),
            "overlap": share_covered(truth, made, pairs.swapped()),
            "counts": ~cut[:-1],
        },
        {
            "building": best,
            "area_m2": shapely.area(made),
            "overlap": share_covered(made, truth, pairs),
            "counts": known,
        },
    )


# ---------------------------------------------------------------------------------------------------------- measures

_RING = {
    "": ("", "all cells"),
    "_without_ring": (", without edges", "cells that are not in the ring of one cell on either side of its edges"),
}
_CELLS = f"R, F: cells of {CELL_M:g} m that are building in the reference and in the models"


def _definitions() -> tuple[Definition, ...]:
    found = []
    for suffix, (label, cells) in _RING.items():
        for name, formula in (
            ("completeness", "count(R and F) / count(R)"),
            ("correctness", "count(R and F) / count(F)"),
            ("quality", "count(R and F) / count(R or F)"),
        ):
            found.append((f"area_{name}{suffix}", f"{name} by area{label}", f"{formula}; {_CELLS}; {cells}"))
    for least in OBJECT_AREAS_M2:
        label = f" of at least {least:g} m2" if least else ""
        for name, formula in (
            ("completeness", "reference buildings with half of their area on models / reference buildings"),
            ("correctness", "models with half of their area on reference buildings / models"),
            ("quality", "1 / (1 / completeness + 1 / correctness - 1)"),
        ):
            note = f"; objects{label}, none that touches the edge of the data"
            found.append((f"object_{name}{_suffix(least)}", f"{name} by object{label}", formula + note))
    return tuple(defined(f"detection.{name}", label, formula) for name, label, formula in found)


def _suffix(min_m2: float) -> str:
    return f"_{min_m2:g}m2" if min_m2 else ""


DEFINITIONS = _definitions()
"""The measures."""


def detection_measures(rows: Detection, subset: Subset) -> list[Measure]:
    """The figures of a subset; by area only for all buildings, since a cell of a model belongs to no building.

    Units of the bootstrap by area are blocks of 50 m; by object, the reference buildings, each with the models that
    share most of their area with it, and the models on no building.
    """
    found = _area_measures(rows, subset) if subset.elsewhere else []
    return found + _object_measures(rows, subset)


def _area_measures(rows: Detection, subset: Subset) -> list[Measure]:
    if not len(rows.blocks["row"]):
        return []
    found = []
    for suffix in _RING:
        columns = {name: rows.blocks[name + suffix].astype(np.float64) for name in _LAYERS[:3]}
        sums = {name: float(column.sum()) for name, column in columns.items()}
        figures: list[tuple[str, Statistic, float]] = [
            ("completeness", share("both", "reference"), sums["reference"]),
            ("correctness", share("both", "found"), sums["found"]),
            ("quality", quality("both", "reference", "found"), sums["reference"] + sums["found"] - sums["both"]),
        ]
        found += _named(rows, columns, subset, "area", suffix, figures)
    return found


def _object_measures(rows: Detection, subset: Subset) -> list[Measure]:
    """Completeness, correctness and quality of objects of each least size."""
    if not len(rows.buildings["counts"]) and not rows.has_correctness:
        return []
    found = []
    for least in OBJECT_AREAS_M2:
        kinds = [
            {name: column[one["counts"] & (one["area_m2"] >= least)] for name, column in one.items()}
            for one in (rows.buildings, rows.models)
        ]
        building = np.concatenate([one["building"] for one in kinds])
        is_model = np.repeat([False, True], [len(one["building"]) for one in kinds])
        right = np.concatenate([one["overlap"] for one in kinds]) >= MIN_OVERLAP
        columns = {"wanted": ~is_model, "hit": ~is_model & right, "made": is_model, "right": is_model & right}
        arrays = summed_over_units(
            subset,
            building,
            np.arange(len(building)),
            {name: column.astype(np.float64) for name, column in columns.items()},
        )
        wanted, made = arrays["wanted"].sum(), arrays["made"].sum()
        figures: list[tuple[str, Statistic, float]] = [
            ("completeness", share("hit", "wanted"), wanted),
            ("correctness", share("right", "made"), made),
            ("quality", _OBJECT_QUALITY, wanted + made),
        ]
        found += _named(rows, arrays, subset, "object", _suffix(least), figures)
    return found


def _named(
    rows: Detection,
    columns: Mapping[str, FloatArray],
    subset: Subset,
    kind: str,
    suffix: str,
    figures: Sequence[tuple[str, Statistic, float]],
) -> list[Measure]:
    """The figures of one kind and size; completeness alone if no model can be wrong."""
    possible = figures if rows.has_correctness else figures[:1]
    return measured_all(columns, subset, [(f"detection.{kind}_{name}{suffix}", of, n) for name, of, n in possible])


def _object_quality(sums: Sums) -> FloatArray:
    """TP / (TP + FN + FP) of objects whose true positives differ on both sides; 0 where either share is 0."""
    complete, correct = sums["hit"] / sums["wanted"], sums["right"] / sums["made"]
    harmonic = complete * correct / (complete + correct - complete * correct)
    return np.where((complete == 0.0) | (correct == 0.0), 0.0, harmonic)


_OBJECT_QUALITY = Share(figure=_object_quality, denominator="wanted")


def _polygons(areas: Sequence[shapely.Geometry]) -> list[Polygon]:
    """The polygons of some areas."""
    return [part for part in shapely.get_parts([*areas]).tolist() if isinstance(part, Polygon)]
