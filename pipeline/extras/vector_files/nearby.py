"""The features of a layer; which of a large file lie near the data, found batch by batch from their bounds alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

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


@dataclasses.dataclass(frozen=True, slots=True)
class Elsewhere:
    """The features of a file that were passed over, since they lie off the area that was asked for."""

    count: int = 0
    """Their number."""
    bounds: tuple[float, ...] | None = None
    """xmin, ymin, xmax, ymax of all in the file's CRS; None where there are none."""
    crs: str | None = None
    """That CRS; None where it is unknown."""


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
    one: str = "polygon"
    """What one of their parts is."""


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
    boxes : callable, optional
        Where features are wanted; None takes all features for near.
    crs : str, optional
        The layer's CRS, as the file has it.
    shape : Shape
        What is counted of those that are passed over.
    """

    def __init__(self, boxes: Boxes | None, crs: str | None, shape: Shape = POLYGONS) -> None:
        self._kinds = shape.kinds
        found = None if boxes is None else boxes(crs)
        self._tree = None if found is None else shapely.STRtree(shapely.box(*np.reshape(found, (-1, 4)).T))
        self.elsewhere = Elsewhere(crs=crs)
        """Polygons, or what the shape says, that were passed over."""

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
        if len(far):
            before = self.elsewhere
            known = [] if before.bounds is None else [shapely.box(*before.bounds)]
            bounds = tuple(shapely.total_bounds([*far, *known]).tolist())
            self.elsewhere = dataclasses.replace(before, count=before.count + len(far), bounds=bounds)
        return near


@dataclasses.dataclass(frozen=True, kw_only=True)
class VectorLayer:
    """The features of a layer. All arrays have one length n."""

    feature_ids: npt.NDArray[np.int64]
    """(n,) int64, the file's own numbers of the features."""
    geometries: npt.NDArray[np.object_]
    """(n,) shapely geometries; None where there is none, or where it cannot be read."""
    unreadable: npt.NDArray[np.bool_]
    """(n,) bool, True where there is a geometry that cannot be read."""
    columns: Mapping[str, Sequence[Any]]
    """All columns but the geometry, by name."""
    elsewhere: Elsewhere
    """Features of the wanted shape that were passed over, since they lie off the boxes, and the layer's CRS."""
    warnings: tuple[str, ...] = ()
    """What is odd but usable, one sentence each."""

    @classmethod
    def of(cls, wkb: npt.NDArray[np.object_], **facts: Any) -> VectorLayer:
        """A layer of geometries as ISO WKB, (n,) bytes, None where there is none, and all else about it."""
        geometries = geometries_of(wkb)
        there = np.array([data is not None for data in wkb], np.bool_)
        return cls(geometries=geometries, unreadable=there & shapely.is_missing(geometries), **facts)

    @property
    def crs(self) -> str | None:
        """As the file has it: a code, WKT or PROJJSON; None where it is unknown."""
        return self.elsewhere.crs
