"""Outlines of the suite `outline_shapes` beside their true ones, and whether they are as exact as their record states.

    python -m benchmarks.outline_shapes --out DIR [--split dev|test] [--draws 10] [--jobs 2] [--baseline CHECKOUT]

A draw is a scene with five buildings of each shape under several surveys. What models cover of a building is held
against it: IoU (0 where nothing is found), corners one to one within max(0.5 m, 0.7 spacings), and the mean angle
between a true edge and the nearest found one within 45 degrees. `--baseline` models the scenes with another checkout
as well; the change of IoU is over the buildings that both found, with its standard error.

The second table judges `outline_sigma_m`: the mean distance of each true edge of 2 m and more, across its direction,
to the nearest found edge within 15 degrees. An edge without one, or with one beyond max(1 m, 2 spacings), is missed: it
counts as beyond any sigma, and in the quantiles, but not in the RMS.

DIR/SPLIT.json has a row per building. Runs that are there already are not repeated: delete them after a change of code.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from benchmarks.entries import Entry, markdown_table
from benchmarks.survey_runs import ROOT, run_survey
from pipeline.export.geoparquet import read_table
from pipeline.extras.compare.compare import Variant
from pipeline.model import FloatArray
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.wireframe_scores import matched_corners
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.outline_shapes import CELLS, SIGMA_PER_M2, SPACINGS_M
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import Cell
from pipeline.settings import RunSettings

SIGMA = "outline_sigma_m"
NAN = math.nan
GAP_M, STRAIGHT_M, STEP_M, TURN_DEG = 0.15, 0.01, 0.25, 10.0
"""Half the gap between models that is closed, simplification, distance of samples on edges, least turn at a corner."""
ANGLE_DEG, PARALLEL_DEG, LEAST_EDGE_M = 45.0, 15.0, 2.0
QUANTILES = (0.25, 0.5, 0.68, 0.9)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """What models of one checkout cover of a building."""

    code: str = ""
    shape: str = ""
    building: str = ""
    per_m2: float = NAN
    iou: float = 0.0
    right: int = 0
    """Found corners within the tolerance of true ones."""
    found: int = 0
    true: int = 0
    angle_deg: float = NAN
    edges: tuple[tuple[float, float, float], ...] = ()
    """Of each true edge: length, distance of the found one, positive outwards (nan if missed), sigma (nan without)."""


def edges_of(outline: shapely.Geometry) -> FloatArray:
    """The edges (n, 2, 2) of an area, which is on their left."""
    oriented = shapely.orient_polygons(shapely.force_2d(outline))
    rings = map(shapely.get_coordinates, shapely.get_rings(shapely.get_parts(oriented)))
    return np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])


def nearest(places: FloatArray, way: FloatArray, edges: FloatArray, most_deg: float) -> tuple[FloatArray, ...]:
    """Of places (n, 2) on an edge along `way`: the nearest of some edges, how far to the right, and the angle to it.

    Only edges within `most_deg` of its direction count; distance and angle are nan without one.
    """
    along = edges[:, 1] - edges[:, 0]
    length = np.maximum(np.hypot(*along.T), 1e-9)
    angles = np.degrees(np.arccos(np.clip(np.abs(along @ way) / length, 0.0, 1.0)))
    away = places[:, None] - edges[:, 0]
    to = np.clip(np.sum(away * along, axis=2) / length**2, 0.0, 1.0)[:, :, None] * along - away
    distance = np.where(angles <= most_deg, np.hypot(to[:, :, 0], to[:, :, 1]), np.inf)
    best = distance.argmin(axis=1)
    chosen = (np.arange(len(places)), best)
    is_there = np.isfinite(distance[chosen])
    return best, np.where(is_there, to[chosen] @ (way[1], -way[0]), NAN), np.where(is_there, angles[best], NAN)


def corners_of(outline: shapely.Geometry) -> FloatArray:
    """Corners (n, 2) that turn by more than `TURN_DEG`."""
    found, simple = [np.zeros((0, 2))], shapely.simplify(outline, STRAIGHT_M)
    for ring in map(shapely.get_coordinates, shapely.get_rings(shapely.get_parts(simple))):
        along = np.diff(ring, axis=0)
        along /= np.hypot(*along.T)[:, None]
        found.append(ring[:-1][np.sum(along * np.roll(along, 1, axis=0), axis=1) < math.cos(math.radians(TURN_DEG))])
    return np.concatenate(found)


def closed(outlines: Iterable[shapely.Geometry]) -> shapely.Geometry:
    """Areas as one, without the small gaps between them."""
    wide = shapely.union_all(shapely.buffer(list(outlines), GAP_M, join_style="mitre"))
    return shapely.make_valid(shapely.buffer(wide, -GAP_M, join_style="mitre"))


def judged(
    true: shapely.Geometry, models: Sequence[shapely.Geometry], sigmas: Sequence[float], per_m2: float
) -> Judged:
    """A building beside the models that lie over it, with their sigmas."""
    if not models:
        return Judged()
    found, spacing_m = closed(models), 1.0 / math.sqrt(per_m2)
    parts = [edges_of(model) for model in models]
    every, sigma = np.concatenate(parts), np.repeat(sigmas, [len(part) for part in parts])
    edges, angles, weights = [], [], []
    for start, end in edges_of(true):
        length = math.dist(start, end)
        count, way = max(1, round(length / STEP_M)), (end - start) / length
        places = start + (np.arange(count)[:, None] + 0.5) / count * (end - start)
        angles.append(nearest(places, way, every, ANGLE_DEG)[2])
        weights += [length / count] * count
        if length >= LEAST_EDGE_M:
            best, off, _ = nearest(places, way, every, PARALLEL_DEG)
            distance = float(np.abs(off).mean())
            off_m = math.copysign(distance, off.mean()) if distance <= max(1.0, 2.0 * spacing_m) else NAN
            edges.append((length, off_m, float(sigma[best].mean())))
    angle, has = np.concatenate(angles), np.isfinite(np.concatenate(angles))
    corners = corners_of(found), corners_of(true)
    return Judged(
        iou=shapely.area(shapely.intersection(found, true)) / shapely.area(shapely.union(found, true)),
        right=int(matched_corners(*corners, max(0.5, 0.7 * spacing_m))[0].sum()),
        found=len(corners[0]),
        true=len(corners[1]),
        angle_deg=float(np.average(angle[has], weights=np.array(weights)[has])) if has.any() else NAN,
        edges=tuple(edges),
    )


def judged_run(run: Path, truth: Path, per_m2: float) -> Iterator[Judged]:
    """All buildings of a scene; touching houses count as one."""
    rows = read_table(str(run), "buildings").to_pylist()
    rows = [row for row in rows if row["geometry"] and row["status"] != "failed"]
    plans = np.array([shapely.from_wkb(row["geometry"]) for row in rows], dtype=object)
    houses = sorted(read_models(truth).models, key=lambda house: str(house.source_id))
    for name, block in itertools.groupby(houses, lambda house: str(house.source_id)):
        true = closed(house.footprint for house in block)
        over = np.flatnonzero(shapely.area(shapely.intersection(plans, true)) > 0.5 * shapely.area(plans))
        sigmas = [NAN if (sigma := rows[k].get(SIGMA)) is None else sigma for k in over]
        found = judged(true, list(plans[over]), sigmas, per_m2)
        yield dataclasses.replace(found, shape=name.rpartition("-")[0], building=name, per_m2=per_m2)


def measured(split: str, draws: int, out: Path, codes: dict[str, Path], jobs: int) -> list[Judged]:
    """Make, model and judge all scenes of some draws, with every checkout."""
    variant = Variant(method=RunSettings().general.method)
    for draw in range(draws):
        if not (out / f"{split}{draw}" / "sweep.json").exists():
            simulate("outline_shapes", out / f"{split}{draw}", seed_of(split, draw))

    def one(task: tuple[int, Cell, str]) -> list[Judged]:
        draw, cell, code = task
        folder = out / f"{split}{draw}" / cell.key
        run = folder / f"models-{code}"
        if not (run / "run.json").exists():
            entry = Entry(name=folder.name, tiles=(folder / "outline_shapes.laz",), classes="ignore")
            run_survey(entry, variant, run, codes[code])
        found = judged_run(run, folder / "truth", cell.density_per_m2)
        return [dataclasses.replace(row, code=code, building=f"{draw}-{row.building}") for row in found]

    with ThreadPoolExecutor(jobs) as pool:
        return [row for rows in pool.map(one, itertools.product(range(draws), CELLS, codes)) for row in rows]


def grouped(rows: Sequence[Judged], key: Callable[[Judged], Any]) -> list[tuple[Any, list[Judged]]]:
    """The rows by a key, in its order."""
    return [(value, list(some)) for value, some in itertools.groupby(sorted(rows, key=key), key)]


def cell(value: float | np.floating[Any], form: str = ".3f") -> str:
    """A figure; empty for nan."""
    return "" if math.isnan(value) else f"{value:{form}}"


def figures(rows: Sequence[Judged]) -> list[str]:
    """Found, IoU, corners and angle of some buildings of one code."""
    seen = [row for row in rows if row.iou > 0.0]
    if not seen:
        return [f"0 of {len(rows)}", "0.000", "", "", "", ""]
    right, found, true = (sum(getattr(row, name) for row in seen) for name in ("right", "found", "true"))
    mean, median = np.mean([row.iou for row in rows]), np.median([row.iou for row in seen])
    counts, angle = f"{found / len(seen):.1f} / {true / len(seen):.1f}", np.nanmean([row.angle_deg for row in seen])
    f1 = cell(2 * right / (found + true) if true else NAN)
    return [f"{len(seen)} of {len(rows)}", cell(mean), cell(median), f1, counts, cell(angle, ".1f")]


def shape_table(rows: Sequence[Judged], code: str, baseline: str) -> str:
    """A line per spacing and shape; with a baseline its figures follow those of the code."""
    before = {(row.building, row.per_m2): row for row in rows if row.code == baseline}
    chosen = [row for row in rows if row.code == code and row.per_m2 in SPACINGS_M]
    lines = []
    for (per_m2, shape), own in grouped(chosen, lambda row: (-row.per_m2, row.shape)):
        line = [f"{SPACINGS_M[-per_m2]:g}", shape, *figures(own)]
        if before:
            others = [before[row.building, row.per_m2] for row in own]
            change = [row.iou - old.iou for row, old in zip(own, others, strict=True) if min(row.iou, old.iou) > 0.0]
            error = np.std(change) / math.sqrt(max(len(change), 1)) if change else NAN
            line += [f"{np.mean(change):+.3f} ± {error:.3f}" if change else "", *figures(others)]
        lines.append(line)
    heads = ["found", "IoU, mean", "median", "corners, F1", "found / true", "angle, deg"]
    more = ["change of IoU", *(f"{baseline}: {head}" for head in heads)] if before else []
    return markdown_table(["spacing, m", "shape", *heads, *more], lines)


def sigma_cells(rows: Sequence[Judged]) -> list[str]:
    """Shares of true edges within one sigma, and the distances."""
    length, off, sigma = np.array([edge for row in rows for edge in row.edges]).reshape(-1, 3).T
    if not len(length):
        return ["0"] + [""] * (6 + len(QUANTILES))
    distance, known, shares = np.where(np.isfinite(off), np.abs(off), np.inf), np.isfinite(sigma), [NAN] * 3
    if known.any():
        within = (distance <= sigma)[known]
        shares = [within.mean(), np.average(within, weights=length[known]), np.median(sigma[known])]
    spread = [*np.quantile(distance, QUANTILES, method="lower"), math.sqrt(np.nanmean(off**2))]
    return [str(len(off)), *map(cell, (np.isnan(off).mean(), *shares, np.nanmedian(off), *spread))]


def sigma_table(rows: Sequence[Judged]) -> str:
    """A line per density, one per shape, and all."""
    chosen = [row for row in rows if row.per_m2 in SIGMA_PER_M2 and row.iou > 0.0]
    lines = [[f"{per_m2:g} per m2", *sigma_cells(some)] for per_m2, some in grouped(chosen, lambda row: row.per_m2)]
    lines += [[shape, *sigma_cells(some)] for shape, some in grouped(chosen, lambda row: row.shape)]
    heads = ["", "edges", "missed", "within sigma", "by length", "median sigma", "outwards, median"]
    heads += [*(f"{share:.0%} within, m" for share in QUANTILES), "RMS, m"]
    return markdown_table(heads, [*lines, ["all", *sigma_cells(chosen)]])


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--baseline", type=Path, help="another checkout of this repository")
    given = parser.parse_args()
    codes = {path.name: path for path in (ROOT, given.baseline and given.baseline.resolve()) if path}
    rows = measured(given.split, given.draws, given.out.resolve(), codes, given.jobs)
    (given.out / f"{given.split}.json").write_text(json.dumps(list(map(dataclasses.asdict, rows))), encoding="utf-8")
    print(shape_table(rows, ROOT.name, given.baseline.name if given.baseline else ""))
    for code in codes:
        print(f"{code}:\n\n{sigma_table([row for row in rows if row.code == code])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
