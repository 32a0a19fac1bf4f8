"""Ground filters on the ISPRS samples and on scenes with exact ground: type I, type II, total error, kappa, speed.

    python -m benchmarks.ground [--data ../shared/data] [--filter morphological | MODULE:FUNCTION] [--only samp quarry]
                                [--densities 0.2 1 5] [--draw 0] [--kept-aside]

A filter is the name of one in the settings, all other settings default, or a function of this environment that takes
x, y, z (n,) int64 in mm, `usable` (n,) bool and the window (column0, row0, columns, rows) and gives (n,) bool. Judged
are all points, as the benchmark of Sithole and Vosselman (2003) does.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.entries import markdown_table
from benchmarks.ground_scenes import KINDS
from pipeline.io import open_source
from pipeline.scene import GROUND_CLASS
from pipeline.terrain.ground import ground_of, ground_points
from pipeline.terrain.lattice import CELL_MM
from pipeline.terrain.outliers import dense_enough
from pipeline.terrain.terrain_settings import GroundSettings, OutlierSettings

Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Window = tuple[int, int, int, int]
GroundFilter = Callable[[Ints, Ints, Ints, Bools, Window], Bools]

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
DENSITIES = (0.2, 1.0, 5.0)
KEPT_ASIDE = ("samp22", "samp42")
"""Samples for judging alone: no setting is chosen on them, and they are read only when asked for."""
MARGIN_M = 130
"""Empty cells around the points: no less than the terrain is drawn beyond them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """Points whose ground is known."""

    name: str
    """Name of the sample, or kind and density."""
    x_mm: Ints
    """(n,) easting."""
    y_mm: Ints
    """(n,) northing."""
    z_mm: Ints
    """(n,) elevation."""
    is_ground: Bools
    """(n,) the truth."""

    @property
    def window(self) -> Window:
        """column0, row0, columns, rows of the 1 m lattice around the points, with a margin as a tile has its halo."""
        c0, r0 = (int(v.min() // CELL_MM) - MARGIN_M for v in (self.x_mm, self.y_mm))
        c1, r1 = (int(v.max() // CELL_MM) + MARGIN_M for v in (self.x_mm, self.y_mm))
        return c0, r0, c1 - c0 + 1, r1 - r0 + 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """The figures of a scene, in percent."""

    name: str
    """Name of the scene."""
    type_1: float
    """Ground taken for object."""
    type_2: float
    """Object taken for ground; nan without objects."""
    total: float
    """Points on the wrong side."""
    kappa: float
    """Cohen's kappa."""
    points: int
    """Judged points."""
    seconds: float
    """Seconds that the filter took."""


def samples(data: Path, *, kept_aside: bool = False) -> Iterator[Scene]:
    """The reference samples of the ISPRS filter test that are there: those for choosing, or those kept aside."""
    paths = [path for folder in ("isprs", "more/isprs") for path in (data / folder).glob("samp*.la[sz]")]
    for path in sorted(paths, key=lambda path: path.name):
        if path.name.startswith(KEPT_ASIDE) != kept_aside:
            continue
        clouds = list(open_source(path).chunks())
        x, y, z = np.rint(np.concatenate([cloud.xyz for cloud in clouds]).T * 1000).astype(np.int64)
        is_ground = np.concatenate([cloud.classification for cloud in clouds]) == GROUND_CLASS
        yield Scene(name=path.name.split("-")[0].split(".")[0], x_mm=x, y_mm=y, z_mm=z, is_ground=is_ground)


def drawn_scenes(densities: Sequence[float] = DENSITIES, draw: int = 0) -> Iterator[Scene]:
    """The scenes with exact ground, at some densities in points per square metre."""
    for number, (name, kind) in enumerate(KINDS.items()):
        for density in densities:
            x, y, z, is_ground = kind(np.random.default_rng([draw, number, round(100 * density)]), density)
            mm = [np.rint(v * 1000).astype(np.int64) for v in (x + 1000.0, y + 2000.0, z + 100.0)]
            yield Scene(name=f"{name} {density:g}", x_mm=mm[0], y_mm=mm[1], z_mm=mm[2], is_ground=is_ground)


def product_filter(settings: GroundSettings) -> GroundFilter:
    """The ground stage of the product."""

    def found(x: Ints, y: Ints, z: Ints, usable: Bools, window: Window) -> Bools:
        terrain = ground_of(x, y, z, usable, window, settings, trusted=False)
        result: Bools = usable & ground_points(x, y, z, terrain, settings)
        return result

    return found


def filter_of(name: str) -> GroundFilter:
    """A filter by its name in the settings, or as MODULE:FUNCTION."""
    if ":" in name:
        module, function = name.split(":")
        found: GroundFilter = getattr(importlib.import_module(module), function)
        return found
    return product_filter(GroundSettings(filter=name))


def labels_of(scene: Scene, ground_filter: GroundFilter) -> Bools:
    """What a filter finds in a scene, gross outliers taken off first."""
    usable = dense_enough(scene.x_mm, scene.y_mm, scene.z_mm, OutlierSettings())
    return ground_filter(scene.x_mm, scene.y_mm, scene.z_mm, usable, scene.window)


def figures_of(scene: Scene, found: Bools, seconds: float = 0.0) -> Figures:
    """Type I, type II, total error and kappa."""
    truth, n = scene.is_ground, len(scene.is_ground)
    missed, taken = int((truth & ~found).sum()), int((~truth & found).sum())
    ground, said = int(truth.sum()), int(found.sum())
    chance = (ground * said + (n - ground) * (n - said)) / n**2
    return Figures(
        name=scene.name,
        type_1=100.0 * missed / max(ground, 1),
        type_2=100.0 * taken / (n - ground) if ground < n else float("nan"),
        total=100.0 * (missed + taken) / n,
        kappa=100.0 * (1.0 - (missed + taken) / n - chance) / (1.0 - chance) if chance < 1.0 else 100.0,
        points=n,
        seconds=seconds,
    )


def measured(scenes: Sequence[Scene], ground_filter: GroundFilter) -> list[Figures]:
    """The figures of each scene; everything is compiled before the clock starts."""
    if scenes:
        labels_of(scenes[0], ground_filter)
    rows = []
    for scene in scenes:
        start = time.perf_counter()
        found = labels_of(scene, ground_filter)
        rows.append(figures_of(scene, found, time.perf_counter() - start))
    return rows


def table(rows: Sequence[Figures], mean: str) -> str:
    """Rows and their mean as a Markdown table."""
    names = ("type_1", "type_2", "total", "kappa")
    lines = [
        [row.name, *(f"{getattr(row, name):.2f}" for name in names), str(row.points), f"{row.points / row.seconds:.2g}"]
        for row in rows
    ]
    means = [f"{statistics.fmean(getattr(row, name) for row in rows):.2f}" for name in names]
    speed = sum(row.points for row in rows) / sum(row.seconds for row in rows)
    lines.append([mean, *means, "", f"{speed:.2g}"])
    return markdown_table(["scene", "type I", "type II", "total", "kappa", "points", "points/s"], lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--filter", default=GroundSettings().filter)
    parser.add_argument("--only", nargs="*", default=())
    parser.add_argument("--densities", type=float, nargs="*", default=DENSITIES)
    parser.add_argument("--draw", type=int, default=0)
    parser.add_argument("--kept-aside", action="store_true", help="the samples that no setting was chosen on")
    given = parser.parse_args(arguments)
    ground_filter = filter_of(given.filter)
    for scenes, mean in (
        (list(samples(given.data, kept_aside=given.kept_aside)), "mean of samples"),
        (list(drawn_scenes(given.densities, given.draw)), "mean of drawn scenes"),
    ):
        wanted = [scene for scene in scenes if not given.only or any(part in scene.name for part in given.only)]
        if wanted:
            print(table(measured(wanted, ground_filter), mean), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
