"""Tiles of a simulated city of any size, written by several processes: the input of `city_scale.py`.

    python -m benchmarks.city_tiles --out DIR [--tiles 400] [--tile-m 200] [--density 4.5] [--seed 1] [--processes 2]

writes DIR/city_x<column>_y<row>.laz, a square of them, or as near to one as `--tiles` allows. The layout is that of the
suite `city` (rows, courtyards, halls, towers, houses of all shapes, trees, cars, a plain and a hillside); each tile is
made from its own surroundings, so the whole city is never in memory, and the same call gives the same bytes. A tile of
200 m holds 20 to 90 buildings, on average 53. Existing tiles are kept. No truth is written.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import laspy

from pipeline.ruler.simulation.als import scan
from pipeline.ruler.simulation.city import CITY_SCANNER, CityPlan, Extent
from pipeline.ruler.simulation.survey_files import las_header, las_points

SUFFIX = ".laz"


@dataclasses.dataclass(frozen=True, kw_only=True)
class CityTiles:
    """A city in tiles."""

    columns: int
    """Tiles from west to east."""
    rows: int
    """Tiles from south to north."""
    tile_m: float = 200.0
    """Side of a tile; whole hundreds lie on gablework's own lattice."""
    density_per_m2: float = 4.5
    """Pulses per square metre; returns are about a quarter more."""
    seed: int = 1
    """Seed of layout and scanner."""

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent east and north."""
        return self.columns * self.tile_m, self.rows * self.tile_m

    def name(self, column: int, row: int) -> str:
        """The file of a tile."""
        return f"city_x{column:03d}_y{row:03d}{SUFFIX}"

    def extent(self, column: int, row: int) -> Extent:
        """Where a tile lies in the city."""
        x, y = column * self.tile_m, row * self.tile_m
        return x, y, x + self.tile_m, y + self.tile_m


@dataclasses.dataclass(frozen=True, kw_only=True)
class MadeTile:
    """What one tile holds."""

    name: str
    points: int
    buildings: int
    """Those whose middle lies in the tile."""


def square_of(tiles: int, tile_m: float, density_per_m2: float, seed: int) -> CityTiles:
    """The city of so many tiles that is nearest to a square.

    >>> city = square_of(400, 200.0, 4.5, 1)
    >>> city.columns, city.rows
    (20, 20)
    """
    rows = next(n for n in range(math.isqrt(tiles), 0, -1) if tiles % n == 0)
    return CityTiles(columns=tiles // rows, rows=rows, tile_m=tile_m, density_per_m2=density_per_m2, seed=seed)


def make_row(city: CityTiles, row: int, out: Path) -> list[MadeTile]:
    """Write the tiles of one row, those that are there already but counted."""
    settings = dataclasses.replace(CITY_SCANNER, pulse_density_per_m2=city.density_per_m2)
    plan = CityPlan(city.seed, city.size_m, settings)
    made = []
    for column in range(city.columns):
        path, extent = out / city.name(column, row), city.extent(column, row)
        scene = plan.part(extent)
        owned = sum(extent[0] <= b.x < extent[2] and extent[1] <= b.y < extent[3] for b in scene.buildings)
        if path.exists():
            with laspy.open(path) as there:
                count = there.header.point_count
        else:
            part, count = path.with_name(f".{path.name}"), 0
            header = las_header(scene)
            with laspy.open(part, mode="w", header=header, do_compress=True) as writer:
                # one thread: the processes are as many as there are cores
                for block in scan(scene, settings, city.seed, chunk_points=250_000, threads=1):
                    writer.write_points(las_points(block, header, with_classes=False))
                    count += len(block)
            part.replace(path)
        made.append(MadeTile(name=path.name, points=count, buildings=owned))
    return made


def make_city(city: CityTiles, out: Path, processes: int) -> list[MadeTile]:
    """Write all tiles into a folder, as many rows at once as there are processes."""
    out.mkdir(parents=True, exist_ok=True)
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=fresh) as pool:
        rows = [pool.submit(make_row, city, row, out) for row in range(city.rows)]
        return [tile for made in rows for tile in made.result()]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tiles", type=int, default=400)
    parser.add_argument("--tile-m", type=float, default=200.0)
    parser.add_argument("--density", type=float, default=4.5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    wanted = parser.parse_args(arguments)
    city = square_of(wanted.tiles, wanted.tile_m, wanted.density, wanted.seed)
    began = time.perf_counter()
    made = make_city(city, wanted.out, wanted.processes)
    held = sum((wanted.out / tile.name).stat().st_size for tile in made)
    print(
        f"{len(made)} tiles, {sum(t.buildings for t in made)} buildings, {sum(t.points for t in made)} points, "
        f"{held / 1e6:.0f} MB in {time.perf_counter() - began:.0f} s"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
