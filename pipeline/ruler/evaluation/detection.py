"""Detection of buildings by area and by object (Rutzinger, Rottensteiner, Pfeifer 2009).

By area: on the raster of `building_raster`, with and without the ring of one cell on either side of the edges of the
reference, which alone has 9 to 15 % of the area. Given footprints may be incomplete: then cells count inside them only,
and there is neither correctness nor quality.

By object: a reference building is found if models cover at least half of its area, whatever their number; a model is
right if at least half of its area lies on reference buildings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import Polygon

from pipeline.model import BoolArray, FloatArray
from pipeline.ruler.evaluation.bootstrap import Share, Statistic, Sums, quality, share
from pipeline.ruler.evaluation.building_raster import CELL_M, CellWindow, PlanRaster, PointRaster, edge_ring, windows_of
from pipeline.ruler.evaluation.matching import (
    excused_models,
    mostly_on,
    overlapping,
    share_covered,
    sound_polygons,
    where_judged,
)
from pipeline.ruler.evaluation.measure import Definition, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Subset, measured, summed_over_units
from pipeline.scene import BUILDING_CLASS

MIN_OVERLAP = 0.5
"""Least share of its own area of a found building or a right model."""
OBJECT_AREAS_M2 = (0.0, 10.0, 50.0)
"""Least areas of the objects that are measured."""
BLOCK_CELLS = 100
"""Side of the blocks of 50 m that are the units of the bootstrap by area."""

_COUNTS = ("both", "reference", "found")
_EVERYWHERE = (-np.inf, -np.inf, np.inf, np.inf)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectionBlock:
    """Cells of one block of 50 m, inside the extent of the reference."""

    row: int
    """Index of the block along northing, 0 at the origin of the CRS."""
    column: int
    """Index along easting."""
    both: int
    """Cells that are building in the reference and in the models."""
    reference: int
    """Cells that are building in the reference."""
    found: int
    """Cells that are building in the models."""
    both_without_ring: int
    """`both` without the cells at the edges of the reference."""
    reference_without_ring: int
    """`reference` without them."""
    found_without_ring: int
    """`found` without them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectedObject:
    """A reference building or a model, and its share on the other kind."""

    name: str
    """Its building_id."""
    building: int
    """Index of the reference building; for a model the one with the largest common area, -1 for none."""
    area_m2: float
    """Area of its footprint."""
    overlap: float
    """Share of its area on models, or for a model on reference buildings."""
    counts: bool
    """False if it touches the edge of the data; for a model if it lies on such a building or at that edge, or where
    the reference is incomplete."""

    @property
    def found(self) -> bool:
        """Whether a building is found, or a model right."""
        return self.overlap >= MIN_OVERLAP


@dataclasses.dataclass(frozen=True, kw_only=True)
class Detection:
    """All rows of the measures of detection."""

    blocks: tuple[DetectionBlock, ...]
    """By row and column, without blocks that have no building cell; empty without reference buildings."""
    buildings: tuple[DetectedObject, ...]
    """One per reference building, in their order."""
    models: tuple[DetectedObject, ...]
    """One per model, in their order."""
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


def _blocks(models: Sequence[RoofModel], reference: Reference) -> tuple[DetectionBlock, ...]:
    """Count cells per block, window by window."""
    outlines = [building.footprint for building in reference.buildings]
    found = [model.footprint for model in models]
    if not outlines and reference.extent is None:
        return ()
    of_models = PlanRaster(found)
    known = PlanRaster(outlines if reference.extent is None else _polygons(reference.extent))
    of_reference = _class_raster(reference).window if reference.outlines == "given" else PlanRaster(outlines).window
    blocks: list[DetectionBlock] = []
    for window in windows_of(
        _bounds_within([*outlines, *found], outlines if reference.extent is None else [reference.extent])
    ):
        around = of_reference(window.grown(1))
        ring = edge_ring(around)[1:-1, 1:-1]
        counted = known.window(window)
        blocks += _count(window, around[1:-1, 1:-1] & counted, of_models.window(window) & counted, ring)
    return tuple(sorted(blocks, key=lambda block: (block.row, block.column)))


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


def _count(window: CellWindow, reference: BoolArray, found: BoolArray, ring: BoolArray) -> list[DetectionBlock]:
    """The blocks of a window with any building cell."""
    layers = []
    for counted in (np.ones_like(ring), ~ring):
        layers += [reference & found & counted, reference & counted, found & counted]
    n_rows, n_columns = window.rows // BLOCK_CELLS, window.columns // BLOCK_CELLS
    sums = [
        layer.reshape(n_rows, BLOCK_CELLS, n_columns, BLOCK_CELLS).sum(axis=(1, 3), dtype=np.int64) for layer in layers
    ]
    rows, columns = np.nonzero(sums[1] + sums[2])
    return [
        DetectionBlock(
            row=window.row // BLOCK_CELLS + r,
            column=window.column // BLOCK_CELLS + c,
            both=int(sums[0][r, c]),
            reference=int(sums[1][r, c]),
            found=int(sums[2][r, c]),
            both_without_ring=int(sums[3][r, c]),
            reference_without_ring=int(sums[4][r, c]),
            found_without_ring=int(sums[5][r, c]),
        )
        for r, c in zip(rows.tolist(), columns.tolist(), strict=True)
    ]


# --------------------------------------------------------------------------------------------------------- by object


def _objects(
    models: Sequence[RoofModel], reference: Reference
) -> tuple[tuple[DetectedObject, ...], tuple[DetectedObject, ...]]:
    """Reference buildings and models with the share of their area on the other kind."""
    truth = sound_polygons([building.footprint for building in reference.buildings])
    made = sound_polygons([model.footprint for model in models])
    pairs = overlapping(truth, made)
    best = mostly_on(len(made), pairs)
    cut = np.array([building.touches_data_edge for building in reference.buildings], np.bool_)
    known = np.zeros(len(made), np.bool_)
    if reference.extent is not None:
        known = where_judged(made, truth, pairs, reference.extent)
        known &= ~np.where(best >= 0, cut[best] if len(cut) else False, excused_models(models, reference))
    overlap_truth = share_covered(truth, made, pairs.swapped())
    overlap_made = share_covered(made, truth, pairs)
    return (
        tuple(
            DetectedObject(
                name=building.building_id,
                building=number,
                area_m2=float(truth[number].area),
                overlap=float(overlap_truth[number]),
                counts=not building.touches_data_edge,
            )
            for number, building in enumerate(reference.buildings)
        ),
        tuple(
            DetectedObject(
                name=model.building_id,
                building=int(best[number]),
                area_m2=float(made[number].area),
                overlap=float(overlap_made[number]),
                counts=bool(known[number]),
            )
            for number, model in enumerate(models)
        ),
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
    if not rows.blocks:
        return []
    found = []
    for suffix in _RING:
        columns = {
            name: np.array([getattr(block, name + suffix) for block in rows.blocks], np.float64) for name in _COUNTS
        }
        union = columns["reference"].sum() + columns["found"].sum() - columns["both"].sum()
        figures: list[tuple[str, Statistic, float]] = [
            ("completeness", share("both", "reference"), columns["reference"].sum())
        ]
        if rows.has_correctness:
            figures += [
                ("correctness", share("both", "found"), columns["found"].sum()),
                ("quality", quality("both", "reference", "found"), union),
            ]
        found += [
            measured(f"detection.area_{name}{suffix}", columns, statistic, n=n, subset=subset)
            for name, statistic, n in figures
        ]
    return found


def _object_measures(rows: Detection, subset: Subset) -> list[Measure]:
    """Completeness, correctness and quality of objects of each least size."""
    if not rows.buildings and not rows.has_correctness:
        return []
    found = []
    for least in OBJECT_AREAS_M2:
        buildings = [one for one in rows.buildings if one.counts and one.area_m2 >= least]
        models = [one for one in rows.models if one.counts and one.area_m2 >= least]
        objects, zeros = (*buildings, *models), ([0.0] * len(buildings), [0.0] * len(models))
        columns: dict[str, list[float]] = {
            "wanted": [*(1.0 for _ in buildings), *zeros[1]],
            "hit": [*(float(one.found) for one in buildings), *zeros[1]],
            "made": [*zeros[0], *(1.0 for _ in models)],
            "right": [*zeros[0], *(float(one.found) for one in models)],
        }
        arrays = summed_over_units(
            subset,
            np.array([one.building for one in objects], np.int64),
            np.arange(len(objects)),
            {name: np.array(column, np.float64) for name, column in columns.items()},
        )
        wanted, made = arrays["wanted"].sum(), arrays["made"].sum()
        figures: list[tuple[str, Statistic, float]] = [("completeness", share("hit", "wanted"), wanted)]
        if rows.has_correctness:
            figures += [("correctness", share("right", "made"), made), ("quality", _OBJECT_QUALITY, wanted + made)]
        found += [
            measured(f"detection.object_{name}{_suffix(least)}", arrays, statistic, n=n, subset=subset)
            for name, statistic, n in figures
        ]
    return found


def _object_quality(sums: Sums) -> FloatArray:
    """TP / (TP + FN + FP) of objects whose true positives differ on both sides; 0 where either share is 0."""
    complete, correct = sums["hit"] / sums["wanted"], sums["right"] / sums["made"]
    harmonic = complete * correct / (complete + correct - complete * correct)
    return np.where((complete == 0.0) | (correct == 0.0), 0.0, harmonic)


_OBJECT_QUALITY = Share(figure=_object_quality, denominator="wanted")


def _polygons(geometry: shapely.Geometry) -> list[Polygon]:
    """The polygons of an extent."""
    return [part for part in shapely.get_parts(geometry).tolist() if isinstance(part, Polygon)]
