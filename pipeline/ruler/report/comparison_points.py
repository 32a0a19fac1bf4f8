"""The points of some buildings, read again from their tiles."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import shapely

from pipeline.io import ReadOptions, Source, open_source
from pipeline.model import FloatArray


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointFiles:
    """Point files and their options."""

    paths: tuple[str, ...]
    options: ReadOptions = dataclasses.field(default_factory=ReadOptions)


def points_within(files: PointFiles, areas: Sequence[shapely.Geometry]) -> list[FloatArray]:
    """The points within each area (polygons in metres): streamed, without files that meet no area.

    Returns one (n, 3) float64 array in metres per area, ordered by easting, northing, elevation. Points in several
    files occur once. Raises InputError if a file cannot be read.
    """
    kept: list[list[FloatArray]] = [[] for _ in areas]
    for path in files.paths:
        source = open_source(path, files.options)
        x_min, y_min, _, x_max, y_max, _ = source.info.bounds_m
        reach = shapely.box(x_min, y_min, x_max, y_max).buffer(1.0, join_style="mitre")
        wanted = [number for number, area in enumerate(areas) if shapely.intersects(reach, area)]
        for xyz in _chunks(source, path, files.options, [areas[number].bounds for number in wanted]):
            for number in wanted:
                west, south, east, north = areas[number].bounds
                near = np.flatnonzero(
                    (xyz[:, 0] >= west) & (xyz[:, 0] <= east) & (xyz[:, 1] >= south) & (xyz[:, 1] <= north)
                )
                inside = near[shapely.intersects_xy(areas[number], xyz[near, 0], xyz[near, 1])]
                if len(inside):
                    kept[number].append(xyz[inside])
    return [np.unique(np.concatenate(parts), axis=0) if parts else np.zeros((0, 3)) for parts in kept]


def _chunks(
    source: Source, path: str, options: ReadOptions, bounds_m: Sequence[tuple[float, ...]]
) -> Iterator[FloatArray]:
    """Points of a file near rectangles: one window per rectangle for COPC, else one pass over all of them."""
    if not bounds_m:
        return
    unit_m = source.info.reference.horizontal_unit_m
    boxes: Any = np.array(bounds_m)
    if source.info.format != "copc":
        boxes = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])[None]
    for west, south, east, north in boxes / unit_m:
        window = dataclasses.replace(options, bbox=(west - 1.0, south - 1.0, east + 1.0, north + 1.0))
        for cloud in open_source(path, window).chunks():
            yield cloud.xyz
