"""Pictures of a split scene: what was found, missed and wrong, over the heights, with the outlines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
import shapely
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from pipeline.model import BoolArray, FloatArray
from pipeline.ruler.evaluation.building_raster import CELL_M, CellWindow, PlanRaster, PointRaster
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.scene import BUILDING_CLASS

_SUN_AZIMUTH_DEG, _SUN_HEIGHT_DEG = 315.0, 45.0
_COLOURS = {"found": (0.10, 0.65, 0.20), "missed": (0.90, 0.10, 0.10), "false": (0.10, 0.30, 0.95)}
_OPACITY = 0.5
_MAX_INCHES, _INCHES_A_METRE = 16.0, 0.06


def window_of(reference: Reference) -> CellWindow:
    """The cells that the tiles of a reference cover."""
    bounds = np.array(reference.bounds)
    low = np.floor(bounds[:, :2].min(axis=0) / CELL_M).astype(int)
    high = np.ceil(bounds[:, 2:].max(axis=0) / CELL_M).astype(int)
    return CellWindow(row=int(low[1]), column=int(low[0]), rows=int(high[1] - low[1]), columns=int(high[0] - low[0]))


def highest(xyz: FloatArray, window: CellWindow) -> FloatArray:
    """(rows, columns) elevation of the highest point of each cell; empty cells take that of a neighbour, or nan."""
    top = np.full((window.rows, window.columns), -np.inf)
    row = np.floor(xyz[:, 1] / CELL_M).astype(int) - window.row
    column = np.floor(xyz[:, 0] / CELL_M).astype(int) - window.column
    inside = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
    np.maximum.at(top, (row[inside], column[inside]), xyz[inside, 2])
    for _ in range(4):
        empty = np.isneginf(top)
        if not empty.any():
            break
        grown = np.pad(top, 1, constant_values=-np.inf)
        around = np.maximum.reduce([grown[:-2, 1:-1], grown[2:, 1:-1], grown[1:-1, :-2], grown[1:-1, 2:]])
        top[empty] = around[empty]
    return np.where(np.isneginf(top), np.nan, top)


def shaded(top: FloatArray) -> npt.NDArray[np.float64]:
    """(rows, columns) brightness 0 to 1 of a surface under a sun in the north west."""
    filled = np.where(np.isnan(top), np.nanmin(top) if np.isfinite(top).any() else 0.0, top)
    north, east = np.gradient(filled, CELL_M)
    azimuth, height = np.radians(_SUN_AZIMUTH_DEG), np.radians(_SUN_HEIGHT_DEG)
    sun = np.cos(height) * np.sin(azimuth), np.cos(height) * np.cos(azimuth), np.sin(height)
    light = (-east * sun[0] - north * sun[1] + sun[2]) / np.sqrt(1.0 + east**2 + north**2)
    brightness: npt.NDArray[np.float64] = 0.35 + 0.6 * np.clip(light, 0.0, 1.0)
    return np.where(np.isnan(top), 1.0, brightness)


def building_cells(reference: Reference, window: CellWindow) -> BoolArray:
    """(rows, columns) cells that are building in a reference: class 6, or true footprints."""
    if reference.outlines == "truth":
        return PlanRaster([building.footprint for building in reference.buildings]).window(window)
    raster = PointRaster()
    for tile in reference.points():
        raster.add(tile.xyz, tile.classification == BUILDING_CLASS)
    raster.finish()
    return raster.window(window)


def draw_scene(
    path: Path,
    title: str,
    models: Sequence[RoofModel],
    reference: Reference,
    given: Sequence[shapely.Geometry] = (),
) -> None:
    """Write a PNG: found green, missed red, false blue, outlines black, given footprints yellow."""
    window = window_of(reference)
    xyz = np.concatenate([tile.xyz for tile in reference.points()])
    image = np.repeat(shaded(highest(xyz, window))[:, :, np.newaxis], 3, axis=2)
    wanted = building_cells(reference, window)
    made = PlanRaster([model.footprint for model in models]).window(window) if models else np.zeros_like(wanted)
    for name, cells in (("found", wanted & made), ("missed", wanted & ~made), ("false", made & ~wanted)):
        image[cells] = (1.0 - _OPACITY) * image[cells] + _OPACITY * np.array(_COLOURS[name])
    x0, y0, x1, y1 = window.bounds
    scale = min(_INCHES_A_METRE, _MAX_INCHES / max(x1 - x0, y1 - y0))
    with mpl.rc_context({"font.size": 8}):
        figure = Figure(figsize=(max(4.0, (x1 - x0) * scale) + 0.6, max(4.0, (y1 - y0) * scale) + 0.6), dpi=80)
        axes = figure.add_subplot()
        axes.imshow(image, origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest")
        for geometries, colour, width in ((given, "gold", 0.9), ([model.footprint for model in models], "black", 0.7)):
            rings = [shapely.get_coordinates(ring) for ring in shapely.get_rings(np.array([*geometries], dtype=object))]
            axes.add_collection(LineCollection(rings, colors=colour, linewidths=width))
        axes.set_xlim(x0, x1)
        axes.set_ylim(y0, y1)
        axes.set_aspect("equal")
        axes.ticklabel_format(useOffset=False, style="plain")
        reported = "green found, red missed, blue false" if wanted.any() else "blue found, without a reference"
        axes.set_title(f"{title}: {reported};\nblack outlines" + (", yellow given footprints" if len(given) else ""))
        figure.tight_layout()
        figure.savefig(path)
