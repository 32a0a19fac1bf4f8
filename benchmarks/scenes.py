"""Measures scenes split into buildings: the real tiles without their classes, and cities with truth.

    python -m benchmarks.scenes real --out DIR [--data ../shared/data] [--tiles delft_west hd ...] [--settings FILE]
    python -m benchmarks.scenes suites --out DIR [--split dev|test] [--jobs 2] [--page docs/results/scenes.md]

`real` reads each tile as if it had no classes, runs ingest, split and join in this process, draws the outline of every
candidate as for its model, and compares: by area on the raster of class 6 with and without the ring at its
edges, by objects of at least 16 m2, and under given footprints by IoU and area of blocks of touching ones.
Nothing is modelled, so it takes seconds. DIR/real.md holds the tables, DIR/TILE.md what is missed and wrong one by
one, DIR/TILE.png a picture: green found, red missed, blue false. `suites` is described in `benchmarks/scene_suites.py`.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import shapely

from benchmarks.candidates import FoundScene, found_scene
from benchmarks.entries import markdown_table
from benchmarks.results_page import filled
from benchmarks.scene_pictures import draw_scene
from benchmarks.scene_scores import (
    OBJECT_M2,
    DetectionScore,
    FootprintScore,
    detected,
    footprint_score,
    houses_alone,
    is_whole,
    outlined_models,
    touching_united,
)
from benchmarks.scene_suites import (
    DENSITIES,
    SLOPES_DEG,
    SuiteScene,
    draw_scores,
    known_scores,
    measure_cities,
    suite_tables,
)
from pipeline.io import ReadOptions, open_source
from pipeline.ruler.evaluation.detection import Detection
from pipeline.ruler.evaluation.footprints import FootprintRow
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.evaluation.reference_points import read_points_reference
from pipeline.settings import RunSettings, read_table


@dataclasses.dataclass(frozen=True, kw_only=True)
class RealScene:
    """Real tiles that are read together."""

    name: str
    """On the command line."""
    files: tuple[str, ...]
    """Below the data folder."""
    crs: str | None = None
    """Where the files tell none."""
    footprints: str | None = None
    """Given outlines below the data folder."""
    unjudged: tuple[float, float, float, float] | None = None
    """x_min, y_min, x_max, y_max of a building that the file leaves unclassified: no model there is right or wrong."""
    has_buildings: bool = True
    """Whether the files have class 6 to compare with; without it there is a picture alone."""


DELFT_CRS = "EPSG:7415"
PLOT = "scenes.png"
SCENES = (
    RealScene(name="delft_west", files=("ahn3/delft_west.laz",), crs=DELFT_CRS),
    RealScene(name="delft_east", files=("ahn3/delft_east.laz",), crs=DELFT_CRS),
    RealScene(
        name="delft",
        files=("ahn3/delft_west.laz", "ahn3/delft_east.laz"),
        crs=DELFT_CRS,
        footprints="ahn3/footprints.gpkg",
    ),
    RealScene(name="hd", files=("ign/hd_770500_6277500.laz",)),
    RealScene(name="hdf", files=("ign/hdf_870000_6617100.laz",), unjudged=(870210.0, 6617086.0, 870234.0, 6617109.0)),
    RealScene(name="csite2", files=("isprs/CSite2_orig-utm.laz",), has_buildings=False),
    RealScene(name="autzen", files=("oregon/autzen_trim.las",), has_buildings=False),
    *(
        RealScene(name=f"samp{number}", files=(f"isprs/samp{number}-utm.laz",), has_buildings=False)
        for number in (11, 21, 23, 31, 41, 51, 61)
    ),
)
"""The real scenes by name; those with buildings are the default."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneResult:
    """The outcome on one scene."""

    name: str
    found: FoundScene
    models: Sequence[RoofModel]
    reference: Reference
    detection: Detection | None = None
    score: DetectionScore | None = None
    footprints: Mapping[str, FootprintScore] = dataclasses.field(default_factory=dict)
    """Over sets of blocks, by what they are."""
    unclassified_covered: float = math.nan
    """Share of the place of an unclassified building that models cover."""
    blocks: Sequence[tuple[FootprintRow, bool]] = ()
    """The rows of all blocks, and whether each is whole."""
    houses: int = 0
    """Given footprints of at least 16 m2, one by one."""
    houses_alone: float = math.nan
    """Share of them that one model stands for."""
    given: Sequence[shapely.Geometry] = ()
    seconds: Mapping[str, float] = dataclasses.field(default_factory=dict)


def _points_alone(paths: Sequence[str], crs: str | None) -> Reference:
    """Points without reference buildings, for a picture."""
    sources = [open_source(path, ReadOptions(crs=crs)) for path in paths]

    def read(path: str) -> ReferencePoints:
        found = next(iter(open_source(path, ReadOptions(crs=crs)).chunks(1 << 30)))
        none = found.classification.astype("int32")
        return ReferencePoints(
            name=path, xyz=found.xyz, classification=none * 0, building=none * 0 - 1, face=none * 0 - 1,
            is_roof=none < 0, last=found.return_number >= found.return_count,
        )  # fmt: skip

    return Reference(
        name=", ".join(paths),
        kind="points",
        buildings=(),
        has_faces=False,
        outlines="raster",
        tiles=tuple(lambda path=path: read(path) for path in paths),  # type: ignore[misc]
        bounds=tuple((*s.info.bounds_m[:2], *s.info.bounds_m[3:5]) for s in sources),
    )


def measure_real(scene: RealScene, data: Path, settings: RunSettings) -> SceneResult:
    """Split one real scene and compare."""
    paths = [str(data / name) for name in scene.files]
    found = found_scene(paths, scene.crs, settings)
    began = time.perf_counter()
    models = outlined_models(found.candidates, settings.building.roof)
    seconds = {**found.seconds, "outlines": time.perf_counter() - began}
    if not scene.has_buildings:
        reference = _points_alone(paths, scene.crs)
        return SceneResult(name=scene.name, found=found, models=models, reference=reference, seconds=seconds)
    reference = read_points_reference(paths, crs=scene.crs)
    covered = math.nan
    if scene.unjudged is not None and reference.extent is not None:
        place = shapely.box(*scene.unjudged)
        reference = dataclasses.replace(reference, extent=reference.extent.difference(place))
        covered = shapely.union_all([model.footprint for model in models]).intersection(place).area / place.area
    detection, score = detected(models, reference)
    result = SceneResult(
        name=scene.name,
        found=found,
        models=models,
        reference=reference,
        detection=detection,
        score=score,
        seconds=seconds,
        unclassified_covered=covered,
    )
    if scene.footprints is None:
        return result
    given = read_points_reference(paths, crs=scene.crs, footprints=data / scene.footprints)
    united = touching_united(given)
    whole = is_whole(united, [building.footprint for building in united.buildings])
    large = [building.footprint.area >= OBJECT_M2 for building in united.buildings]
    rows = footprint_score(models, united, whole)[1]
    sets = {
        f"blocks >= {OBJECT_M2:g} m2": large,
        f"whole blocks >= {OBJECT_M2:g} m2": [a and b for a, b in zip(large, whole, strict=True)],
        "all blocks": [True] * len(whole),
    }
    houses, alone = houses_alone(models, given)
    return dataclasses.replace(
        result,
        houses=houses,
        houses_alone=alone,
        footprints={label: footprint_score(models, united, chosen)[0] for label, chosen in sets.items()},
        blocks=list(zip(rows, whole, strict=True)),
        given=[building.footprint for building in given.buildings],
    )


# ------------------------------------------------------------------------------------------------------------- tables


def cell(value: float, digits: int = 3) -> str:
    """A figure of a table; nothing for nan."""
    return "" if math.isnan(value) else f"{value:.{digits}f}"


DETECTION_HEADS = (
    "area compl.",
    "area corr.",
    "compl. without ring",
    "corr. without ring",
    f"objects >= {OBJECT_M2:g} m2",
    "compl.",
    f"models >= {OBJECT_M2:g} m2",
    "corr.",
    "objects with those cut by the edge",
    "compl.",
    "models",
    "corr.",
)


def detection_cells(score: DetectionScore) -> list[str]:
    """A detection under `DETECTION_HEADS`."""
    return [
        cell(score.completeness),
        cell(score.correctness),
        cell(score.completeness_without_ring),
        cell(score.correctness_without_ring),
        str(score.objects),
        cell(score.object_completeness),
        str(score.models),
        cell(score.object_correctness),
        str(score.objects_with_edge),
        cell(score.object_completeness_with_edge),
        str(score.models_with_edge),
        cell(score.object_correctness_with_edge),
    ]


def real_tables(results: Sequence[SceneResult]) -> str:
    """The figures of all scenes."""
    detection = [
        [result.name, *detection_cells(result.score), f"{sum(result.seconds.values()):.1f}"]
        for result in results
        if result.score is not None
    ]
    text = markdown_table(["tile", *DETECTION_HEADS, "s"], detection)
    lines, notes = [], []
    for result in results:
        for label, score in result.footprints.items():
            lines.append(
                [
                    f"{result.name}, {label}",
                    str(score.blocks),
                    str(score.models),
                    cell(score.iou),
                    f"{100 * score.area_bias:+.1f} %",
                    f"{100 * score.area_bias_total:+.1f} %",
                    f"{score.offset_m:+.3f} m",
                ]
            )
        if result.houses:
            notes.append(
                f"\n{result.name}: {100 * result.houses_alone:.0f} % of {result.houses} given footprints of at least "
                f"{OBJECT_M2:g} m2 have a model of their own (IoU >= 0.5, one to one).\n"
            )
        if not math.isnan(result.unclassified_covered):
            notes.append(
                f"\n{result.name}: models cover {result.unclassified_covered:.2f} of the box around the house that the "
                "file leaves unclassified.\n"
            )
    heads = ["footprints", "blocks", "units", "IoU median", "area bias median", "of the sum", "offset"]
    return "".join((text, "\n" + markdown_table(heads, lines) if lines else "", *notes))


def details(result: SceneResult) -> str:
    """What is missed and wrong on one scene, object by object, the largest first."""
    text = [f"# {result.name}\n"]
    stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in result.seconds.items())
    text.append(
        f"{result.found.points} points, {len(result.found.candidates)} candidates, {len(result.models)} outlines, "
        f"{len(result.found.rejected)} rejected, {result.found.small_fragments} small fragments; {stages}\n"
    )
    if result.detection is not None:
        footprints = [building.footprint for building in result.reference.buildings]
        missed = [
            [
                _place(footprints[row.building]),
                f"{row.area_m2:.0f}",
                cell(row.overlap, 2),
                _reasons(result, row.building),
            ]
            for row in sorted(result.detection.buildings, key=lambda row: -row.area_m2)
            if row.counts and not row.found and row.area_m2 >= OBJECT_M2
        ]
        text.append("## Missed\n\n" + markdown_table(["place", "m2", "covered", "rejected there"], missed))
        of_model = {model.building_id: model.footprint for model in result.models}
        wrong = [
            [_place(of_model[row.name]), f"{row.area_m2:.0f}", cell(row.overlap, 2), row.name]
            for row in sorted(result.detection.models, key=lambda row: -row.area_m2)
            if row.counts and not row.found and row.area_m2 >= OBJECT_M2
        ]
        text.append("## Wrong\n\n" + markdown_table(["place", "m2", "on the reference", "id"], wrong))
    if result.blocks:
        rows = [
            [
                row.building_id,
                "yes" if whole else "no",
                f"{row.area_m2:.0f}",
                str(row.models_over),
                cell(row.iou_together, 2),
                cell(row.iou, 2),
            ]
            for row, whole in sorted(result.blocks, key=lambda item: -item[0].area_m2)
        ]
        text.append("## Blocks\n\n" + markdown_table(["block", "whole", "m2", "models", "IoU", "IoU 1:1"], rows))
    return "\n".join(text)


def _place(geometry: shapely.Geometry) -> str:
    inside = shapely.point_on_surface(geometry)
    return f"{inside.x:.0f} {inside.y:.0f}"


def _reasons(result: SceneResult, building: int) -> str:
    """Why the rejected objects around a reference building were rejected, the largest three."""
    x0, y0, x1, y1 = (1000.0 * value for value in result.reference.buildings[building].footprint.bounds)
    near = [
        site
        for site in result.found.rejected
        if site.box_mm[0] < x1 and site.box_mm[2] > x0 and site.box_mm[1] < y1 and site.box_mm[3] > y0
    ]
    largest = sorted(near, key=lambda site: -site.area_m2)[:3]
    return "; ".join(f"{site.area_m2:.0f} m2 {site.verdict.reason.value}: {site.verdict.detail}" for site in largest)


# ------------------------------------------------------------------------------------------------------ command line


def scenes_named(names: Sequence[str]) -> Iterator[RealScene]:
    """The scenes of some names; all that have buildings for none."""
    known = {scene.name: scene for scene in SCENES}
    strangers = [name for name in names if name not in known]
    if strangers:
        raise SystemExit(f"no scenes are named {', '.join(strangers)}: use {', '.join(known)}")
    yield from (known[name] for name in names) if names else (scene for scene in SCENES if scene.has_buildings)


def run_real(arguments: argparse.Namespace) -> int:
    """Measure real tiles."""
    table = {**read_table(arguments.settings), "classes": "ignore"}
    settings = RunSettings.from_mapping(table)
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = []
    for scene in scenes_named(arguments.tiles):
        absent = [name for name in scene.files if not (arguments.data / name).exists()]
        if absent:
            print(f"{scene.name}: {', '.join(absent)} is not in {arguments.data}", file=sys.stderr)
            continue
        result = measure_real(scene, arguments.data, settings)
        results.append(result)
        (arguments.out / f"{scene.name}.md").write_text(details(result), encoding="utf-8")
        if not arguments.no_pictures:
            path = arguments.out / f"{scene.name}.png"
            draw_scene(path, scene.name, result.models, result.reference, result.given)
        print(f"{scene.name}: {', '.join(f'{name} {seconds:.1f} s' for name, seconds in result.seconds.items())}")
    text = real_tables(results)
    (arguments.out / "real.md").write_text(text, encoding="utf-8")
    print(f"\n{text}")
    return int(not results)


def run_suites(arguments: argparse.Namespace) -> int:
    """Measure cities."""
    scenes = [
        SuiteScene(slope_deg=slope, density_per_m2=density)
        for slope in arguments.slopes
        for density in arguments.densities
    ]
    if arguments.known:
        scores = known_scores(arguments.split, arguments.out, scenes)
    else:
        scores = measure_cities(scenes, arguments.split, arguments.out, arguments.jobs)
    if not scores:
        print(f"nothing was measured in {arguments.out / arguments.split}", file=sys.stderr)
        return 1
    text = suite_tables(scores, arguments.split)
    (arguments.out / "scenes.md").write_text(text, encoding="utf-8")
    draw_scores(scores, arguments.out / PLOT)
    print(f"\n{text}")
    return 0


def fill_page(page: Path, out: Path) -> None:
    """Put what was measured into the page, and the pictures beside it; parts that were not measured stay."""
    page.write_text(filled(page.read_text(encoding="utf-8"), out)[0], encoding="utf-8")
    for name in (PLOT, "delft.png"):
        if (out / name).exists():
            pictures = page.parent / "pictures"
            pictures.mkdir(exist_ok=True)
            shutil.copyfile(out / name, pictures / (name if name == PLOT else f"scenes_{name}"))


def main(words: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    real = kinds.add_parser("real", help="the real tiles, read without their classes")
    real.add_argument("--out", type=Path, required=True)
    real.add_argument("--data", type=Path, default=Path("../shared/data"))
    real.add_argument("--tiles", nargs="*", default=[], help=", ".join(scene.name for scene in SCENES))
    real.add_argument("--settings", help="a TOML file with a [settings] table")
    real.add_argument("--no-pictures", action="store_true")
    real.set_defaults(run=run_real)
    suites = kinds.add_parser("suites", help="cities with truth over slopes and densities")
    suites.add_argument("--out", type=Path, required=True)
    suites.add_argument("--split", choices=("dev", "test"), default="dev")
    suites.add_argument("--slopes", type=float, nargs="*", default=list(SLOPES_DEG), metavar="DEG")
    suites.add_argument("--densities", type=float, nargs="*", default=list(DENSITIES), metavar="D")
    suites.add_argument("--jobs", type=int, default=2, help="scenes at a time; 0: in this process")
    suites.add_argument("--known", action="store_true", help="tables and plots of what was measured before")
    suites.set_defaults(run=run_suites)
    for kind in (real, suites):
        kind.add_argument("--page", type=Path, help="fill in this page of results, such as docs/results/scenes.md")
    arguments = parser.parse_args(words)
    result: int = arguments.run(arguments)
    if arguments.page is not None:
        fill_page(arguments.page, arguments.out)
    return result


if __name__ == "__main__":
    sys.exit(main())
