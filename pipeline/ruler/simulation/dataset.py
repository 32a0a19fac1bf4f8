"""Simulated data sets on disk: raw LAZ tiles, and the truth beside them.

```
<suite>.laz                     points without classes, as a survey delivers them
tiles/<suite>_<key>.laz         the same of a suite that is made tile by tile (city)
truth/scene.json                suite, seed, split, scanner, counts, list of the tiles with their points and bounds
truth/labels.parquet            one row per point, in the order of the LAZ: class, building_id, face, mixed
truth/labels/<key>.parquet      the same of one tile
truth/conditions.parquet        one row per building: shape, defects, groups of its faces, slope of the terrain
truth/buildings, planes, meshes, cityjson      the exact models, laid out and named as in a run directory
<cell>/ and sweep.json          a suite of several surveys (sweep, trust): one such data set per cell, and their list
```
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pipeline.errors import InputError, SettingsError
from pipeline.ruler.simulation.als import ScannerSettings, scan, strip_count
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.strips import Returns, survey_extent
from pipeline.ruler.simulation.suites import Suite, suite_named
from pipeline.ruler.simulation.survey_files import TileFiles, recorded, write_points
from pipeline.ruler.simulation.sweep import Cell, chosen_cells
from pipeline.ruler.simulation.truth_files import write_conditions, write_manifest, write_models

_BUILDINGS_PER_PART = 500
"""Buildings per file of the exact models."""
_TRUTH_FILES = ("scene.json", "labels.parquet", "conditions.parquet")
_TRUTH_FOLDERS = ("labels", "buildings", "planes", "rejected", "meshes", "cityjson")
_TILED_CHUNK_POINTS = 250_000
"""The scanner goes on while a chunk is compressed; small chunks keep it busy."""
_STEEPEST_DEG = 30.0
"""Steepest ground for a city."""

OnPoints = Callable[[int], None]
Extent = tuple[float, float, float, float]
"""Smallest x, smallest y, largest x, largest y in the scene frame."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScenePaths:
    """The files that `simulate` wrote. With cells, every path is the folder of the data set."""

    laz: Path
    """The tile, or the folder of several tiles."""
    truth: Path
    """The folder of the truth: a run directory of the exact models, plus conditions, labels and scene.json."""
    labels: Path
    """Per-point truth, or the folder of it for several tiles."""
    points: int
    buildings: int
    """Buildings in the scene, or in all cells together."""
    tiles: int = 1
    cells: tuple[ScenePaths, ...] = ()
    """The files of every cell of a suite of several surveys."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Output:
    """How a data set is written."""

    with_classes: bool = False
    """Write the true classes into the LAZ too; otherwise all points are class 1 (unclassified)."""
    chunk_points: int = 1_000_000
    """Points held in memory at a time, about; the content does not depend on it."""
    on_points: OnPoints | None = None
    """Called with the number of points written so far."""


_DEFAULT_OUTPUT = Output()


def simulate(
    suite: str | Suite,
    out_dir: str | Path,
    seed: int | None = None,
    *,
    size_m: tuple[float, float] | None = None,
    density_per_m2: float | None = None,
    noise_m: float | None = None,
    slope_deg: float | None = None,
    output: Output = _DEFAULT_OUTPUT,
) -> ScenePaths:
    """Make the scene of a suite, scan it, write the tiles and the truth. The same call gives the same bytes.

    Parameters
    ----------
    suite : str or Suite
        A suite, or the name of one. By default its own seed (of layout and scanner) and size (east, north) are taken.
    out_dir : str or Path
        Folder, created if missing. The files of an earlier call are replaced, whatever its suite was.
    density_per_m2, noise_m : float, optional
        Replace the pulse density and range noise of the suite, or select cells of a suite of several surveys.
    slope_deg : float, optional
        Put a city on ground with this slope everywhere, 0 to 30 deg, instead of its plain and hillside.

    Raises
    ------
    SettingsError
        Unknown suite, negative seed, or a size or survey out of range.
    InputError
        The survey hits nothing, or the folder cannot be written or holds the truth of another program.
    """
    plan = suite if isinstance(suite, Suite) else suite_named(suite)
    seed = plan.seed if seed is None else seed
    faults = _faults(plan, seed, size_m, slope_deg)
    if "://" in str(out_dir):
        faults.append(f"out is {out_dir}: simulate writes to a folder of this machine")
    if faults:
        raise SettingsError(faults)
    if slope_deg is not None:
        plan = _sloped(plan, slope_deg)
    request = _Request(
        plan=plan,
        seed=seed,
        size_m=plan.size_m if size_m is None else size_m,
        scanner=plan.scanner,
        returns=plan.returns,
        output=output,
    )
    out = Path(out_dir)
    if plan.cells:
        return _simulate_cells(request, chosen_cells(plan.cells, density_per_m2, noise_m), out)
    return _simulate_tiles(request.surveyed(density_per_m2, noise_m), None, out)


def _sloped(plan: Suite, slope_deg: float) -> Suite:
    """The suite on ground of one slope."""
    on_slope = plan.on_slope
    if on_slope is None:
        raise TypeError(f"{plan.name} has ground of its own")
    return dataclasses.replace(plan, part=lambda seed, size_m, settings: on_slope(seed, size_m, settings, slope_deg))


def _faults(plan: Suite, seed: int, size_m: tuple[float, float] | None, slope_deg: float | None) -> list[str]:
    """The faults of a request."""
    faults = []
    if size_m is not None and not plan.is_sized:
        faults.append(f"the size of {plan.name} follows from its buildings: leave out --size")
    elif size_m is not None:
        faults += [f"size is {size:g} m: use 20 to 50000 m" for size in size_m if not 20.0 <= size <= 50_000.0]
    if not 0 <= seed < 2**32:
        faults.append(f"seed is {seed}: use 0 to {2**32 - 1}")
    if slope_deg is not None and plan.on_slope is None:
        faults.append(f"{plan.name} has ground of its own: leave out slope_deg")
    elif slope_deg is not None and not 0.0 <= slope_deg <= _STEEPEST_DEG:
        faults.append(f"slope_deg is {slope_deg:g}: use 0 to {_STEEPEST_DEG:g}")
    return faults


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Request:
    """A checked call of `simulate`."""

    plan: Suite
    seed: int
    size_m: tuple[float, float]
    scanner: ScannerSettings
    returns: Returns
    output: Output

    def of_cell(self, cell: Cell) -> _Request:
        """The same with the survey of a cell."""
        output = dataclasses.replace(self.output, with_classes=self.output.with_classes or cell.with_classes)
        return dataclasses.replace(self, scanner=cell.scanner(self.scanner), returns=cell.returns, output=output)

    def surveyed(self, density_per_m2: float | None, noise_m: float | None) -> _Request:
        """The same with another density and noise, where they are given."""
        scanner = self.scanner
        if density_per_m2 is not None:
            scanner = dataclasses.replace(scanner, pulse_density_per_m2=float(density_per_m2))
        if noise_m is not None:
            scanner = dataclasses.replace(scanner, range_noise_m=float(noise_m))
        return dataclasses.replace(self, scanner=scanner)

    def write_tile(self, scene: Scene, laz: Path, labels: Path, before: int) -> TileFiles:
        """Scan a scene into a LAZ file and its labels; earlier tiles have `before` points."""
        blocks = scan(scene, self.scanner, self.seed, chunk_points=self.output.chunk_points)
        blocks = recorded(blocks, self.returns)
        notify = self.output.on_points
        on_points = None if notify is None else lambda n: notify(before + n)
        return write_points(blocks, scene, laz, labels, self.output.with_classes, on_points)


def _emptied(out: Path, suite: str) -> Path:
    """The folder of the truth, created if missing, without the files of an earlier call."""
    truth = out / "truth"
    try:
        truth.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            str(out), f"cannot be written ({error.strerror})", "Give --out a folder of your own"
        ) from error
    manifest, begun = truth / "scene.json", truth / ".scene.json"
    held = [name for name in (*_TRUTH_FILES, *_TRUTH_FOLDERS) if (truth / name).exists()]
    if held and not (manifest.is_file() or begun.is_file()):
        problem = f"holds {', '.join(held)} that simulate did not write"
        raise InputError(str(truth), problem, "Give another --out, or move them away")
    for laz in _known_tiles(manifest):
        laz.unlink(missing_ok=True)
    begun.touch()  # marks the folder as ours until scene.json takes its place
    for name in _TRUTH_FILES:
        (truth / name).unlink(missing_ok=True)
    for name in _TRUTH_FOLDERS:
        if (truth / name).is_dir():
            shutil.rmtree(truth / name)
    for laz in (out / "tiles").glob(f"{suite}_x*_y*.laz"):
        laz.unlink()
    return truth


def _known_tiles(manifest: Path) -> list[Path]:
    """The LAZ files of an earlier call, of any suite, in its folder."""
    try:
        names = [str(tile["laz"]) for tile in json.loads(manifest.read_text(encoding="utf-8"))["tiles"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    tiles = [(manifest.parent / name).resolve() for name in names]
    out = manifest.parent.parent.resolve()
    return [tile for tile in tiles if tile.suffix == ".laz" and tile.parent in {out, out / "tiles"}]


def _simulate_cells(request: _Request, cells: tuple[Cell, ...], out: Path) -> ScenePaths:
    """One data set per cell: the same scene under every survey, or the scene of each cell."""
    make_for = request.plan.make_for
    scene = request.plan.make(request.seed, request.size_m)
    made: list[ScenePaths] = []
    for cell in cells:
        here = scene if make_for is None else make_for(request.seed, cell.key)
        made.append(_simulate_tiles(request.of_cell(cell), here, out / cell.key, sum(one.points for one in made)))
    listed = [
        {"cell": cell.key, "density_per_m2": cell.density_per_m2, "noise_m": cell.noise_m, "points": one.points}
        for cell, one in zip(cells, made, strict=True)
    ]
    document: dict[str, Any] = {"suite": request.plan.name, "seed": request.seed, "cells": listed}
    (out / "sweep.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return ScenePaths(
        laz=out,
        truth=out,
        labels=out,
        points=sum(one.points for one in made),
        buildings=sum(one.buildings for one in made),
        tiles=len(made),
        cells=tuple(made),
    )


def _simulate_tiles(request: _Request, scene: Scene | None, out: Path, before: int = 0) -> ScenePaths:
    """A data set of one tile (a given scene, else that of the suite), or of many: never in memory as a whole.

    While one tile is scanned and written, one thread lays out the next and writes the models of the one before. Earlier
    data sets have `before` points.
    """
    plan, settings = request.plan, request.scanner
    truth = _emptied(out, plan.name)
    laz_dir, labels_dir, todo = out, truth, [("", (0.0, 0.0, *request.size_m))]
    if plan.part is not None:
        part_of = plan.part(request.seed, request.size_m, settings)
        chunk_points = min(request.output.chunk_points, _TILED_CHUNK_POINTS)
        request = dataclasses.replace(request, output=dataclasses.replace(request.output, chunk_points=chunk_points))
        laz_dir, labels_dir, todo = out / "tiles", truth / "labels", list(tile_extents(request.size_m, plan.tile_m))
        for folder in (laz_dir, labels_dir):
            folder.mkdir(parents=True, exist_ok=True)
    else:
        whole = scene or plan.make(request.seed, request.size_m)

        def part_of(_: Extent) -> Scene:
            return whole

    tiles: list[TileFiles] = []
    truths: list[Future[_TileTruth]] = []
    points = 0
    with ThreadPoolExecutor(1) as aside:
        ahead = aside.submit(part_of, todo[0][1])
        for number, (key, extent) in enumerate(todo):
            here = ahead.result()
            if number + 1 < len(todo):
                ahead = aside.submit(part_of, todo[number + 1][1])
            truths.append(aside.submit(_tile_truth, here, settings, extent if key else None, truth, key))
            laz = laz_dir / f"{plan.name}{'_' if key else ''}{key}.laz"
            labels = labels_dir / f"{key or 'labels'}.parquet"
            made = request.write_tile(here, laz, labels, before + points)
            points += made.points
            if made.points:
                tiles.append(made)
            else:
                laz.unlink()
                labels.unlink()
        known = [future.result() for future in truths]
    if points == 0:
        raise InputError(str(laz_dir), "the survey hit nothing", "Use a larger scene or a higher density")
    rows = [row for one in known for row in one.rows]
    write_conditions(rows, truth / "conditions.parquet")
    write_manifest(
        here,
        settings,
        request.seed,
        tiles,
        truth,
        strips=strip_count(here, settings),
        buildings=len(rows),
        trees=sum(one.trees for one in known),
        cars=sum(one.cars for one in known),
    )
    return ScenePaths(
        laz=laz_dir if plan.part is not None else tiles[0].laz,
        truth=truth,
        labels=labels_dir if plan.part is not None else tiles[0].labels,
        points=points,
        buildings=len(rows),
        tiles=len(tiles),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _TileTruth:
    """The truth of the objects that a tile owns."""

    rows: list[dict[str, Any]]
    trees: int
    cars: int


def _tile_truth(scene: Scene, settings: ScannerSettings, extent: Extent | None, truth: Path, key: str) -> _TileTruth:
    """Write the models that a tile owns, in one part; those of a whole scene in parts of `_BUILDINGS_PER_PART`."""
    whole = survey_extent(scene)
    own = extent or whole
    owned = [building for building in scene.buildings if _owns(own, whole, building.x, building.y)]
    middles = [box.corners.mean(axis=0) for box in scene.boxes]
    step = max(1, len(owned)) if key else _BUILDINGS_PER_PART
    rows = []
    for first in range(0, max(1, len(owned)), step):  # a scene without buildings has one part
        part = key or f"part{first // step:05d}"
        rows += write_models(owned[first : first + step], scene, settings, truth, part)
    return _TileTruth(
        rows=rows,
        trees=sum(_owns(own, whole, tree.x, tree.y) for tree in scene.trees),
        cars=sum(_owns(own, whole, float(middle[0]), float(middle[1])) for middle in middles),
    )


def tile_extents(size_m: tuple[float, float], tile_m: float) -> Iterator[tuple[str, Extent]]:
    """Key and extent of the square tiles that cover a scene from its origin, row by row."""
    for row in range(math.ceil(size_m[1] / tile_m)):
        for column in range(math.ceil(size_m[0] / tile_m)):
            x, y = column * tile_m, row * tile_m
            yield f"x{column}_y{row}", (x, y, min(x + tile_m, size_m[0]), min(y + tile_m, size_m[1]))


def _owns(extent: Extent, whole: Extent, x: float, y: float) -> bool:
    """Half-open ownership; an object with its middle outside the whole scene belongs to the nearest tile."""
    inside_x = min(max(x, whole[0]), math.nextafter(whole[2], -math.inf))
    inside_y = min(max(y, whole[1]), math.nextafter(whole[3], -math.inf))
    return extent[0] <= inside_x < extent[2] and extent[1] <= inside_y < extent[3]
