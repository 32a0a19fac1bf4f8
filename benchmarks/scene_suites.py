"""Cities with exact truth over slopes and densities, split into buildings and measured as the real tiles are.

    python -m benchmarks.scenes suites --out DIR [--split dev|test] [--jobs 2] [--slopes 0 30] [--densities 1 8]
                                       [--known] [--page docs/results/scenes.md]

A city of 300 m by 300 m is on ground of one slope (0, 10, 20, 30 deg; from 9 deg on only detached houses and parks are
built) and is surveyed with 0.5 to 30 pulses per m2, without classes. Scenes are made once, below DIR/SPLIT. Blocks are
compared: true buildings that touch count as one. The ground is that of the run's filter, judged on last returns. All
scenes use the default settings. DIR/scenes.md holds the tables, DIR/scenes.png the plots, DIR/SPLIT/*.json the
figures; `--known` makes tables and plots from these alone.
"""

from __future__ import annotations

import dataclasses
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from benchmarks.candidates import found_scene
from benchmarks.entries import markdown_table
from benchmarks.scene_pictures import draw_scene
from benchmarks.scene_scores import (
    OBJECT_M2,
    DetectionScore,
    FootprintScore,
    detected,
    footprint_score,
    houses_alone,
    outlined_models,
)
from pipeline.roof.footprint import polygons_of
from pipeline.ruler.evaluation.blocks import joined_reference
from pipeline.ruler.evaluation.ground import GroundOfRun, TileGround, ground_blocks, tile_figures
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.settings import RunSettings

SLOPES_DEG = (0.0, 10.0, 20.0, 30.0)
DENSITIES = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0)
"""Pulses per square metre."""
SIZE_M = (300.0, 300.0)
COVER_M = 4.0
"""Side of the cells that show where the survey saw anything: at 0.5 pulses per m2 eight fall into one."""
PICTURED = ((0.0, 8.0), (30.0, 8.0), (0.0, 1.0), (20.0, 1.0))
"""Slope and density of the scenes that are drawn."""


@dataclasses.dataclass(frozen=True, kw_only=True, order=True)
class SuiteScene:
    """One city."""

    slope_deg: float
    """Slope of its ground."""
    density_per_m2: float
    """Pulses."""

    @property
    def key(self) -> str:
        """Its folder."""
        return f"city_s{self.slope_deg:g}_d{self.density_per_m2:g}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteScore:
    """The figures of one city."""

    scene: SuiteScene
    detection: DetectionScore
    footprints: FootprintScore
    """Over the blocks of at least 16 m2 that the edge of the data does not cut."""
    houses: int
    """Single true houses of at least 16 m2, not cut by the edge."""
    houses_alone: float
    """Share of them that one model stands for, with an IoU of at least one half: rows are split where they are."""
    ground: TileGround
    points: int
    seconds: Mapping[str, float]
    """Wall-clock time of ingest, split, join and outlines."""


def true_scene(scene: SuiteScene, split: str, folder: Path) -> Reference:
    """The truth of a city, as surveyed, its houses one by one; the city is simulated where it is not there yet."""
    place = folder / split / scene.key
    if not (place / "truth" / "scene.json").exists():
        simulate(
            "city",
            place,
            seed_of(split, 0),
            size_m=SIZE_M,
            density_per_m2=scene.density_per_m2,
            slope_deg=scene.slope_deg,
        )
    return where_surveyed(read_truth_reference(place / "truth", as_surveyed=True))


def where_surveyed(reference: Reference, cell_m: float = COVER_M) -> Reference:
    """A reference that is asked for where the survey saw the ground, and whose buildings beyond are cut by its edge.

    Pulses aim at a level plane: on a slope they land beside the extent of the scene on one side, and short of it on the
    other. Covered are the cells with points and what they enclose, less one cell at the edge.
    """
    places = np.concatenate([np.floor(tile.xyz[:, :2] / cell_m).astype(np.int64) for tile in reference.points()])
    cells = cell_m * np.unique(places, axis=0)
    covered = shapely.union_all(shapely.box(cells[:, 0], cells[:, 1], cells[:, 0] + cell_m, cells[:, 1] + cell_m))
    covered = covered.buffer(2 * cell_m, join_style="mitre").buffer(-3 * cell_m, join_style="mitre")
    whole = shapely.union_all([shapely.Polygon(part.exterior) for part in polygons_of(covered)])
    extent = whole if reference.extent is None else whole.intersection(reference.extent)
    buildings = tuple(
        dataclasses.replace(b, touches_data_edge=b.touches_data_edge or not extent.contains(b.footprint))
        for b in reference.buildings
    )
    return dataclasses.replace(reference, buildings=buildings, extent=extent)


def measure_city(scene: SuiteScene, split: str, folder: Path) -> SuiteScore:
    """Split one city and compare."""
    houses = true_scene(scene, split, folder)
    tiles = sorted(str(path) for path in (folder / split / scene.key / "tiles").glob("*.laz"))
    settings = RunSettings.from_mapping({"classes": "ignore"})
    found = found_scene(tiles, None, settings)
    began = time.perf_counter()
    models = outlined_models(found.candidates, settings.building.roof)
    seconds = {**found.seconds, "outlines": time.perf_counter() - began}
    blocks = joined_reference(houses)
    counted = [b.footprint.area >= OBJECT_M2 and not b.touches_data_edge for b in blocks.buildings]
    if (scene.slope_deg, scene.density_per_m2) in PICTURED:
        path = folder / split / f"{scene.key}.png"
        draw_scene(path, scene.key, models, blocks, [building.footprint for building in houses.buildings])
    n_houses, alone = houses_alone(models, houses)
    score = SuiteScore(
        scene=scene,
        detection=detected(models, blocks)[1],
        footprints=footprint_score(models, blocks, counted)[0],
        houses=n_houses,
        houses_alone=alone,
        ground=_ground(houses, settings),
        points=found.points,
        seconds=seconds,
    )
    record = folder / split / f"{scene.key}.json"
    record.write_text(json.dumps(dataclasses.asdict(score), indent=1) + "\n", encoding="utf-8")
    return score


def _ground(reference: Reference, settings: RunSettings) -> TileGround:
    """Ground errors of the run's filter over all points of a city."""
    blocks = ground_blocks(reference, GroundOfRun(reference, settings.scene))
    return tile_figures([dataclasses.replace(block, tile="all") for block in blocks])[0]


# ------------------------------------------------------------------------------------------------- tables and plots

Figure = Callable[[SuiteScore], float]

FIGURES: Mapping[str, tuple[str, Figure]] = {
    "completeness": ("completeness by area", lambda s: s.detection.completeness),
    "correctness": ("correctness by area", lambda s: s.detection.correctness),
    "completeness_inside": ("completeness by area, without the ring", lambda s: s.detection.completeness_without_ring),
    "correctness_inside": ("correctness by area, without the ring", lambda s: s.detection.correctness_without_ring),
    "object_completeness": (f"completeness, blocks >= {OBJECT_M2:g} m2", lambda s: s.detection.object_completeness),
    "object_correctness": (f"correctness, models >= {OBJECT_M2:g} m2", lambda s: s.detection.object_correctness),
    "iou": ("median IoU of blocks", lambda s: s.footprints.iou),
    "area_bias": ("median area bias of blocks, %", lambda s: 100.0 * s.footprints.area_bias),
    "offset": ("median offset of the outlines, m", lambda s: s.footprints.offset_m),
    "houses_alone": ("houses with a model of their own", lambda s: s.houses_alone),
    "ground_total": ("ground: total error, %", lambda s: 100.0 * s.ground.total),
    "ground_kappa": ("ground: kappa, %", lambda s: 100.0 * s.ground.kappa),
}
"""What is shown, by name: its label and its value."""


def suite_table(scores: Iterable[SuiteScore], name: str) -> str:
    """One figure: one row per slope, one column per density."""
    label, figure = FIGURES[name]
    values = {(s.scene.slope_deg, s.scene.density_per_m2): figure(s) for s in scores}
    densities = sorted({density for _, density in values})
    digits = 1 if label.endswith("%") else 3
    rows = []
    for slope in sorted({slope for slope, _ in values}):
        cells = [values.get((slope, density), math.nan) for density in densities]
        rows.append([f"{slope:g} deg", *("" if math.isnan(one) else f"{one:.{digits}f}" for one in cells)])
    return markdown_table([label, *(f"{density:g} per m2" for density in densities)], rows)


def suite_tables(scores: Sequence[SuiteScore], split: str) -> str:
    """All figures."""
    blocks = {s.scene.slope_deg: s.detection.objects for s in scores}
    houses = {s.scene.slope_deg: s.houses for s in scores}
    reported = ", ".join(
        f"{blocks[slope]} blocks of {houses[slope]} houses on {slope:g} deg" for slope in sorted(blocks)
    )
    head = (
        f"`city` of {SIZE_M[0]:g} m x {SIZE_M[1]:g} m, {split} seed {seed_of(split, 0)}: {reported}; pulses per m2.\n"
    )
    return "\n".join((head, *(suite_table(scores, name) for name in FIGURES)))


def draw_scores(scores: Sequence[SuiteScore], path: Path) -> None:
    """The plot: a panel a figure, over the density, a line a slope."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    colours = ("#1b9e77", "#7570b3", "#e6a100", "#d62728")
    slopes = sorted({s.scene.slope_deg for s in scores})
    densities = sorted({s.scene.density_per_m2 for s in scores})
    with mpl.rc_context({"font.size": 8}):
        canvas = Canvas(figsize=(13.0, 9.0), layout="constrained", dpi=90)
        panels = canvas.subplots(3, 4)
        for panel, (name, (label, figure)) in zip(panels.flat, FIGURES.items(), strict=True):
            for slope, colour in zip(slopes, colours * len(slopes), strict=False):
                line = sorted((s for s in scores if s.scene.slope_deg == slope), key=lambda s: s.scene.density_per_m2)
                panel.plot(
                    [s.scene.density_per_m2 for s in line],
                    [figure(s) for s in line],
                    color=colour,
                    marker="o",
                    markersize=3,
                    label=f"{slope:g} deg",
                )
            panel.set_xscale("log")
            panel.set_xticks(densities, [f"{density:g}" for density in densities])
            panel.set_xticks([], minor=True)
            panel.set_title(label, fontsize=9)
            panel.grid(color="#e5e5e5", linewidth=0.6)
            for side in ("top", "right"):
                panel.spines[side].set_visible(False)
            if name in {"area_bias", "offset"}:
                panel.axhline(0.0, color="#999999", linewidth=0.8)
            elif not name.startswith("ground"):
                low = min((figure(s) for s in scores if not math.isnan(figure(s))), default=0.0)
                panel.set_ylim(min(0.7, math.floor(low * 10) / 10), 1.01)
        for panel in panels[-1]:
            panel.set_xlabel("pulses per m2")
        panels[0, 0].legend(frameon=False, loc="lower right")
        path.parent.mkdir(parents=True, exist_ok=True)
        canvas.savefig(path)


def known_scores(split: str, folder: Path, scenes: Sequence[SuiteScene]) -> list[SuiteScore]:
    """What was measured of some cities before, as their records have it; those without a record are left out."""
    found = []
    for scene in sorted(scenes):
        record = folder / split / f"{scene.key}.json"
        if record.exists():
            held = json.loads(record.read_text(encoding="utf-8"))
            held["scene"] = scene
            held["detection"] = DetectionScore(**held["detection"])
            held["footprints"] = FootprintScore(**held["footprints"])
            held["ground"] = TileGround(**held["ground"])
            found.append(SuiteScore(**held))
    return found


def measure_cities(
    scenes: Sequence[SuiteScene], split: str, folder: Path, jobs: int, tell: Callable[[str], Any] = print
) -> list[SuiteScore]:
    """Measure cities, some at a time, the dense ones first; 0 jobs measures in this process."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    (folder / split).mkdir(parents=True, exist_ok=True)
    ordered = sorted(scenes, key=lambda scene: (-scene.density_per_m2, scene.slope_deg))
    scores = []

    def keep(score: SuiteScore) -> None:
        scores.append(score)
        spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in score.seconds.items())
        tell(f"{score.scene.key}: {score.points} points; {spent}")

    if jobs == 0:
        for scene in ordered:
            keep(measure_city(scene, split, folder))
    else:
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
            for waiting in [pool.submit(measure_city, scene, split, folder) for scene in ordered]:
                keep(waiting.result())
    return sorted(scores, key=lambda score: score.scene)
