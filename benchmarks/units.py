"""Separation of touching buildings: candidates against the houses of a simulated city, or given footprints.

    python -m benchmarks.units city --out DIR [--split dev|test] [--densities 1 4 10] [--size 600 500]
    python -m benchmarks.units real TILES… --crs EPSG:n --footprints FILE

A candidate and a house belong together if they share more than a fifth of the points of either. It counts pairs
that belong to each other alone (1:1), candidates of several houses (1:N) with the houses in them, and houses in several
candidates (N:1): before blocks are split into units, with steps alone, and with the default settings. Only houses with
points in some candidate count; detection is measured elsewhere. Classes are not used.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import shapely

from benchmarks.candidates import found_scene
from benchmarks.entries import markdown_table
from pipeline.extras.footprints.footprints_file import read_footprints
from pipeline.io import ReadOptions, open_source
from pipeline.model import IntArray
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.settings import RunSettings

MIN_SHARE = 0.2
"""Share of the points of either from which on a candidate and a house belong together."""
WAYS = (("not divided", "nothing"), ("steps", "steps"), ("steps and gutters", "ridges"))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Relations:
    """How candidates and houses belong together."""

    candidates: int
    """Those that hold points of houses."""
    houses: int
    """Those that have points in candidates."""
    one_to_one: int
    """Pairs that belong to each other alone."""
    joining: int
    """Candidates of several houses."""
    joined: int
    """Houses in those."""
    divided: int
    """Houses in several candidates."""


def relations(candidate: IntArray, house: IntArray) -> Relations:
    """Count, from the candidate and the house of every point; house -1 where there is none.

    >>> relations(np.array([0, 0, 1, 1, 1, 2]), np.array([0, 0, 1, 2, 2, -1]))
    Relations(candidates=2, houses=3, one_to_one=1, joining=1, joined=2, divided=0)
    """
    on = house >= 0
    if not on.any():
        return Relations(candidates=0, houses=0, one_to_one=0, joining=0, joined=0, divided=0)
    table = np.zeros((int(candidate[on].max()) + 1, int(house.max()) + 1), np.int64)
    np.add.at(table, (candidate[on], house[on]), 1)
    of_candidate, of_house = table.sum(axis=1, keepdims=True), table.sum(axis=0, keepdims=True)
    together = (table > MIN_SHARE * of_candidate) | ((table > MIN_SHARE * of_house) & (table > 0))
    houses_in, candidates_of_house = together.sum(axis=1), together.sum(axis=0)
    alone = together & (houses_in == 1)[:, None] & (candidates_of_house == 1)[None, :]
    return Relations(
        candidates=int((of_candidate > 0).sum()),
        houses=int((of_house > 0).sum()),
        one_to_one=int(alone.sum()),
        joining=int((houses_in > 1).sum()),
        joined=int(together[houses_in > 1].any(axis=0).sum()),
        divided=int((candidates_of_house > 1).sum()),
    )


def points_of_candidates(tiles: Sequence[str], crs: str | None, split: str) -> tuple[IntArray, IntArray]:
    """Points (n, 3) of all candidates in mm, and the candidate of each."""
    settings = RunSettings.from_mapping({"classes": "ignore", "units": {"split": split}})
    found = found_scene(tiles, crs, settings)
    points = [np.rint(1000 * (one.points + np.array(one.origin))).astype(np.int64) for one in found]
    return np.concatenate(points), np.repeat(np.arange(len(found)), [len(own) for own in points])


def houses_of_city(truth: Path, xyz_mm: IntArray) -> IntArray:
    """The true building of every point, -1 where there is none."""
    tiles = list(read_truth_reference(truth).points())
    known = _keys(np.concatenate([np.rint(1000 * tile.xyz).astype(np.int64) for tile in tiles]))
    building = np.concatenate([tile.building for tile in tiles]).astype(np.int64)
    order = np.argsort(known)
    at = np.minimum(np.searchsorted(known[order], asked := _keys(xyz_mm)), len(known) - 1)
    return np.where(known[order][at] == asked, building[order][at], -1)


def _keys(xyz_mm: IntArray) -> npt.NDArray[np.void]:
    """One sortable value per point."""
    return np.ascontiguousarray(xyz_mm).view([("x", "<i8"), ("y", "<i8"), ("z", "<i8")]).ravel()


def houses_of_footprints(path: str, tile: str, crs: str | None, xyz_mm: IntArray) -> IntArray:
    """The given footprint that holds each point, -1 where none does; the last where they overlap."""
    footprints = read_footprints(path, open_source(tile, ReadOptions(crs=crs)).info.reference)
    house = np.full(len(xyz_mm), -1, np.int64)
    x, y = xyz_mm[:, 0] / 1000.0, xyz_mm[:, 1] / 1000.0
    for number, polygon in enumerate(footprints.polygons):
        x0, y0, x1, y1 = polygon.bounds
        near = np.flatnonzero((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
        house[near[shapely.contains_xy(polygon, x[near], y[near])]] = number
    return house


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    city = kinds.add_parser("city", help="a simulated city")
    city.add_argument("--out", type=Path, required=True, help="folder for the scenes")
    city.add_argument("--split", choices=("dev", "test"), default="dev")
    city.add_argument("--densities", type=float, nargs="+", default=[1.0, 4.0, 10.0])
    city.add_argument("--size", type=float, nargs=2, default=[600.0, 500.0], help="east and north, metres")
    real = kinds.add_parser("real", help="tiles with footprints")
    real.add_argument("tiles", nargs="+")
    real.add_argument("--crs")
    real.add_argument("--footprints", required=True)
    arguments = parser.parse_args()
    rows = []
    if arguments.kind == "city":
        for density in arguments.densities:
            place = arguments.out / f"{arguments.split}-{density:g}"
            seed, size = seed_of(arguments.split, 0), tuple(arguments.size)
            made = simulate("city", place, seed, size_m=size, density_per_m2=density)
            tiles = sorted(str(path) for path in made.laz.glob("*.laz")) if made.laz.is_dir() else [str(made.laz)]
            for way, split in WAYS:
                points, candidate = points_of_candidates(tiles, None, split)
                found = relations(candidate, houses_of_city(made.truth, points))
                rows.append([f"{density:g} pts/m2", way, *map(str, dataclasses.astuple(found))])
    else:
        for way, split in WAYS:
            points, candidate = points_of_candidates(arguments.tiles, arguments.crs, split)
            house = houses_of_footprints(arguments.footprints, arguments.tiles[0], arguments.crs, points)
            rows.append(["footprints", way, *map(str, dataclasses.astuple(relations(candidate, house)))])
    print(markdown_table(["scene", "units", *(field.name for field in dataclasses.fields(Relations))], rows))


if __name__ == "__main__":
    main()
