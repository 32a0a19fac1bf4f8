"""Scores on real data that settings were chosen on, and on data that no setting was chosen on.

    python -m benchmarks.unseen --out DIR [--data ../shared/data] [--only ground classes forest wireframes]
                                [--kept-aside] [--page docs/results/unseen.md]

Kept aside are the ISPRS samples 22 and 42. Without `--kept-aside` they are never read; with it only they are measured.
The commands run as a user runs them, with the default settings, classes ignored.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import itertools
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import laspy
import numpy as np
import shapely

from benchmarks.entries import fill_page, markdown_table, modelled
from benchmarks.ground import DATA, measured, product_filter, samples
from benchmarks.thinned_surveys import thinned, write_changed
from pipeline.export.geoparquet import read_table
from pipeline.extras.classify.classify import ClassifyRequest, classify
from pipeline.model import BoolArray, Status
from pipeline.ruler.evaluation.evaluate import evaluate
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reading.wireframe_files import read_wireframes
from pipeline.runtime.resources import SERIAL
from pipeline.scene import BUILDING_CLASS
from pipeline.settings import RunSettings
from pipeline.terrain.terrain_settings import GroundSettings

PARTS = ("ground", "classes", "forest", "wireframes")
IGN_CRS = "EPSG:2154"
DELFT_CRS = "EPSG:7415"
UNJUDGED = {"hdf": (870210.0, 6617086.0, 870234.0, 6617109.0)}
"""x_min, y_min, x_max, y_max of a building that the file of a tile leaves unclassified."""
THINNED_PER_M2 = (0.3, 0.5)
SPARSE = "more/ign/sparse_0382_6565.laz"
FOREST = "more/ign/forest_0906_6665.laz"
TALLINN = "more/building3d"
TALLINN_CRS = "EPSG:3301"
TOLERANCES = ("0_3m", "0_5m", "1m")
"""Tolerances of edges and corners, as in the names of the measures."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tile:
    """A tile with class 6 of its own."""

    name: str
    file: str
    """Below the data folder."""
    crs: str


TILES = (
    Tile(name="hd_770550", file="more/ign/hd_770550_6277600.laz", crs=IGN_CRS),
    Tile(name="hd_770500", file="ign/hd_770500_6277500.laz", crs=IGN_CRS),
    Tile(name="hdf", file="ign/hdf_870000_6617100.laz", crs=IGN_CRS),
    Tile(name="delft_west", file="ahn3/delft_west.laz", crs=DELFT_CRS),
    Tile(name="delft_east", file="ahn3/delft_east.laz", crs=DELFT_CRS),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassScore:
    """Class 6 of a result beside class 6 of the file, in points."""

    right: int
    said: int
    true: int

    @property
    def shares(self) -> tuple[float, float, float]:
        """Intersection over union, recall, precision."""
        union = self.said + self.true - self.right
        return self.right / max(union, 1), self.right / max(self.true, 1), self.right / max(self.said, 1)

    def row(self, name: str) -> list[str]:
        """A row of the table."""
        return [name, str(self.true), *(f"{share:.3f}" for share in self.shares)]


def judged_points(name: str, las: laspy.LasData) -> BoolArray:
    """The points to compare: all except those in a building that the file leaves unclassified."""
    place = UNJUDGED.get(name)
    if place is None:
        return np.ones(len(las.x), np.bool_)
    inside: BoolArray = shapely.contains_xy(shapely.box(*place), np.asarray(las.x), np.asarray(las.y))
    return ~inside


def class_score(name: str, tile: Path, crs: str, out: Path) -> ClassScore:
    """Classify one tile without its classes, and compare."""
    settings = RunSettings.from_mapping({"classes": "ignore"})
    classify(
        ClassifyRequest(inputs=(str(tile),), out=str(out), settings=settings, crs=crs, resources=SERIAL, overwrite=True)
    )
    before, after = laspy.read(tile), laspy.read(out / tile.name)
    judged = judged_points(name, before)
    true = (np.asarray(before.classification) == BUILDING_CLASS)[judged]
    said = (np.asarray(after.classification) == BUILDING_CLASS)[judged]
    return ClassScore(right=int((true & said).sum()), said=int(said.sum()), true=int(true.sum()))


def thinned_to(per_m2: float) -> Callable[[laspy.LasData], laspy.LasData]:
    """The change that leaves about so many points per square metre of the extent."""

    def change(las: laspy.LasData) -> laspy.LasData:
        area = float(np.ptp(las.x) * np.ptp(las.y))
        return thinned(per_m2 * area / len(las.x))(las)

    return change


def class_table(data: Path, out: Path) -> str:
    """Class 6 per point."""
    found = out / "classes" / "found"
    rows = [class_score(t.name, data / t.file, t.crs, found).row(t.name) for t in TILES]
    rows.append(class_score("", data / SPARSE, IGN_CRS, found).row("sparse_0382"))
    sparse: list[ClassScore] = []
    for per_m2, tile in itertools.product(THINNED_PER_M2, TILES):
        (path,) = write_changed([data / tile.file], out / "classes" / f"{per_m2:g}", thinned_to(per_m2))
        sparse.append(class_score(tile.name, path, tile.crs, found))
        rows.append(sparse[-1].row(f"{tile.name}, {per_m2:g} per m2"))
    means = [statistics.fmean(column) for column in zip(*(score.shares for score in sparse), strict=True)]
    rows.append(["**mean of the thinned**", "", *(f"**{mean:.3f}**" for mean in means)])
    return markdown_table(["tile", "points of class 6", "IoU", "recall", "precision"], rows)


def ground_table(data: Path, *, kept_aside: bool) -> str:
    """The ISPRS filter test."""
    figures = measured(list(samples(data, kept_aside=kept_aside)), product_filter(GroundSettings()))
    rows = [[f.name, *(f"{v:.2f}" for v in (f.type_1, f.type_2, f.total)), f"{f.kappa:.1f}"] for f in figures]
    total, kappa = (statistics.fmean(getattr(f, name) for f in figures) for name in ("total", "kappa"))
    rows.append(["**mean**", "", "", f"**{total:.2f}**", f"**{kappa:.1f}**"])
    return markdown_table(["sample", "type I, %", "type II, %", "total error, %", "kappa, %"], rows)


def forest_table(data: Path, out: Path) -> str:
    """What a forest without buildings becomes."""
    rows = []
    for classes in ("ignore", "trust"):
        place = out / "forest" / classes
        modelled(data / FOREST, place, classes=classes, crs=IGN_CRS)
        status = collections.Counter(read_table(str(place), "buildings").column("status").to_pylist())
        rejected = read_table(str(place), "rejected").num_rows
        rows.append([classes, *(str(status[one]) for one in Status), str(rejected)])
    return markdown_table(["classes", *Status, "rejected"], rows)


def wireframe_table(data: Path, out: Path) -> str:
    """Roof edges and corners beside those that people drew, with outlines and without."""
    place, rows = data / TALLINN, []
    wireframes = read_wireframes(place / "wireframes.json")
    for name, footprints in (("given", str(place / "outlines.geojson")), ("found", None)):
        models = out / "tallinn" / f"models-{name}"
        modelled(place / "tallinn.laz", models, classes="trust", footprints=footprints, crs=TALLINN_CRS)
        measures = {m.name: m for m in evaluate(read_models(models), wireframes=wireframes).measures}
        for what in ("edge", "corner"):
            found = [measures[f"wireframes.{what}_f1_{tolerance}"] for tolerance in TOLERANCES]
            rows.append([name, f"{what}s, F1", *(f"{m.value:.3f} ({m.low:.2f} to {m.high:.2f})" for m in found)])
    return markdown_table(["outlines", "", "within 0.3 m", "0.5 m", "1 m"], rows)


def tables(data: Path, out: Path, only: Sequence[str], *, kept_aside: bool) -> Iterator[tuple[str, str]]:
    """Names and text of the tables."""
    made: dict[str, Callable[[], str]] = {
        "ground": lambda: ground_table(data, kept_aside=kept_aside),
        "classes": lambda: class_table(data, out),
        "forest": lambda: forest_table(data, out),
        "wireframes": lambda: wireframe_table(data, out),
    }
    for name, make in made.items():
        if name in only and (name == "ground" or not kept_aside):
            yield f"{name}-{'unseen' if kept_aside else 'chosen'}.md", make()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, and fill in the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--kept-aside", action="store_true", help="the data that no setting was chosen on")
    parser.add_argument("--page", type=Path, help="fill in this page of results")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    for name, text in tables(given.data, given.out, given.only, kept_aside=given.kept_aside):
        (given.out / name).write_text(text, encoding="utf-8")
        print(f"{name}\n\n{text}", flush=True)
    if given.page is not None:
        fill_page(given.page, given.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
