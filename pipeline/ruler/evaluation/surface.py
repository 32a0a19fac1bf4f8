"""Roof surfaces against true roof surfaces: vertical differences on a lattice over the true roofs.

The top of all models together is compared with the true top: split and joined buildings do not matter. A place of a
true roof that no model covers is a miss.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from pipeline.model import FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import ratio
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.residual_scores import BIAS, COVERAGE, RMSE, WITHIN, Tallies, top_surface_of
from pipeline.ruler.evaluation.subsets import Subset, measured_all

SAMPLE_M = 0.25
"""Spacing of the lattice."""
GOOD_M = 0.2
"""Vertical distance that still counts as right."""
_ROUNDING = 1e-6
"""Numerical guard, metres."""
EDGES_M: FloatArray = np.concatenate(
    (
        [0.0],
        [1e-6],  # differences in the last bits are none
        np.arange(1, 200) * 0.001,
        0.2 + np.arange(160) * 0.005,
        1.0 + np.arange(80) * 0.05,
        5.0 + np.arange(90) * 0.5,
        [50.0, 1e5],
    )
)
"""Borders of the bins of |difference|: 1 mm up to 0.2 m, 5 mm up to 1 m, 50 mm up to 5 m, 0.5 m up to 50 m."""
_PLACES_A_BATCH = 2_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfaceScore:
    """Distances, models minus truth, at lattice places on the true roof of each reference building."""

    tallies: Tallies
    median_m: FloatArray
    """(buildings,) median of the absolute distances where covered; nan without any."""


def score_surface(
    models: Sequence[RoofModel], reference: Reference, *, sample_m: float = SAMPLE_M
) -> SurfaceScore | None:
    """The differences of all reference buildings; None against a reference without faces.

    The lattice has its places at odd multiples of half of `sample_m`. Memory is bounded, apart from the rows.
    """
    if not reference.has_faces:
        return None
    truth, made = top_surface_of(reference.buildings), top_surface_of(models, near=reference.buildings)
    count = len(reference.buildings)
    owner = np.repeat(np.arange(count), [len(one.surfaces) for one in reference.buildings])
    owner = np.append(owner, -1)  # of face -1: none
    tallies, median_m = Tallies(count, EDGES_M), np.full(count, np.nan)
    for index, x, y in _lattices(reference.buildings, sample_m):
        true_z, face = truth.at(x, y)
        own = owner[face] == index
        difference = made.elevation(x[own], y[own]) - true_z[own]
        building, starts = np.unique(index[own], return_index=True)
        ends = itertools.pairwise([*starts.tolist(), len(difference)])
        for number, (first, last) in zip(building.tolist(), ends, strict=True):
            values = difference[first:last]
            covered = values[np.isfinite(values)]
            sizes = np.abs(covered)
            tallies.counts[number] = len(values), len(covered), (sizes <= GOOD_M + _ROUNDING).sum()
            tallies.sums[number] = covered.sum(), np.square(covered).sum()
            bins = np.clip(np.searchsorted(EDGES_M, sizes, side="right") - 1, 0, len(EDGES_M) - 2)
            tallies.histogram[number] = np.bincount(bins, minlength=len(EDGES_M) - 1)
            median_m[number] = np.median(sizes) if len(sizes) else np.nan
    return SurfaceScore(tallies=tallies, median_m=median_m)


def _lattices(buildings: Sequence[RoofModel], sample_m: float) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
    """Places over the bounds of some buildings at a time: index of the building, x, y."""
    held: list[tuple[int, FloatArray, FloatArray]] = []
    for index, building in enumerate(buildings):
        x, y = lattice_over([surface.polygon.bounds for surface in building.surfaces], sample_m)
        held.append((index, x, y))
        if sum(len(places) for _, places, _ in held) >= _PLACES_A_BATCH:
            yield _together(held)
            held = []
    if held:
        yield _together(held)


def _together(held: Sequence[tuple[int, FloatArray, FloatArray]]) -> tuple[IntArray, FloatArray, FloatArray]:
    index = np.repeat([one for one, _, _ in held], [len(x) for _, x, _ in held])
    return index, np.concatenate([x for _, x, _ in held]), np.concatenate([y for _, _, y in held])


def lattice_over(bounds: Sequence[tuple[float, float, float, float]], sample_m: float) -> tuple[FloatArray, FloatArray]:
    """Places (x, y) of a lattice of whole multiples of sample_m, shifted by half of it, over all of some bounds.

    >>> lattice_over([(0.1, 0.1, 0.9, 0.4)], 0.5)
    (array([0.25, 0.75]), array([0.25, 0.25]))
    """
    if not bounds:
        return np.zeros(0), np.zeros(0)
    corners = np.array(bounds)
    low, high = np.floor(corners[:, :2].min(axis=0) / sample_m), np.ceil(corners[:, 2:].max(axis=0) / sample_m)
    columns, rows = (np.arange(low[axis], high[axis]) + 0.5 for axis in (0, 1))
    x, y = np.meshgrid(columns * sample_m, rows * sample_m)
    return x.ravel(), y.ravel()


def measures(score: SurfaceScore | None, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings; none without rows."""
    if score is None or not len(score.median_m):
        return []
    tallies = score.tallies
    columns: dict[str, FloatArray] = {name: one[subset.buildings] for name, one in tallies.columns().items()}
    columns["histogram"] = tallies.histogram[subset.buildings].astype(np.float64)
    columns["buildings"] = (columns["n_points"] > 0.0).astype(np.float64)
    columns["within"] = np.nan_to_num(tallies.figure(WITHIN)[subset.buildings])
    places, covered = float(columns["n_points"].sum()), float(columns["n_covered"].sum())
    return measured_all(
        columns,
        subset,
        (
            ("surface.coverage", COVERAGE, places),
            ("surface.within_0_2m", WITHIN, places),
            ("surface.within_0_2m_mean", ratio("within", "buildings"), float(columns["buildings"].sum())),
            ("surface.median", tallies.quantile(0.5), covered),
            ("surface.p95", tallies.quantile(0.95), covered),
            ("surface.rmse", RMSE, covered),
            ("surface.bias", BIAS, covered),
        ),
    )


_PLACES = f"places of a {SAMPLE_M} m lattice on the true roofs"
_DZ = "dz = highest face of all models - true roof"

DEFINITIONS = (
    defined(
        "surface.coverage",
        "true roof with a model over it",
        f"share of the {_PLACES} that a model covers",
    ),
    defined(
        "surface.within_0_2m",
        "true roof within 0.2 m",
        f"share of the {_PLACES} with abs(dz) <= 0.2 m; no model is a miss; {_DZ}",
    ),
    defined(
        "surface.within_0_2m_mean",
        "true roof within 0.2 m, mean of buildings",
        f"mean over the reference buildings of their share with abs(dz) <= 0.2 m; {_DZ}",
    ),
    defined(
        "surface.median",
        "vertical difference, median",
        f"median of abs(dz) over covered {_PLACES}; {_DZ}",
        Better.LOWER,
        "m",
    ),
    defined(
        "surface.p95",
        "vertical difference, 95th percentile",
        f"95th percentile of abs(dz) over covered {_PLACES}; {_DZ}",
        Better.LOWER,
        "m",
    ),
    defined(
        "surface.rmse",
        "vertical difference, RMSE",
        f"sqrt(mean(dz^2)) over covered {_PLACES}; {_DZ}",
        Better.LOWER,
        "m",
    ),
    defined("surface.bias", "vertical difference, mean", f"mean(dz) over covered {_PLACES}; {_DZ}", Better.ZERO, "m"),
)
"""The measures."""
