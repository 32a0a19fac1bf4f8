"""Outlines without given footprints against the truth, and on Delft against surveyed facades and the eaves themselves.

    python -m benchmarks.outlines sweep --out DIR [--split dev|test] [--outline eaves|walls]
    python -m benchmarks.outlines beams --out DIR [--split dev|test] [--outline eaves|walls]
    python -m benchmarks.outlines delft [--data ../shared/data] [--outline eaves|walls]

`sweep` draws the outlines of the sweep's scenes over densities and noises, `beams` those of a city of 200 m by 200 m
surveyed with beams of several radii, along and across the streets. The classes of the points are used, so little
except the outlines is judged. Blocks of true buildings that touch are compared, from 16 m2 on.

`delft` compares walls: along every straight facade of the given footprints of 5 m or more, how far outside it the
outline lies, and where the split pulses lie: those that met a roof and came back from below as well lie on a band
about the edge of the roof, so their mean is where the eave is, however the outline was drawn. With `--outline walls` it
also reports how much of the outlines has facade points that show the wall.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import shapely

from benchmarks.candidates import found_scene
from benchmarks.entries import markdown_table
from benchmarks.scene_scores import OBJECT_M2, footprint_score, outlined_models
from pipeline.errors import BuildingError
from pipeline.geometry import top_visible
from pipeline.model import BoolArray, FloatArray
from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.block import block_plane
from pipeline.roof.edge_position import EdgePoints, mixed_pulse_reach_mm
from pipeline.roof.facades import eave_of
from pipeline.roof.footprint import polygons_of
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.ruler.evaluation.blocks import joined_reference
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.simulation.city import CITY_SCANNER
from pipeline.ruler.simulation.dataset import Output, simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.suites import SUITES
from pipeline.ruler.simulation.sweep import DENSITIES_PER_M2, NOISES_M, cell_name
from pipeline.scene import BUILDING_CLASS
from pipeline.settings import RunSettings

BEAM_RADII_M = (0.05, 0.12, 0.25, 0.4)
AZIMUTHS_DEG = (90.0, 30.0)
CITY_DENSITIES = (1.0, 4.0, 12.0)
CITY_SIZE_M = (200.0, 200.0)

_TOUCH_M = 0.3
_MIN_WALL_M = 5.0
_STEP_M = 0.5
_REACH_M = 1.2
_END_M = 0.7
_BAND_M = 0.35
_FEWEST_SPLIT = 6


def drawn(tiles: list[str], outline: str, crs: str | None = None) -> list[RoofModel]:
    """The outlines of the candidates of some tiles, at the eaves or at the walls."""
    settings = RunSettings.from_mapping({"classes": "trust", "roof": {"outline": outline}})
    return outlined_models(found_scene(tiles, crs, settings).candidates, settings.building.roof)


def compared(folder: Path, outline: str) -> list[str]:
    """Figures of one simulated scene, as cells of a table."""
    tiles = sorted(str(path) for path in folder.rglob("*.laz"))
    blocks = joined_reference(read_truth_reference(folder / "truth", as_surveyed=True))
    counted = [b.footprint.area >= OBJECT_M2 and not b.touches_data_edge for b in blocks.buildings]
    score, _ = footprint_score(drawn(tiles, outline), blocks, counted)
    return [
        str(score.blocks),
        f"{score.iou:.3f}",
        f"{100.0 * score.area_bias:+.1f} %",
        f"{100.0 * score.area_bias_total:+.1f} %",
        f"{score.offset_m:+.3f} m",
    ]


FIGURES = ["blocks", "IoU median", "area bias median", "of the sum", "offset median"]


def sweep_rows(out: Path, split: str, outline: str) -> Iterator[list[str]]:
    """A row a density and noise."""
    for density in DENSITIES_PER_M2:
        for noise in NOISES_M:
            folder = out / split / cell_name(density, noise)
            if not (folder / "sweep.json").exists():
                simulate(
                    "sweep",
                    folder,
                    seed_of(split, 0),
                    density_per_m2=density,
                    noise_m=noise,
                    output=Output(with_classes=True),
                )
            yield [f"{density:g}", f"{noise:.2f}", *compared(folder / cell_name(density, noise), outline)]


def beam_rows(out: Path, split: str, outline: str) -> Iterator[list[str]]:
    """A row a beam radius, flight direction and density."""
    for radius in BEAM_RADII_M:
        for azimuth in AZIMUTHS_DEG:
            for density in CITY_DENSITIES:
                folder = out / split / f"city_r{radius:g}_a{azimuth:g}_d{density:g}"
                if not (folder / "truth" / "scene.json").exists():
                    survey = dataclasses.replace(
                        CITY_SCANNER,
                        beam_radius_m=radius,
                        flight_azimuth_deg=azimuth,
                        pulse_density_per_m2=density,
                        strip_shift_m=0.0,
                    )
                    city = dataclasses.replace(SUITES["city"], scanner=survey)
                    simulate(city, folder, seed_of(split, 0), size_m=CITY_SIZE_M, output=Output(with_classes=True))
                yield [f"{radius:g}", f"{azimuth:g}", f"{density:g}", *compared(folder, outline)]


# ------------------------------------------------------------------------------------------------------------ delft


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wall:
    """One straight facade of a given footprint."""

    length_m: float
    outline_m: float
    """Median distance of the outline, positive outside the facade."""
    eave_m: float
    """Mean distance of the split pulses at the outline, see there; nan where they are few."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitPulses:
    """Roof points, (n, 2), and which of them are of pulses that went on."""

    xy: FloatArray
    split: BoolArray


def roof_pulses(tiles: list[str]) -> SplitPulses:
    """Points of class 6 that see the sky."""
    parts: list[FloatArray] = []
    splits: list[BoolArray] = []
    for tile in tiles:
        read = laspy.read(tile)
        building = np.array(read.classification) == BUILDING_CLASS
        parts.append(np.column_stack((read.x, read.y, read.z))[building])
        splits.append(((np.array(read.return_number) == 1) & (np.array(read.number_of_returns) > 1))[building])
    xyz, split = np.concatenate(parts), np.concatenate(splits)
    visible = top_visible(xyz - np.floor(xyz.min(axis=0)))
    return SplitPulses(xy=xyz[visible, :2], split=split[visible])


def walls_of(
    blocks: list[shapely.Polygon], outline: shapely.Geometry, pulses: SplitPulses
) -> tuple[list[Wall], float, float]:
    """Walls that have an outline along them; the length of all, and of those."""
    border = outline.boundary
    found, asked, met = [], 0.0, 0.0
    for block in blocks:
        polygon = shapely.geometry.polygon.orient(shapely.simplify(block, 0.15))
        for ring in (polygon.exterior, *polygon.interiors):
            corners = shapely.get_coordinates(ring)
            for start, end in itertools.pairwise(corners):
                length = math.dist(start, end)
                if length < _MIN_WALL_M:
                    continue
                asked += length
                wall = _wall(start, end, length, border, pulses)
                if wall is not None:
                    met += length
                    found.append(wall)
    return found, asked, met


def _wall(
    start: FloatArray, end: FloatArray, length: float, border: shapely.Geometry, pulses: SplitPulses
) -> Wall | None:
    along = (end - start) / length
    out = np.array([along[1], -along[0]])
    steps = start + np.arange(1.0, length - 1.0, _STEP_M)[:, None] * along
    rays = shapely.linestrings(np.stack((steps - _REACH_M * out, steps + _REACH_M * out), 1))
    places = []
    for step, crossing in zip(steps, shapely.intersection(rays, border), strict=True):
        off = (shapely.get_coordinates(crossing) - step) @ out
        if len(off):
            places.append(float(off[np.argmin(np.abs(off))]))
    if len(places) < 0.8 * len(steps):
        return None
    outline = float(np.median(places))
    way, off = (pulses.xy - start) @ along, (pulses.xy - start) @ out
    band = pulses.split & (way > _END_M) & (way < length - _END_M) & (np.abs(off - outline) < _BAND_M)
    eave = float(off[band].mean()) if int(band.sum()) >= _FEWEST_SPLIT else math.nan
    return Wall(length_m=length, outline_m=outline, eave_m=eave)


def delft_lines(data: Path, outline_at: str) -> list[str]:
    """What the walls of Delft say."""
    tiles = [str(data / "ahn3" / f"delft_{side}.laz") for side in ("west", "east")]
    given = shapely.force_2d(shapely.from_wkb(pyogrio.raw.read(data / "ahn3" / "footprints.gpkg")[2]))
    half = _TOUCH_M / 2
    united = shapely.union_all(shapely.buffer(given, half, join_style="mitre")).buffer(-half, join_style="mitre")
    blocks = [block for block in polygons_of(united) if block.area >= OBJECT_M2]
    outline = shapely.union_all([model.footprint for model in drawn(tiles, outline_at, "EPSG:7415")])
    closed = outline.buffer(half, join_style="mitre").buffer(-half, join_style="mitre")
    walls, asked, met = walls_of(blocks, closed, roof_pulses(tiles))
    weights = np.array([wall.length_m for wall in walls])
    off = np.array([wall.outline_m for wall in walls])
    eave = np.array([wall.eave_m for wall in walls])
    known = np.isfinite(eave)
    quartiles = ", ".join(f"{value:+.2f}" for value in np.percentile(off, [10, 25, 50, 75, 90]))
    perimeter, area = sum(block.length for block in blocks), sum(block.area for block in blocks)
    eave_mean = float(np.average(eave[known], weights=weights[known]))
    mean_off = float(np.average(off, weights=weights))
    beyond = (off - eave)[known]
    mean_beyond = float(np.average(beyond, weights=weights[known]))
    return [
        f"{len(walls)} walls, {met:.0f} of {asked:.0f} m of facades of 5 m or more, have an outline along them",
        f"outline outside the facade, mean: {mean_off:+.3f} m",
        f"outline outside the facade, 10, 25, 50, 75, 90 % of the walls: {quartiles} m",
        f"eave (split pulses) outside the facade, {int(known.sum())} walls, mean: {eave_mean:+.3f} m",
        f"outline outside the eave: mean {mean_beyond:+.3f} m, median {np.median(beyond):+.3f} m",
        f"area of the blocks between facade and eave, were it all around: {100.0 * eave_mean * perimeter / area:.1f} %",
    ]


def seen_lines(tiles: list[str]) -> list[str]:
    """How much of the outlines has walls that facade points show; the file's classes are not used."""
    table = {"classes": "ignore", "units": {"split": "nothing"}, "roof": {"outline": "walls"}}
    settings = RunSettings.from_mapping(table)
    roof, eaves = settings.building.roof, []
    for candidate in found_scene(tiles, "EPSG:7415", settings).candidates:
        try:
            bare = roof_points(prepare_cloud(candidate), roof)
            plane = block_plane(bare.points, candidate.ground_z_m, roof.block_height_percentile)
            at_eaves = dataclasses.replace(bare, facades=None, labels=np.zeros(len(bare.points), np.int32))
            outline_mm = partition_roof(at_eaves, [plane], roof).outline_mm
        except BuildingError:
            continue
        edge_points = EdgePoints.of(bare.xy_mm, bare.split, bare.spacing_m)
        reach_m = 1e-3 * mixed_pulse_reach_mm(outline_mm, edge_points)
        for polygon in map(shapely.geometry.polygon.orient, outline_mm.geoms):
            for ring in (polygon.exterior, *polygon.interiors):
                corners = shapely.get_coordinates(ring) * 1e-3
                if bare.facades is not None:
                    eaves += [eave_of(start, end, bare.facades, reach_m) for start, end in itertools.pairwise(corners)]
    whole = sum(eave.length_m for eave in eaves)
    is_open = sum(eave.length_m for eave in eaves if eave.is_open)
    seen = [(eave.length_m, eave.overhang_m) for eave in eaves if eave.overhang_m is not None]
    length = sum(length for length, _ in seen)
    mean = sum(length * overhang for length, overhang in seen) / length
    return [
        f"{whole:.0f} m of outlines, {100 * is_open / whole:.0f} % with open ground before them",
        f"walls shown by facade points: {len(seen)} lines, {length:.0f} m, {100 * length / whole:.0f} %",
        f"their overhang: mean {mean:.3f} m, median {np.median([overhang for _, overhang in seen]):.3f} m",
    ]


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("sweep", "beams", "delft"))
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "gablework-outlines")
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--outline", choices=("eaves", "walls"), default="eaves", help="where outlines are drawn")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    given = parser.parse_args()
    if given.what == "delft":
        lines = delft_lines(given.data, given.outline)
        if given.outline == "walls":
            lines += seen_lines([str(given.data / "ahn3" / f"delft_{side}.laz") for side in ("west", "east")])
        sys.stdout.write("\n".join(lines) + "\n")
    elif given.what == "sweep":
        rows = sweep_rows(given.out, given.split, given.outline)
        sys.stdout.write(markdown_table(["pulses/m2", "noise, m", *FIGURES], rows))
    else:
        rows = beam_rows(given.out, given.split, given.outline)
        sys.stdout.write(markdown_table(["beam radius, m", "flight, deg", "pulses/m2", *FIGURES], rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
