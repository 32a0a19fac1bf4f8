"""The tiles of a table of a finished run, and which of them lie near to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs

from pipeline.export.geoparquet import table_batches, table_files
from pipeline.io import SpatialReference, arrow_at
from pipeline.model import FloatArray
from pipeline.runtime.manifest import RunManifest

TILES_IN_MEMORY = 16
"""Tiles that are kept for their neighbours."""


class RunTiles:
    """A table of a run by tile; nothing but the bounds of the tiles is kept."""

    def __init__(self, run_dir: str, manifest: RunManifest, table: str) -> None:
        self._filesystem: pafs.FileSystem
        self._filesystem, self._place = arrow_at(run_dir)
        self._table = table
        self.reference = SpatialReference.of_facts(manifest.crs)
        files = table_files(self._place, table, self._filesystem)
        self.tiles = [path.split("/")[-2].removeprefix("tile=") for path in files]
        self.bounds = np.array([self._bounds(tile) for tile in self.tiles]).reshape(-1, 4)

    @property
    def unit_m(self) -> FloatArray:
        """Metres per unit of easting, northing and elevation, (3,)."""
        return np.array([self.reference.horizontal_unit_m] * 2 + [self.reference.vertical_unit_m])

    def batches(self, columns: Sequence[str], tile: str | None = None) -> Iterator[pa.RecordBatch]:
        """Columns of a tile, or of all; raises RunError if a file cannot be read."""
        return table_batches(self._place, self._table, columns, self._filesystem, None if tile is None else [tile])

    def _bounds(self, tile: str) -> FloatArray:
        """Bounds of a tile's rows in metres; nan without any."""
        low, high = np.full(2, np.nan), np.full(2, np.nan)
        for batch in self.batches(["bbox"], tile):
            box = batch.column("bbox").drop_null()
            if len(box):
                x0, y0, x1, y1 = (np.asarray(values) for values in box.flatten())
                low, high = np.fmin(low, [x0.min(), y0.min()]), np.fmax(high, [x1.max(), y1.max()])
        found: FloatArray = np.concatenate([low, high]) * self.reference.horizontal_unit_m
        return found

    def near(self, tile: str, reach_m: float) -> list[str]:
        """The tiles whose rows may be within a distance of a tile's, itself among them."""
        x0, y0, x1, y1 = self.bounds[self.tiles.index(tile)]
        others = self.bounds
        with np.errstate(invalid="ignore"):  # tiles without rows are near to none
            apart_x = np.maximum(others[:, 0] - x1, x0 - others[:, 2])
            apart_y = np.maximum(others[:, 1] - y1, y0 - others[:, 3])
            found = np.maximum(apart_x, apart_y) <= reach_m
        return [name for name, is_near in zip(self.tiles, found, strict=True) if is_near]
