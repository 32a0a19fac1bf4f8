"""Which features of a large vector file lie near the data, found batch by batch from their bounds alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.extras.vector_files.wkb import geometries_of

BATCH = 16_384
"""Features that are looked at together."""
CELLS_LIMIT = 100_000_000
"""Maximum number of values, features times columns, that are read of a layer: a value takes some 60 bytes of memory."""
CELLS_OF_SMALL = 20_000_000
"""The same of a small file. In some formats an absent value takes no byte of the file, so 400 kB can hold millions."""
CELLS_PER_BYTE = 4
"""The same per byte of larger files, up to `CELLS_LIMIT`; real ones have fewer than one."""

Boxes = Callable[[str | None], npt.NDArray[np.float64] | None]
"""From a layer's CRS, as the file has it, to boxes in that CRS, (k, 4) float64: xmin, ymin, xmax, ymax. None where
they cannot be computed there."""


def cells_limit(size_bytes: int) -> int:
    """How many values may be read of a file of a size.

    >>> cells_limit(1000), cells_limit(10_000_000), cells_limit(10**10)
    (20000000, 40000000, 100000000)
    """
    return min(CELLS_LIMIT, max(CELLS_OF_SMALL, CELLS_PER_BYTE * size_bytes))


class Shape(NamedTuple):
    """What the features of a layer are."""

    word: str
    """As in GDAL's names of kinds of geometries."""
    kinds: tuple[shapely.GeometryType, ...]
    """The single one and the multiple one."""
    named: str
    """What they are to the reader of a message."""
    choose: str = "Give a file with one of its layers"
    """What to do where several layers hold such features; their names follow."""


POLYGONS = Shape(
    "Polygon",
    (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON),
    "footprints",
    "Name one of its layers with --layer",
)
"""The default."""
AREAS = POLYGONS._replace(named="area", choose=Shape._field_defaults["choose"])
"""Polygons of areas of interest."""
TILES = AREAS._replace(named="tiles")
"""Outlines of a tile index."""
OWN_OUTLINES = POLYGONS._replace(choose="Name one of its layers as layer")
"""Outlines that overrides name in files."""


class Nearby:
    """Which features of a layer lie near some boxes; counts the others.

    Parameters
    ----------
    boxes : array, optional
        (k, 4) float64: xmin, ymin, xmax, ymax in the layer's CRS; None takes all features for near.
    shape : Shape
        What is counted of those that are passed over.
    """

    def __init__(self, boxes: npt.NDArray[np.float64] | None, shape: Shape = POLYGONS) -> None:
        self._kinds = shape.kinds
        self._tree = None if boxes is None else shapely.STRtree(shapely.box(*np.reshape(boxes, (-1, 4)).T))
        self.elsewhere = 0
        """Polygons, or what the shape says, that were passed over."""
        self.bounds_elsewhere: tuple[float, ...] | None = None
        """xmin, ymin, xmax, ymax of these in the layer's CRS; None where there are none."""

    @property
    def all(self) -> bool:
        """Whether every feature counts as near."""
        return self._tree is None

    def of(self, geometry_bytes: npt.NDArray[np.object_]) -> npt.NDArray[np.bool_]:
        """Which of some features, (n,) WKB, are near by their bounds; so is what has no bounds: it may be anywhere."""
        near = np.ones(len(geometry_bytes), np.bool_)
        if self._tree is None or len(near) == 0:
            return near
        geometries = geometries_of(geometry_bytes)
        placed = np.isfinite(shapely.bounds(geometries)).all(axis=-1)
        near[placed] = False
        near[np.flatnonzero(placed)[np.unique(self._tree.query(geometries[placed])[0])]] = True
        far = geometries[~near]
        far = far[np.isin(shapely.get_type_id(far), self._kinds)]
        self.elsewhere += len(far)
        if len(far):
            known = [] if self.bounds_elsewhere is None else [shapely.box(*self.bounds_elsewhere)]
            self.bounds_elsewhere = tuple(shapely.total_bounds([*far, *known]).tolist())
        return near
