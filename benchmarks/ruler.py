"""Measures all methods on every suite and every real tile.

    python -m benchmarks.ruler --out DIR [--data ../shared/data] [--split test] [--only hofmann310 delft] [--jobs 2]
                               [--methods METHOD[:PRESET] ...] [--no-pages] [--page FILE]

The default is every method with its default settings. An entry of the table below is simulated once (suites), its
candidates are found once, each method models them, and each run is measured; `benchmarks/entries.py` describes the
folders. DIR/methods.md then holds one line per entry and method, without those of the sweep; DIR/sweep.md has one table
per method: the quality of the roof faces of at least 10 m2 by density and noise. Existing results are not computed
again: delete them to repeat them.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.entries import (
    Entry,
    SimulatedScene,
    Workplace,
    all_variants,
    fill_page,
    hofmann_entries,
    markdown_table,
    measure_all,
    sweep_entries,
)
from pipeline.extras.compare.compare import Variant
from pipeline.model import Status
from pipeline.ruler.simulation.seeds import seed_of

QUALITY = "faces.quality_10m2"
"""Measure of the tables of the sweep: TP / (TP + FP + FN)."""
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


def suites(split: str) -> Iterator[Entry]:
    """The suites, the largest first."""
    yield Entry(name="city", scene=SimulatedScene(suite="city", seed=seed_of(split, 0)))
    yield from sweep_entries(split)
    yield from (dataclasses.replace(entry, has_page=True) for entry in hofmann_entries(split, 1))
    yield Entry(name="cube", scene=SimulatedScene(suite="cube", seed=seed_of(split, 0)))


def real_tiles(data: Path) -> Iterator[Entry]:
    """The real tiles that are there, with what each has as reference."""
    crs = "EPSG:7415"
    delft = (data / "ahn3" / "delft_west.laz", data / "ahn3" / "delft_east.laz")
    outlines = data / "ahn3" / "footprints.gpkg"
    entries = [Entry(name="delft-footprints", tiles=delft, crs=crs, footprints=outlines, points=delft)]
    for classes in ("trust", "ignore"):
        entries.append(Entry(name=f"delft-{classes}", tiles=delft, crs=crs, classes=classes, points=delft))
        for tile in ("hdf_870000_6617100", "hd_770500_6277500"):
            path = data / "ign" / f"{tile}.laz"
            entries.append(Entry(name=f"{tile}-{classes}", tiles=(path,), classes=classes, points=(path,)))
    for path in sorted((data / "isprs").glob("samp*-utm.laz")):
        name = path.stem.removesuffix("-utm")
        entries.append(Entry(name=name, tiles=(path,), classes="ignore", points=(path,)))
    entries.append(Entry(name="CSite2", tiles=(data / "isprs" / "CSite2_orig-utm.laz",), classes="ignore"))
    entries.append(Entry(name="autzen_trim", tiles=(data / "oregon" / "autzen_trim.las",), classes="ignore"))
    yield from (entry for entry in entries if all(path.exists() for path in entry.tiles))


def figure(row: Mapping[str, Any] | None) -> str:
    """A measure as a cell."""
    if row is None or row["value"] is None or math.isnan(row["value"]):
        return ""
    return f"{row['value']:.3f} m" if row["unit"] == "m" else f"{row['value']:.3f}"


def cell(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    """The figure of one measure over all buildings."""
    return figure(next((row for row in rows if row["name"] == name and row["subset"] == "all"), None))


def statuses(manifest: Mapping[str, Any]) -> str:
    """Candidates by status."""
    return "/".join(str(manifest["counts"].get(status, 0)) for status in Status)


def methods_table(entries: Sequence[Entry], variants: Sequence[Variant], place: Workplace) -> str:
    """One line per entry and method, without those of the sweep."""
    lines = []
    for entry in (one for one in entries if not one.name.startswith("sweep-")):
        for variant in (one for one in variants if place.is_measured(one, entry)):
            rows = place.table(variant, entry, "measures")
            shown = [cell(rows, name) for name, _ in SHOWN]
            lines.append([entry.name, variant.label, statuses(place.manifest(variant, entry)), *shown])
    return markdown_table(["entry", "method", "ok/doubtful/block/failed", *(head for _, head in SHOWN)], lines)


def sweep_table(qualities: Mapping[tuple[float, float], float]) -> str:
    """Quality of the roof faces of at least 10 m2, by (density, noise): densities down, noises across."""
    noises = sorted({noise for _, noise in qualities})
    lines = [
        [
            f"{density:g}",
            *(f"{qualities[density, noise]:.3f}" if (density, noise) in qualities else "" for noise in noises),
        ]
        for density in sorted({density for density, _ in qualities})
    ]
    return markdown_table(["pulses per m2", *(f"{noise:g} m of noise" for noise in noises)], lines)


def sweep_qualities(variant: Variant, place: Workplace, entries: Sequence[Entry]) -> dict[tuple[float, float], float]:
    """The quality of the cells of the sweep that were measured, by density and noise; 0 where it is undefined."""
    found = {}
    for entry in entries:
        if entry.scene is not None and entry.scene.cell is not None and place.is_measured(variant, entry):
            cell_of = entry.scene.cell
            rows = place.table(variant, entry, "measures")
            value = next(row["value"] for row in rows if row["name"] == QUALITY and row["subset"] == "all")
            found[cell_of.density_per_m2, cell_of.noise_m] = 0.0 if value is None else float(value)
    return found


def parsed_variants(texts: Sequence[str] | None) -> list[Variant]:
    """The methods that a user asks for; by default all with their default settings."""
    return all_variants(with_faithful=False) if not texts else [Variant.parse(text) for text in texts]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--only", nargs="*", default=[""], help="beginnings of the names of entries")
    parser.add_argument("--methods", nargs="*", metavar="METHOD[:PRESET]", help="default: all methods")
    parser.add_argument("--jobs", type=int, default=2, help="entries at a time")
    parser.add_argument("--no-pages", action="store_true", help="tables only")
    parser.add_argument("--page", type=Path, help="fill in this page of results")
    arguments = parser.parse_args()
    variants, place = parsed_variants(arguments.methods), Workplace(root=arguments.out)
    entries = [
        dataclasses.replace(entry, has_page=entry.has_page and not arguments.no_pages)
        for source in (real_tiles(arguments.data), suites(arguments.split))
        for entry in source
        if entry.name.startswith(tuple(arguments.only))
    ]
    faults = measure_all([(entry, variants) for entry in entries], place, arguments.jobs)
    overview = methods_table(sorted(entries, key=lambda entry: entry.scene is None), variants, place)
    (place.root / "methods.md").write_text(overview, encoding="utf-8")
    swept = {variant.label: sweep_qualities(variant, place, entries) for variant in variants}
    tables = [f"## {label}\n\n{sweep_table(qualities)}" for label, qualities in swept.items() if qualities]
    (place.root / "sweep.md").write_text("\n".join(tables), encoding="utf-8")
    print(overview, *tables, sep="\n")
    if arguments.page is not None:
        fill_page(arguments.page, place.root)
    print("\n".join(faults), file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
