"""The lattice of tiles: anchored at the CRS's origin, half-open, in integer millimetres.

A tile owns [x0, x1) x [y0, y1). Every stage declares how far it looks (its support); the halo around a tile is at least
that wide, and no result depends on where tiles end.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator

import numpy as np

from pipeline.errors import SettingsError
from pipeline.model import BoolArray, IntArray

MM = 1000
"""Millimetres per metre."""

_KEY = re.compile(r"x(0|-?[1-9]\d*)_y(0|-?[1-9]\d*)")


@dataclasses.dataclass(frozen=True, order=True)
class Tile:
    """A cell of the lattice, by its column and row."""

    column: int
    """Index along easting; 0 begins at the lattice's origin."""
    row: int
    """Index along northing."""

    @property
    def key(self) -> str:
        """Name in paths, never a bare integer.

        >>> Tile(85, 447).key
        'x85_y447'
        """
        return f"x{self.column}_y{self.row}"

    @classmethod
    def from_key(cls, key: str) -> Tile:
        """The tile that a key names.

        >>> Tile.from_key("x-1_y447")
        Tile(column=-1, row=447)
        """
        match = _KEY.fullmatch(key)
        if match is None:
            raise ValueError(f"{key!r} is not a tile key: use one such as x85_y447")
        return cls(int(match[1]), int(match[2]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Window:
    """A half-open rectangle in integer millimetres of the metric CRS."""

    x0_mm: int
    """Western border, inside."""
    y0_mm: int
    """Southern border, inside."""
    x1_mm: int
    """Eastern border, outside."""
    y1_mm: int
    """Northern border, outside."""

    def contains(self, x_mm: IntArray, y_mm: IntArray) -> BoolArray:
        """Mask of the points inside; arrays of one shape."""
        inside: BoolArray = (x_mm >= self.x0_mm) & (x_mm < self.x1_mm) & (y_mm >= self.y0_mm) & (y_mm < self.y1_mm)
        return inside

    def grown(self, margin_mm: int) -> Window:
        """The window with a margin on all sides."""
        return Window(
            x0_mm=self.x0_mm - margin_mm,
            y0_mm=self.y0_mm - margin_mm,
            x1_mm=self.x1_mm + margin_mm,
            y1_mm=self.y1_mm + margin_mm,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileGrid:
    """A lattice of square tiles."""

    size_mm: int
    """Side of a tile."""
    halo_mm: int
    """Width of the ring around a tile whose points a stage sees too."""
    origin_x_mm: int = 0
    """Easting of the corner of tile (0, 0): the CRS's origin unless a test moves the lattice."""
    origin_y_mm: int = 0
    """Northing of that corner."""

    def __post_init__(self) -> None:
        """Refuse a lattice without extent, and a halo that shrinks."""
        if self.halo_mm < 0:
            raise SettingsError([f"halo_m is {self.halo_mm / MM:g}: use 0 or more"])
        if self.size_mm < MM:
            raise SettingsError([f"tile_size_m is {self.size_mm / MM:g}: use at least 1 m"])

    def tile_of(self, x_mm: int, y_mm: int) -> Tile:
        """The owner of a point."""
        return Tile((x_mm - self.origin_x_mm) // self.size_mm, (y_mm - self.origin_y_mm) // self.size_mm)

    def columns_rows(self, x_mm: IntArray, y_mm: IntArray) -> tuple[IntArray, IntArray]:
        """Columns and rows of the owners of many points, int64 of the inputs' shape."""
        columns: IntArray = np.floor_divide(x_mm - self.origin_x_mm, self.size_mm)
        rows: IntArray = np.floor_divide(y_mm - self.origin_y_mm, self.size_mm)
        return columns, rows

    def core(self, tile: Tile) -> Window:
        """What a tile owns."""
        x0 = self.origin_x_mm + tile.column * self.size_mm
        y0 = self.origin_y_mm + tile.row * self.size_mm
        return Window(x0_mm=x0, y0_mm=y0, x1_mm=x0 + self.size_mm, y1_mm=y0 + self.size_mm)

    def window(self, tile: Tile) -> Window:
        """What a tile sees: its core and the halo."""
        return self.core(tile).grown(self.halo_mm)

    def tiles_over(self, window: Window) -> Iterator[Tile]:
        """All tiles whose cores meet a window, by column, then row."""
        first = self.tile_of(window.x0_mm, window.y0_mm)
        last = self.tile_of(window.x1_mm - 1, window.y1_mm - 1)
        for column in range(first.column, last.column + 1):
            for row in range(first.row, last.row + 1):
                yield Tile(column, row)
