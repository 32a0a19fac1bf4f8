"""Rasters as cloud-optimised GeoTIFF (COG): a lattice anchored at the CRS's origin, written window by window.

GDAL can only make a COG from a finished raster, so the windows go into a sparse tiled GeoTIFF first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import SettingsError

NO_VALUE = -9999.0
"""What a cell without a value holds."""
BLOCK = 512
"""Side of the blocks of the files, in cells."""
CACHE_BYTES = 128 << 20
"""What GDAL may keep of a raster in memory."""
MAX_SIDE = 2**31 - 1 - BLOCK
"""Cells along a side; GDAL counts in 32 bits."""

Cells = npt.NDArray[np.float32]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RasterLattice:
    """Square cells over some area; cell (0, 0) begins at the CRS's origin, rows count northwards."""

    cell: float
    """Side of a cell in units of the CRS."""
    unit_m: float
    """Metres a horizontal unit of the CRS."""
    column0: int
    """First column of the area."""
    row0: int
    """First, southernmost row of the area."""
    columns: int
    """Columns of the area."""
    rows: int
    """Rows of the area."""

    def __post_init__(self) -> None:
        """Refuse what no file can hold."""
        if max(self.columns, self.rows) > MAX_SIDE:
            raise SettingsError([f"raster cell is {self.cell:g}: {self.columns} by {self.rows} cells are too many"])

    @classmethod
    def over(cls, bounds_m: tuple[float, float, float, float], cell: float, unit_m: float) -> RasterLattice:
        """The cells that x_min, y_min, x_max, y_max in metres meet.

        Raises SettingsError if the cell has no extent, or the area too many cells.
        """
        if not (math.isfinite(cell) and cell > 0.0):
            raise SettingsError([f"raster cell is {cell:g}: use a length above 0 in units of the CRS"])
        side = cell * unit_m
        column0, row0 = math.floor(bounds_m[0] / side), math.floor(bounds_m[1] / side)
        return cls(
            cell=cell,
            unit_m=unit_m,
            column0=column0,
            row0=row0,
            columns=math.floor(bounds_m[2] / side) - column0 + 1,
            rows=math.floor(bounds_m[3] / side) - row0 + 1,
        )

    @property
    def side_mm(self) -> float:
        """Side of a cell in millimetres."""
        return self.cell * self.unit_m * 1000.0

    def first(self, border_mm: int) -> int:
        """Column or row of the first cell whose centre is not before a border: tiles share cells out without gaps."""
        return math.ceil(border_mm / self.side_mm - 0.5)


def write_cog(
    path: Path,
    working: Path,
    lattice: RasterLattice,
    windows: Iterable[tuple[int, int, Cells]],
    *,
    crs_wkt: str | None,
    description: str,
    unit: str,
) -> None:
    """Write a raster of one band; its CRS is compound if the values are elevations in it.

    A `working` file, which must not exist, holds the raster meanwhile and is removed. `windows` are first column and
    southernmost row on the lattice, and (rows, columns) float32 values with the southernmost row first, nan for none.
    """
    import rasterio
    import rasterio.shutil
    from rasterio.crs import CRS
    from rasterio.windows import Window

    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": lattice.columns,
        "height": lattice.rows,
        "count": 1,
        "dtype": "float32",
        "nodata": NO_VALUE,
        "crs": None if crs_wkt is None else CRS.from_wkt(crs_wkt),
        "transform": rasterio.Affine(
            lattice.cell,
            0.0,
            lattice.column0 * lattice.cell,
            0.0,
            -lattice.cell,
            (lattice.row0 + lattice.rows) * lattice.cell,
        ),
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": BLOCK,
        "SPARSE_OK": True,
        "BIGTIFF": "IF_SAFER",
        "GEOTIFF_VERSION": "1.1",
    }
    with rasterio.Env(GDAL_CACHEMAX=CACHE_BYTES, GDAL_TIFF_INTERNAL_MASK=False):
        try:
            with rasterio.open(working, "w", **profile) as raster:
                raster.set_band_description(1, description)
                raster.units = (unit,)
                for column, row, cells in windows:
                    left, low = column - lattice.column0, row - lattice.row0
                    x0, y0 = max(left, 0), max(low, 0)
                    x1, y1 = min(left + cells.shape[1], lattice.columns), min(low + cells.shape[0], lattice.rows)
                    if x0 >= x1 or y0 >= y1:
                        continue
                    part = cells[y0 - low : y1 - low, x0 - left : x1 - left]
                    if np.isnan(part).all():
                        continue
                    upright = np.where(np.isnan(part), np.float32(NO_VALUE), part)[::-1]
                    raster.write(upright, 1, window=Window(x0, lattice.rows - y1, x1 - x0, y1 - y0))
            rasterio.shutil.copy(
                working,
                path,
                driver="COG",
                BLOCKSIZE=BLOCK,
                COMPRESS="DEFLATE",
                PREDICTOR="FLOATING_POINT",
                OVERVIEW_RESAMPLING="AVERAGE",
                BIGTIFF="IF_SAFER",
                SPARSE_OK=True,
                GEOTIFF_VERSION="1.1",
                NUM_THREADS=1,
            )
        finally:
            working.unlink(missing_ok=True)
            working.with_name(f"{working.name}.aux.xml").unlink(missing_ok=True)
