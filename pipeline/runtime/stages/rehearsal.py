"""Rehearsal: the stages run once over some made-up houses, to load their libraries and compiled kernels.

For a process from which others are forked: it loads them once for all of them.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable

import numpy as np
import shapely

from pipeline.io.temporary import temporary_folder
from pipeline.methods import METHODS, ReconstructSettings
from pipeline.model import Candidate
from pipeline.roof.roof_settings import RoofSettings
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.cells_stage import CellsTask, find_cells
from pipeline.runtime.stages.divided_units import UnitTask, divide
from pipeline.runtime.stages.ground_stage import GroundTask, draw_ground
from pipeline.runtime.stages.join import _TILES_ACROSS, blocks_of, finished_within, united_surfaces
from pipeline.runtime.stages.open_fragments import OpenSurfaces
from pipeline.runtime.stages.sites import FoundSites
from pipeline.runtime.stages.split import Split, SplitTask, split_window
from pipeline.runtime.stages.tile_content import zone_sums
from pipeline.runtime.stages.tile_sites import TileSites, sites_of
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS
from pipeline.terrain.terrain_settings import CandidateSettings, ClassesInUse, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid

_SIDE_M = 24
_HOUSES = ((4, 10), (14, 20))
"""Their extent in both directions, metres."""
_STRIP_LIFT_MM = 200
"""Every second row belongs to a strip that lies this much higher: strips are aligned, too."""


def rehearse_scene(outlines: str = "") -> None:
    """Split, join and divide a tile with houses, its classes known; with the outlines `given` it is only split."""
    footprints = tuple(shapely.box(low, low, high, high) for low, high in _HOUSES) if outlines else None
    steps = np.arange(500, _SIDE_M * MM, 1000)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    points = np.zeros(len(x), POINT)
    points["x"], points["y"], points["classification"] = x, y, GROUND_CLASS
    points["return_number"] = points["return_count"] = 1
    for low, high in _HOUSES:
        inside = (x > low * MM) & (x < high * MM) & (y > low * MM) & (y < high * MM)
        points["z"][inside], points["classification"][inside] = 6 * MM, BUILDING_CLASS
    # class 6 leaves out some of their points
    points["classification"][(points["classification"] == BUILDING_CLASS) & (x // MM % 3 == 0)] = 0
    points["source"] = y // MM % 2
    points["z"][(points["source"] == 1) & (points["z"] > 0)] += _STRIP_LIFT_MM
    settings, tile = SceneSettings(), Tile(0, 0)
    grid = TileGrid(size_mm=_SIDE_M * MM, halo_mm=MM, origin_x_mm=0, origin_y_mm=0)
    core = grid.core(tile)
    bits = np.ascontiguousarray(points["gps_time"]).view(np.uint64)
    zone_sums(points, bits, core.x0_mm, core.y0_mm, core.x1_mm, core.y1_mm, grid.halo_mm)
    with temporary_folder() as folder:
        scratch = Scratch(str(folder))
        points.tofile(scratch.path("points", tile.key, "made-up.bin"))
        classes = ClassesInUse(ground=True, building=True)
        find_cells(CellsTask(tile=tile, grid=grid, classes=classes, scratch=scratch), settings.outliers)
        block = GroundTask(tiles=(tile,), seen=(tile,), grid=grid, reach_mm=MM, trusted=True, scratch=scratch)
        draw_ground(block, settings.ground)
        task = SplitTask(tile=tile, grid=grid, classes=classes, scratch=scratch, footprints=footprints)
        found = split_window(task, settings)
        if footprints is not None:
            return
        joined, _ = join_tiles([found], grid, settings.candidates, "")
        units = UnitTask(
            tile=tile,
            share=0,
            shares=1,
            split=None,
            borders=(),
            scene=settings,
            roof=RoofSettings(),
            outlines=False,
            grid=grid,
            scratch=scratch,
            crs_name="",
            scale=1,
            folder="units/made-up",
        )
        divide(joined.candidates, units)


@functools.cache
def load_once(method: str) -> None:
    """Load what modelling by one method needs, once per process."""
    load(method)


def load(*methods: str) -> None:
    """Load the libraries and compiled kernels for modelling, by modelling roofs of many and of few points."""
    from pipeline.recipe import reconstruct_building  # as above

    lattice = np.arange(-4.5, 15.0)
    east, north = (axis.ravel() for axis in np.meshgrid(lattice, lattice, indexing="ij"))
    outline = shapely.box(0.0, 0.0, 16.0, 10.0)  # partly without points, which only given outlines can be
    for spacing_m, slope, footprint in ((0.5, 0.6, None), (0.5, 0.0, outline), (1.0, 0.6, None)):
        places = np.arange(0.5 * spacing_m, 10.0, spacing_m)
        x, y = (axis.ravel() for axis in np.meshgrid(places, places, indexing="ij"))
        candidate = Candidate(
            building_id="",
            origin=(0.0, 0.0, 0.0),
            points=np.rint(np.column_stack((x, y, 9.0 - slope * np.abs(y - 5.0))) * 1e3) / 1e3,
            ground=np.column_stack((east, north, np.zeros(len(east)))),
            ground_z_m=0.0,
            footprint=footprint,
        )
        for method in methods or METHODS:
            reconstruct_building(candidate, method, ReconstructSettings())


def join_tiles(
    splits: Iterable[Split], grid: TileGrid, settings: CandidateSettings, crs_name: str, across: int = _TILES_ACROSS
) -> tuple[FoundSites, int]:
    """The sites of some tiles, all in memory, and the number of smaller surfaces; blocks are so many tiles `across`."""
    surfaces = {split.tile: split.surfaces for split in splits if split.surfaces is not None}
    sites = [TileSites(found=one.done, tiles=(tile,)) for tile, one in surfaces.items()]
    rest: list[OpenSurfaces] = []
    for area, tiles in blocks_of(surfaces, across).values():
        whole = united_surfaces(surfaces[tile].open for tile in tiles)
        done, passed_on = finished_within(whole, area, settings)
        sites.append(TileSites(found=done, tiles=whole.tiles))
        rest.append(passed_on)
    last = united_surfaces(rest)
    done, _ = finished_within(last, None, settings)
    sites.append(TileSites(found=done, tiles=last.tiles))
    return sites_of(sites, grid, settings, crs_name), sum(one.found.small for one in sites)
