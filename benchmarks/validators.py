r"""The field's validators on all that is written: `python -m benchmarks.validators --out DIR [--page FILE]`.

    GABLEWORK_VAL3DITY=…/val3dity GABLEWORK_CITYJSON_SCHEMAS=…/schemas \
      python -m benchmarks.validators --out DIR [--data ../shared/data] [--entries suburb delft …] [--page FILE]

Each simulated suite and each real tile is modelled with all levels of detail and with its terrain, and published as
CityJSON. val3dity judges the sequences, the terrain and the published files, with its own tolerances, and the terrain
also with vertices snapped within half a millimetre; the schema of CityJSON 2.0 judges each line and each file. Both are
on no package registry: GABLEWORK_VAL3DITY names the program (2.5 or later), GABLEWORK_CITYJSON_SCHEMAS a folder with
the files `*.schema.json` of its maintainers. Each entry's figures are in DIR/ENTRY/validators.json; what is there is
not made again. DIR/validators.md holds the table. The exit code is 1 if anything is invalid.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jsonschema_rs  # schemathesis brings it: the library of the tests takes minutes for a town

from benchmarks.entries import fill_page, markdown_table
from benchmarks.run_scores import val3dity_report
from pipeline.ruler.simulation.suites import SUITES

SIMULATED = [
    name for name in SUITES if name not in {"sweep", "trust", "outline_shapes", "broken_slopes", "curved_roofs"}
]
SWEEP = {f"sweep-{cell.key}": cell for cell in SUITES["sweep"].cells}
"""The sweep is one scene that is surveyed many times."""
LODS = "1.2,1.3,2.2"
CITIES = {f"city-{split}{draw}": (split, draw) for split in ("dev", "test") for draw in range(2)}
"""Draws of the simulated city, 500 m by 500 m each."""
REAL: Mapping[str, tuple[str, ...]] = {
    "delft": ("ahn3/delft_west.laz", "ahn3/delft_east.laz", "--crs", "EPSG:7415"),
    "delft-footprints": ("ahn3/delft_west.laz", "ahn3/delft_east.laz", "--crs", "EPSG:7415", "--footprints",
                         "ahn3/footprints.gpkg"),
    "hdf": ("ign/hdf_870000_6617100.laz",),
    "hd": ("ign/hd_770500_6277500.laz",),
    "hd-770550": ("more/ign/hd_770550_6277600.laz",),
    "sparse": ("more/ign/sparse_0382_6565.laz",),
    "forest": ("more/ign/forest_0906_6665.laz",),
    "csite2": ("isprs/CSite2_orig-utm.laz",),
    **{f"samp{n}": (f"isprs/samp{n}-utm.laz",) for n in (11, 21, 23, 31, 41, 51, 61)},
    **{f"samp{n}": (f"more/isprs/samp{n}-utm.laz",) for n in (22, 24, 42, 53)},
    "autzen": ("oregon/autzen_trim.las",),
    "tallinn": ("more/building3d/tallinn.laz",),
    "tallinn-footprints": ("more/building3d/tallinn.laz", "--footprints", "more/building3d/outlines.geojson"),
}  # fmt: skip
"""Files below the data folder, and options."""

JUDGED = {
    "models": "faults of models",
    "schema": "of documents",
    "terrain": "of terrain",
    "finely": "of terrain, 0.5 mm",
}
"""What is judged, and how it is called in the table."""
COUNTED = ("buildings", "solids", "triangles", "surfaces", "files", "documents")
"""What is counted: fields of `Figures`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """What the validators say about one entry."""

    buildings: int
    """Buildings in the sequences."""
    solids: int
    """Solids of all levels of detail that val3dity judged there."""
    triangles: int
    """Triangles of the terrain."""
    surfaces: int
    """Surfaces of the terrain that val3dity judged."""
    files: int
    """Published CityJSON files that val3dity judged."""
    documents: int
    """Lines and files that were held against the schema."""
    invalid: Mapping[str, Mapping[str, int]]
    """Faults of `JUDGED` by their code or message."""


def main() -> int:
    """Model, publish, judge; print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--entries", nargs="*", default=[*SIMULATED, *SWEEP, *REAL, *CITIES])
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    val3dity, check = os.environ["GABLEWORK_VAL3DITY"], schema_faults(Path(os.environ["GABLEWORK_CITYJSON_SCHEMAS"]))
    found: dict[str, Figures] = {}
    failed: list[str] = []
    for name in arguments.entries:
        known = arguments.out / name / "validators.json"
        if not known.exists():
            try:
                if not (arguments.out / name / "cityjson").exists():
                    made(name, arguments.out / name, arguments.data)
            except RuntimeError as error:
                print(f"{name}: {error}", file=sys.stderr)
                failed.append(name)
                continue
            figures = judged(arguments.out / name, val3dity, check)
            known.write_text(json.dumps(dataclasses.asdict(figures)), encoding="utf-8")
        found[name] = Figures(**json.loads(known.read_text(encoding="utf-8")))
        print(name, found[name], flush=True)
    (arguments.out / "validators.md").write_text(table(found), encoding="utf-8")
    if arguments.page is not None:
        fill_page(arguments.page, arguments.out)
    return int(bool(failed) or any(faults for figures in found.values() for faults in figures.invalid.values()))


def made(name: str, folder: Path, data: Path) -> None:
    """Simulate an entry if it is not real, model it and publish it."""
    if name in REAL:
        words = [str(data / word) if "/" in word else word for word in REAL[name]]
    else:
        if not (folder / "scene").exists():
            _gablework("simulate", *_scene(name), "--out", str(folder / "scene"))
        words = sorted(map(str, (folder / "scene").rglob("*.laz")))
    run = folder / "run"
    _gablework(
        "reconstruct", *words, "--out", str(run), "--lods", LODS, "--terrain", "tin", "--meshes", "tile", "--overwrite"
    )
    _gablework("publish", str(run), "--as", "cityjson", "--out", str(folder / "cityjson"), "--overwrite")


def _scene(name: str) -> list[str]:
    """What to simulate for an entry."""
    if name in SWEEP:
        cell = SWEEP[name]
        return ["sweep", "--density", f"{cell.density_per_m2:g}", "--noise", f"{cell.noise_m:g}"]
    if name in CITIES:
        split, draw = CITIES[name]
        return ["city", "--split", split, "--draw", str(draw), "--size", "500", "500"]
    return [name]


def _gablework(*words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", *words, "--quiet"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr[-2000:]}")


def judged(folder: Path, val3dity: str, check: Callable[[Mapping[str, Any]], list[str]]) -> Figures:
    """What the validators say about the files of an entry."""
    faults: dict[str, collections.Counter[str]] = {name: collections.Counter() for name in JUDGED}
    counts: collections.Counter[str] = collections.Counter()
    places = {
        "models": sorted(folder.glob("run/cityjson/*/*.city.jsonl")),
        "terrain": sorted(folder.glob("run/terrain/*/*.city.jsonl")),
        "files": sorted(folder.glob("cityjson/*.city.json")),
    }
    for kind, files in places.items():
        for file in files:
            documents = list(read(file))
            counts["documents"] += len(documents)
            faults["schema"].update(fault for document in documents for fault in check(document))
            for thing in (thing for document in documents for thing in document.get("CityObjects", {}).values()):
                if kind != "files":
                    counts["buildings"] += thing["type"] == "Building"
                    counts["triangles"] += sum(len(g["boundaries"]) for g in thing.get("geometry", ())) * (
                        thing["type"] == "TINRelief"
                    )
            report = val3dity_report(file, val3dity)
            counts[kind] += sum(kept["total"] for kept in report["primitives_overview"]) if kind != "files" else 1
            for judged_as, fault in faults_of(report):
                faults[judged_as][fault] += 1
            if kind == "terrain":
                faults["finely"].update(
                    fault for _, fault in faults_of(val3dity_report(file, val3dity, "--snap_tol", "0.0005"))
                )
    return Figures(
        buildings=counts["buildings"],
        solids=counts["models"],
        triangles=counts["triangles"],
        surfaces=counts["terrain"],
        files=counts["files"],
        documents=counts["documents"],
        invalid={name: dict(found) for name, found in faults.items()},
    )


def read(file: Path) -> Iterator[dict[str, Any]]:
    """The objects of a file: its lines, or the one that it is."""
    text = file.read_text(encoding="utf-8")
    return map(json.loads, text.splitlines() if file.suffix == ".jsonl" else [text])


def faults_of(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The faults in a report by their codes, with what they are of; a file that cannot be judged is one of models."""
    yield from (("models", f"{error['code']} {error['description']}") for error in report["dataset_errors"])
    for feature in report["features"]:
        kind = "terrain" if feature["type"] == "TINRelief" else "models"
        yield from ((kind, f"{error['code']} {error['description']}") for error in feature["errors"])
        if not feature["validity"] and not feature["errors"]:
            yield kind, "invalid without a code"


def schema_faults(folder: Path) -> Callable[[Mapping[str, Any]], list[str]]:
    """A function that holds a CityJSON object or feature against the official schema."""
    files = {path.name: json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.schema.json")}
    registry = jsonschema_rs.Registry([(schema["$id"], schema) for schema in files.values()])
    validators = {
        kind: jsonschema_rs.Draft7Validator(files[f"{kind.lower()}.schema.json"], registry=registry)
        for kind in ("CityJSON", "CityJSONFeature")
    }
    return lambda document: [error.message[:100] for error in validators[document["type"]].iter_errors(document)]


def table(found: Mapping[str, Figures]) -> str:
    """The figures as a Markdown table; single roof shapes are one row, and so are the surveys of the sweep."""
    rows: dict[str, list[Figures]] = {}
    for name, figures in found.items():
        is_shape = name in SUITES and SUITES[name].size_m == (40.0, 40.0)
        row = f"sweep, {len(SWEEP)} surveys" if name in SWEEP else "single roof shapes" if is_shape else name
        rows.setdefault(row, []).append(figures)
    lines = [[name, *_summed(parts)] for name, parts in rows.items()]
    lines.append(["**all**", *_summed(list(found.values()))])
    return markdown_table(["data", *COUNTED, *JUDGED.values()], lines)


def _summed(parts: Sequence[Figures]) -> list[str]:
    """The cells of a row."""
    cells = [f"{sum(getattr(part, name) for part in parts):,}" for name in COUNTED]
    for name in JUDGED:
        faults = sum((collections.Counter(part.invalid[name]) for part in parts), collections.Counter[str]())
        cells.append(", ".join(f"{count} of {fault.split()[0]}" for fault, count in sorted(faults.items())) or "0")
    return cells


if __name__ == "__main__":
    sys.exit(main())
