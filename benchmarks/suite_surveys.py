"""Draws of a suite of single buildings under several surveys, modelled with one or two checkouts and judged."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import shapely

from benchmarks.entries import Entry, markdown_table
from benchmarks.survey_runs import ROOT, run_survey
from pipeline.extras.compare.compare import Variant
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import Cell
from pipeline.settings import RunSettings

REQUIRED = Cell(density_per_m2=8.0, noise_m=0.02)
"""The survey of the required figures."""
Line = Callable[[str, Sequence[Any]], list[str]]
"""Makes a line of a table from a name and rows: the name, their number, and a figure for each head."""


def write_outlines(truth: Path, path: Path) -> None:
    """The true outlines as GeoJSON in the CRS of the scene."""
    features = [
        {"type": "Feature", "properties": {"id": one.building_id}, "geometry": shapely.geometry.mapping(one.footprint)}
        for one in read_models(truth).models
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}), encoding="utf-8")


def asked(description: str | None) -> tuple[argparse.Namespace, dict[str, Path]]:
    """The options of a benchmark, and its checkouts by name."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--cells", choices=("all", "required"), default="all")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--given", action="store_true", help="give the true outlines")
    parser.add_argument("--baseline", type=Path, help="another checkout of this repository")
    given = parser.parse_args()
    codes = {path.name: path for path in (ROOT, given.baseline and given.baseline.resolve()) if path}
    if given.baseline and len(codes) == 1:
        parser.error(
            f"--baseline {given.baseline} is called {ROOT.name}, as this checkout: give a folder of another name"
        )
    return given, codes


def measured(
    given: argparse.Namespace,
    codes: dict[str, Path],
    suite: str,
    cells: Sequence[Cell],
    judge: Callable[[Path, Path, Cell], Sequence[Any]],
) -> list[Any]:
    """Make, model and judge all scenes of some draws, with every checkout; the rows are in DIR/SPLIT.json, too.

    `judge` makes the rows of a run, a folder with the truth, and a survey.
    """
    variant, out = Variant(method=RunSettings().general.method), given.out.resolve()
    cells = cells if given.cells == "all" else (REQUIRED,)
    tasks = list(itertools.product(range(given.draws), cells, codes))
    for draw, cell in itertools.product(range(given.draws), cells):
        if not (out / f"{given.split}{draw}" / cell.key / "truth" / "scene.json").exists():
            chosen = {"density_per_m2": cell.density_per_m2, "noise_m": cell.noise_m}
            simulate(suite, out / f"{given.split}{draw}", seed_of(given.split, draw), **chosen)
        if given.given:
            survey = out / f"{given.split}{draw}" / cell.key
            write_outlines(survey / "truth", survey / "outlines.geojson")

    def one(task: tuple[int, Cell, str]) -> list[Any]:
        draw, cell, code = task
        folder = out / f"{given.split}{draw}" / cell.key
        run = folder / f"models-{code}{'-given' if given.given else ''}"
        if not (run / "run.json").exists():
            outlines = folder / "outlines.geojson" if given.given else None
            entry = Entry(name=folder.name, tiles=(folder / f"{suite}.laz",), classes="ignore", footprints=outlines)
            run_survey(entry, variant, run, codes[code])
        labels = {"code": code, "per_m2": cell.density_per_m2, "noise_m": cell.noise_m}
        found = judge(run, folder / "truth", cell)
        return [dataclasses.replace(row, building=f"{draw}-{row.building}", **labels) for row in found]

    with ThreadPoolExecutor(given.jobs) as pool:
        rows = [row for rows in pool.map(one, tasks) for row in rows]
    (out / f"{given.split}.json").write_text(json.dumps(list(map(dataclasses.asdict, rows))), encoding="utf-8")
    return rows


def table(
    rows: Sequence[Any],
    key: Callable[[Any], str],
    heads: Sequence[str],
    line: Callable[[str, Sequence[Any]], list[str]],
) -> str:
    """A line per value of a key, in their order, and one of all."""
    names = list(dict.fromkeys(map(key, rows)))
    lines = [line(name, [row for row in rows if key(row) == name]) for name in names]
    return markdown_table(["", "roofs", *heads], [*lines, line("all", rows)])


def by_checkout(rows: Sequence[Any], codes: dict[str, Path], split: str, heads: Sequence[str], line: Line) -> None:
    """Print the rows of each checkout by survey, and those of the required survey by form."""
    for code in codes:
        own = [row for row in rows if row.code == code]
        required = [row for row in own if (row.per_m2, row.noise_m) == (REQUIRED.density_per_m2, REQUIRED.noise_m)]
        print(f"{code}, {split} seeds, by survey:\n")
        print(table(own, lambda row: f"{row.per_m2:g} per m2, {100 * row.noise_m:g} cm", heads, line))
        print(f"{code}, at {REQUIRED.density_per_m2:g} per m2 and {100 * REQUIRED.noise_m:g} cm, by form:\n")
        print(table(required, lambda row: row.form, heads, line))
