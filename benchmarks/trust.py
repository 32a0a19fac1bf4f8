"""Which models of a run are wrong, and whether their status says so: the suite `trust`, held against its truth.

    python -m benchmarks.trust --out DIR [--split dev|test] [--draws 3] [--kinds houses glass] [--jobs 2] [--feet]
    python -m benchmarks.trust --runs RUN ...

Makes the scenes of the suite below DIR/SPLITn, models each with default settings, its classes ignored and, where they
were written, trusted, and judges every model. A model is wrong if it is not of a building: true buildings lie under
less than half of it. It is wrong as well if less than 70 % of the true roofs under it lie within 0.2 m of it
vertically (0.4 m under 2 pulses per m2), or less than 70 % of the roof of the true building that it stands for; of a
building that is divided into several models they count together. Areas are in plan. In strips that disagree the truth
may be at any elevation between the two.

With `--feet`, the scenes of 4 and 6 pulses per m2 are modelled from copies in feet instead, into DIR/SPLIT_feet.*, and
judged in metres.

DIR/SPLIT.parquet has a row per model: scene, survey, classes, the judgement, and the columns of the record.
DIR/SPLIT_rejected.parquet has the rejected objects, DIR/SPLIT.json and DIR/SPLIT.md the tables.

`--runs` has no truth: of finished runs it counts the models that lie on their points, at least 90 % of their roof
returns within 0.2 m (`share_within_0_2m`), and those of them that are not `ok`, by reason.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import json
import multiprocessing
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import shapely
from laspy.vlrs.known import WktCoordinateSystemVlr

from benchmarks.entries import markdown_table, modelled
from benchmarks.trust_judge import Truth, top_of
from pipeline.export.geoparquet import read_table
from pipeline.model import Status
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import Cell
from pipeline.ruler.simulation.trust import CELLS, KINDS

TOLERANCE_M, SPARSE_TOLERANCE_M, SPARSE_PER_M2 = 0.2, 0.4, 2.0
FOOT_M = 0.3048
"""The international foot."""
FITTED_SHARE = 0.9
"""Share of the roof returns within 0.2 m from which on a model lies on its points."""
SURVEYS_IN_FEET = ("d4_five", "d6_last")


def tolerance_of(cell: Cell) -> float:
    """The vertical tolerance of a survey."""
    return SPARSE_TOLERANCE_M if cell.density_per_m2 < SPARSE_PER_M2 else TOLERANCE_M


# ------------------------------------------------------------------------------------------------------------- runs


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """One run of one scene."""

    kind: str
    survey: str
    classes: str
    draw: int
    models: pa.Table
    """A row per record: the columns of `Judgement`, null without a model, and those of the record."""
    rejected: pa.Table
    """A row per rejected object, with `is_building`."""
    buildings: int
    """True buildings."""
    without_model: int
    """Those of which models cover less than half."""


def judge_run(
    models_dir: Path, truth_dir: Path, cell: Cell, classes: str, draw: int, *, in_feet: bool = False
) -> Judged:
    """Hold a run directory against the truth of its scene."""
    truth = Truth(read_models(truth_dir).models)
    found = read_models(models_dir).models
    tolerance, top = tolerance_of(cell), top_of(found)
    judgements = {
        model.building_id: dataclasses.asdict(truth.judge(model, tolerance, cell.strip_step_m, top)) for model in found
    }
    survey = f"{cell.survey}_feet" if in_feet else cell.survey
    scene = {"scene": cell.kind, "survey": survey, "classes": classes, "draw": draw}
    records = read_table(str(models_dir), "buildings")
    records = records.select([name for name in records.column_names if not name.startswith("solid")])
    rows = [judgements.get(name, {}) for name in records.column("building_id").to_pylist()]
    rejected = read_table(str(models_dir), "rejected")
    boxes = [None if box is None else shapely.from_wkb(box) for box in rejected.column("geometry").to_pylist()]
    if in_feet:
        boxes = [None if box is None else shapely.transform(box, lambda xy: xy * FOOT_M) for box in boxes]
    return Judged(
        kind=cell.kind,
        survey=survey,
        classes=classes,
        draw=draw,
        models=_with_columns(records, scene, rows, JUDGED),
        rejected=_with_columns(rejected, scene, [{"is_building": truth.is_building(box)} for box in boxes], REJECTED),
        buildings=len(truth.buildings),
        without_model=len(truth.without_model(found)),
    )


SCENE = pa.schema([("scene", pa.string()), ("survey", pa.string()), ("classes", pa.string()), ("draw", pa.int32())])
JUDGED = pa.schema(
    [
        ("right", pa.bool_()),
        ("wrong_because", pa.string()),
        ("covered_share", pa.float64()),
        ("share_under", pa.float64()),
        ("share_of_building", pa.float64()),
        ("share_together", pa.float64()),
        ("true_building", pa.string()),
        ("true_area_m2", pa.float64()),
    ]
)
REJECTED = pa.schema([("is_building", pa.bool_())])


def _with_columns(
    records: pa.Table, scene: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], schema: pa.Schema
) -> pa.Table:
    """Records behind the columns of their scene and their judgements."""
    fields = [*SCENE, *schema]
    columns = [pa.array([{**scene, **row}.get(field.name) for row in rows], field.type) for field in fields]
    return pa.table([*columns, *records.columns], names=[*(field.name for field in fields), *records.column_names])


def crs_in_feet(crs: pyproj.CRS) -> pyproj.CRS:
    """A compound CRS in metres with feet on all axes, so that a place has the same coordinates over `FOOT_M`."""
    changed = crs.to_json_dict()
    changed.pop("id", None)
    for part in changed["components"]:
        part.pop("id", None)
        part["name"] += " (ft)"
        for axis in part["coordinate_system"]["axis"]:
            axis["unit"] = {"type": "LinearUnit", "name": "foot", "conversion_factor": FOOT_M}
    return pyproj.CRS.from_json_dict(changed)


def write_in_feet(metres: Path, feet: Path) -> None:
    """Write a copy of a LAZ file whose coordinates are in feet, to 0.001 ft, and whose compound CRS says so."""
    las = laspy.read(metres)
    header = laspy.LasHeader(version=las.header.version, point_format=las.header.point_format)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(las.header.offsets / FOOT_M)
    header.global_encoding.gps_time_type = las.header.global_encoding.gps_time_type
    header.global_encoding.wkt = True
    crs = las.header.parse_crs()
    assert crs is not None
    header.vlrs.append(WktCoordinateSystemVlr(crs_in_feet(crs).to_wkt("WKT1_GDAL")))
    copy = laspy.LasData(header)
    for name in set(las.point_format.dimension_names) - {"X", "Y", "Z"}:
        copy[name] = las[name]
    for axis in "xyz":
        setattr(copy, axis, np.asarray(las[axis]) / FOOT_M)
    copy.write(feet)


def run_cell(task: tuple[Cell, Path, int, bool]) -> list[Judged]:
    """Model a scene with its classes ignored, and trusted if it has any, and judge both; the last says: in feet."""
    cell, place, draw, in_feet = task
    found = []
    laz = place / "trust.laz"
    if in_feet:
        laz = place / "trust_feet.laz"
        write_in_feet(place / "trust.laz", laz)
    for classes in ("ignore", "trust") if cell.with_classes else ("ignore",):
        out = place / f"models-{classes}{'-feet' if in_feet else ''}"
        modelled(laz, out, classes=classes, meshes="none")
        found.append(judge_run(out, place / "truth", cell, classes, draw, in_feet=in_feet))
    return found


def run_split(
    split: str, draws: int, kinds: Sequence[str], out: Path, jobs: int, *, in_feet: bool = False
) -> list[Judged]:
    """Make, model and judge all scenes of some draws."""
    tasks = []
    for draw in range(draws):
        place = out / f"{split}{draw}"
        if not (place / "sweep.json").exists():
            simulate("trust", place, seed_of(split, draw))
        cells = [cell for cell in CELLS if cell.kind in kinds and (not in_feet or cell.survey in SURVEYS_IN_FEET)]
        tasks += [(cell, place / cell.key, draw, in_feet) for cell in cells]
    if jobs < 2:
        return [one for task in tasks for one in run_cell(task)]
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        return [one for some in pool.map(run_cell, tasks) for one in some]


def fitted_row(name: str, records: Sequence[Mapping[str, Any]]) -> list[str]:
    """The row of a run with these records in the table of `--runs`."""
    models = [record for record in records if record["status"] != Status.FAILED]
    fitted = [model for model in models if (model["share_within_0_2m"] or 0.0) >= FITTED_SHARE]
    others = collections.Counter(model["reason"] for model in fitted if model["status"] != Status.OK)
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(others.items()))
    share = f"{_ratio(others.total(), len(fitted)):.1%}" if fitted else ""
    return [name, str(len(models)), str(len(fitted)), str(others.total()), share, reasons]


# ----------------------------------------------------------------------------------------------------------- tables


@dataclasses.dataclass(frozen=True, kw_only=True)
class Counts:
    """The models of some runs."""

    right: Mapping[str, int]
    """Right models by status."""
    wrong: Mapping[str, int]
    """Wrong models by status."""
    buildings: int
    without_model: int
    rejected_buildings: int

    @property
    def wrong_ok(self) -> float:
        """Share of the wrong models that are `ok`; nan without any."""
        return _ratio(self.wrong.get(Status.OK, 0), sum(self.wrong.values()))

    @property
    def right_not_ok(self) -> float:
        """Share of the right models that are not `ok`; nan without any."""
        return _ratio(sum(self.right.values()) - self.right.get(Status.OK, 0), sum(self.right.values()))


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def counted(runs: Iterable[Judged]) -> Counts:
    """The counts of some runs together."""
    right, wrong = collections.Counter[str](), collections.Counter[str]()
    buildings = without = rejected = 0
    for one in runs:
        for status, is_right in zip(
            one.models.column("status").to_pylist(), one.models.column("right").to_pylist(), strict=True
        ):
            if is_right is not None:
                (right if is_right else wrong)[status] += 1
        buildings += one.buildings
        without += one.without_model
        rejected += sum(one.rejected.column("is_building").to_pylist())
    return Counts(
        right=dict(right), wrong=dict(wrong), buildings=buildings, without_model=without, rejected_buildings=rejected
    )


def table(groups: Mapping[str, Counts]) -> str:
    """A row per group."""
    statuses = sorted(
        {status for one in groups.values() for status in (*one.right, *one.wrong)} | {str(Status.OK)},
        key=lambda one: (one != Status.OK, one),
    )
    heads = [*(f"right, {status}" for status in statuses), *(f"wrong, {status}" for status in statuses)]
    rows = []
    for name, one in groups.items():
        counts = [one.right.get(status, 0) for status in statuses] + [one.wrong.get(status, 0) for status in statuses]
        shares = [one.wrong_ok, one.right_not_ok]
        others = [one.buildings, one.without_model, one.rejected_buildings]
        rows.append([name, *map(str, counts), *("" if s != s else f"{s:.1%}" for s in shares), *map(str, others)])
    shares = ["wrong that are ok", "right that are not ok"]
    return markdown_table(["", *heads, *shares, "buildings", "without a model", "rejected buildings"], rows)


def grouped(runs: Sequence[Judged]) -> dict[str, dict[str, Counts]]:
    """The counts by kind of scene, by survey and by both, for classes ignored and trusted."""
    tables: dict[str, dict[str, Counts]] = {}
    for classes in ("ignore", "trust"):
        some = [one for one in runs if one.classes == classes]
        names = {
            "scene": lambda one: one.kind,
            "survey": lambda one: one.survey,
            "scene and survey": lambda one: f"{one.kind} {one.survey}",
        }
        for what, name in names.items():
            keys = dict.fromkeys(map(name, some))
            tables[f"{classes}, by {what}"] = {
                **{key: counted(one for one in some if name(one) == key) for key in keys},
                "all": counted(some),
            }
    tables["all"] = {"all": counted(runs)}
    return tables


def write(runs: Sequence[Judged], out: Path, name: str) -> str:
    """Write the tables; returns their text without that by scene and survey."""
    pq.write_table(pa.concat_tables([one.models for one in runs]), out / f"{name}.parquet", compression="zstd")
    pq.write_table(pa.concat_tables([one.rejected for one in runs]), out / f"{name}_rejected.parquet")
    tables = grouped(runs)
    document = {
        title: {
            key: {**dataclasses.asdict(one), "wrong_ok": one.wrong_ok, "right_not_ok": one.right_not_ok}
            for key, one in groups.items()
        }
        for title, groups in tables.items()
    }
    (out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    texts = {title: f"## {title}\n\n{table(groups)}\n" for title, groups in tables.items()}
    (out / f"{name}.md").write_text("\n".join(texts.values()), encoding="utf-8")
    return "\n".join(text for title, text in texts.items() if "and survey" not in title)


def main(words: Sequence[str] | None = None) -> int:
    """Make, model, judge, write and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--runs", nargs="+", type=Path, help="finished runs without truth")
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--kinds", nargs="*", choices=tuple(KINDS), default=tuple(KINDS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--feet", action="store_true", help="model copies of some surveys that are in feet")
    given = parser.parse_args(words)
    if given.runs:
        columns = ["status", "reason", "share_within_0_2m"]
        records = {run.name: read_table(str(run), "buildings").select(columns).to_pylist() for run in given.runs}
        heads = ["run", "models", "on their points", "of these not ok", "share", "reasons"]
        print(markdown_table(heads, [fitted_row(*item) for item in records.items()]))
        return 0
    if given.out is None:
        parser.error("give --out or --runs")
    given.out.mkdir(parents=True, exist_ok=True)
    runs = run_split(given.split, given.draws, given.kinds, given.out, given.jobs, in_feet=given.feet)
    print(write(runs, given.out, f"{given.split}_feet" if given.feet else given.split))
    return 0


if __name__ == "__main__":
    sys.exit(main())
