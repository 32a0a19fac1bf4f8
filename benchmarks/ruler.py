"""The whole report: every suite and every real tile, reconstructed as a user would and measured by the ruler.

    python benchmarks/ruler.py --out DIR [--data ../shared/data] [--split test] [--only hofmann310 delft]

For each entry of the table below: `gablework simulate` (suites), `gablework reconstruct`, `gablework evaluate --out`;
DIR/<entry>/report holds the page, the Markdown and the tables. DIR/report.md then holds one line an entry, DIR/sweep.md
the planes of at least 10 m2 by density and noise. What is there already is not done again: delete it to repeat it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from pipeline.synthetic.sweep import DENSITIES_PER_M2, NOISES_M, cell_name

GABLEWORK = str(Path(sys.executable).with_name("gablework"))
CUBES = 20
"""Draws of the cube: it is one building."""

SHOWN = (
    ("delivery.lod2", "delivered"),
    ("detection.area_completeness_without_ring", "area compl."),
    ("detection.area_correctness_without_ring", "area corr."),
    ("faces.completeness_10m2", "faces compl."),
    ("faces.correctness_10m2", "faces corr."),
    ("roof_types.correct", "correct"),
    ("roof_types.passable", "passable"),
    ("roof_types.accuracy", "type"),
    ("footprints.iou_median", "IoU"),
    ("residuals.within_0_2m", "within 0.2 m"),
    ("residuals.within_0_2m_top_visible", "top within"),
    ("residuals.rmse", "RMSE"),
    ("ground.total", "ground total"),
    ("ground.kappa", "ground kappa"),
    ("validity.solids_valid", "valid"),
)
"""Measures of the overview, with their column heads."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of the overview."""

    name: str
    """Also its folder."""
    tiles: tuple[Path, ...] = ()
    """What is reconstructed; of a simulated scene what `scene` holds."""
    scene: Path | None = None
    """Folder of the simulated scene."""
    simulate: tuple[str, ...] = ()
    """Arguments of `simulate`, where the scene is not there yet."""
    run_options: tuple[str, ...] = ()
    """Of `reconstruct`."""
    reference: tuple[str, ...] = ()
    """Options of `evaluate`."""


def gablework(*arguments: str | Path) -> dict[str, Any]:
    """Run the console command; the JSON document that it prints."""
    command = [GABLEWORK, *(str(argument) for argument in arguments), "--json"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\nexit code {done.returncode}\n{done.stderr[-3000:]}")
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def suites(out: Path, split: str) -> Iterator[Entry]:
    """The suites."""
    scenes = out / "scenes"
    serial = ("--workers", "0")
    for draw in range(CUBES):
        arguments = ("cube", "--split", split, "--draw", str(draw))
        yield Entry(name=f"cube-{draw:02d}", scene=scenes / f"cube-{draw:02d}", simulate=arguments, run_options=serial)
    for suite in ("hofmann310", "city"):
        yield Entry(name=suite, scene=scenes / suite, simulate=(suite, "--split", split))
    for density in DENSITIES_PER_M2:
        for noise in NOISES_M:
            arguments = ("sweep", "--split", split, "--density", f"{density:g}", "--noise", f"{noise:g}")
            yield Entry(
                name=f"sweep-{cell_name(density, noise)}",
                scene=scenes / "sweep" / cell_name(density, noise),
                simulate=arguments,
                run_options=serial,
            )


def real_tiles(data: Path) -> Iterator[Entry]:
    """The real tiles, with what each has as reference."""
    ahn = ("--crs", "EPSG:7415")
    west, east = data / "ahn3" / "delft_west.laz", data / "ahn3" / "delft_east.laz"
    outlines = ("--footprints", str(data / "ahn3" / "footprints.gpkg"))
    both = ("--points", str(west), "--points", str(east))
    yield Entry(
        name="delft-footprints",
        tiles=(west, east),
        run_options=(*ahn, *outlines, "--classes", "trust"),
        reference=(*ahn, *outlines, *both),
    )
    for classes in ("trust", "ignore"):
        options = (*ahn, "--classes", classes)
        yield Entry(name=f"delft-{classes}", tiles=(west, east), run_options=options, reference=(*ahn, *both))
        for tile in ("hdf_870000_6617100", "hd_770500_6277500"):
            path = data / "ign" / f"{tile}.laz"
            reference = ("--points", str(path))
            yield Entry(
                name=f"{tile}-{classes}", tiles=(path,), run_options=("--classes", classes), reference=reference
            )
    for path in sorted((data / "isprs").glob("samp*-utm.laz")):
        yield Entry(
            name=path.stem.removesuffix("-utm"),
            tiles=(path,),
            run_options=("--classes", "ignore"),
            reference=("--points", str(path)),
        )
    yield Entry(name="CSite2", tiles=(data / "isprs" / "CSite2_orig-utm.laz",), run_options=("--classes", "ignore"))
    yield Entry(name="autzen_trim", tiles=(data / "oregon" / "autzen_trim.las",), run_options=("--classes", "ignore"))


def is_finished(run_dir: Path) -> bool:
    """Whether a run is there, whole."""
    manifest = run_dir / "run.json"
    return manifest.exists() and json.loads(manifest.read_text(encoding="utf-8"))["status"] == "finished"


def measured(entry: Entry, out: Path) -> list[dict[str, Any]]:
    """Reconstruct and evaluate one entry; its measures."""
    folder = out / entry.name
    table = folder / "report" / "measures.parquet"
    if not table.exists():
        started = time.perf_counter()
        tiles = [str(tile) for tile in entry.tiles]
        reference = entry.reference
        if entry.scene is not None:
            if not (entry.scene / "truth" / "scene.json").exists():
                target = entry.scene.parent if entry.simulate[0] == "sweep" else entry.scene
                gablework("simulate", *entry.simulate, "--out", target)
            tiles = sorted(str(path) for path in [*entry.scene.glob("*.laz"), *entry.scene.glob("tiles/*.laz")])
            reference = ("--truth", str(entry.scene / "truth"), "--as-surveyed")
        if not is_finished(folder / "run"):
            gablework("reconstruct", *tiles, "--out", folder / "run", "--overwrite", *entry.run_options)
        gablework("evaluate", folder / "run", *reference, "--out", folder / "report")
        print(f"{entry.name}: {time.perf_counter() - started:.0f} s", flush=True)
    rows: list[dict[str, Any]] = pq.read_table(table).to_pylist()
    return rows


def run_facts(folder: Path) -> list[str]:
    """Candidates by status, seconds, and peak memory of the largest process, as the run's own record has them."""
    manifest = json.loads((folder / "run" / "run.json").read_text(encoding="utf-8"))
    counts = manifest["counts"]
    statuses = "/".join(str(counts[name]) for name in ("ok", "fallback", "failed"))
    peak = max(manifest["peak_memory_bytes"].values(), default=0) / 1e6
    return [statuses, f"{manifest['timings_s']['total']:.1f}", f"{peak:.0f}"]


def figure(row: dict[str, Any] | None) -> str:
    """A measure as a cell."""
    if row is None or row["value"] is None or math.isnan(row["value"]):
        return ""
    return f"{row['value']:.3f} m" if row["unit"] == "m" else f"{row['value']:.3f}"


def cell(rows: Sequence[dict[str, Any]], name: str) -> str:
    """The figure of one measure over all buildings."""
    return figure(next((row for row in rows if row["name"] == name and row["subset"] == "all"), None))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def sweep_table(results: dict[str, list[dict[str, Any]]]) -> str:
    """Quality of the planes of at least 10 m2: densities down, noises across."""
    cells = {}
    for name, rows in results.items():
        if name.startswith("sweep-"):
            density, noise = name.removeprefix("sweep-d").split("_n")
            cells[float(density), float(noise)] = cell(rows, "faces.quality_10m2")
    noises = sorted({noise for _, noise in cells})
    lines = [
        [f"{density:g}", *(cells.get((density, noise), "") for noise in noises)]
        for density in sorted({density for density, _ in cells})
    ]
    return table(["pulses a m2", *(f"{noise:g} m of noise" for noise in noises)], lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--only", nargs="*", default=None, help="beginnings of the names of entries")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, list[dict[str, Any]]] = {}
    wanted = tuple(arguments.only) if arguments.only is not None else ("",)
    for source in (suites(arguments.out, arguments.split), real_tiles(arguments.data)):
        for entry in source:
            if entry.name.startswith(wanted) and all(tile.exists() for tile in entry.tiles):
                results[entry.name] = measured(entry, arguments.out)
    overview = table(
        ["entry", "ok/block/failed", "s", "peak MB", *(head for _, head in SHOWN)],
        [
            [name, *run_facts(arguments.out / name), *(cell(rows, measure) for measure, _ in SHOWN)]
            for name, rows in results.items()
        ],
    )
    (arguments.out / "report.md").write_text(overview, encoding="utf-8")
    (arguments.out / "sweep.md").write_text(sweep_table(results), encoding="utf-8")
    print(overview)
    print(sweep_table(results))


if __name__ == "__main__":
    main()
