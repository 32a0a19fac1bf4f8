"""Records as a property table in glTF (EXT_structural_metadata): which columns it has, of which types, and their bytes.

A table has the columns of the building record by the same names, without those of shapes, and `tile`. `columns.KINDS`
says what each type of Arrow becomes. The rules are those of the extension and of the 3D Metadata Specification (OGC
22-025r4, section 11).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.errors import RunError
from pipeline.export.columns import KINDS, kind_of, text_of
from pipeline.export.record_rows import BUILDINGS
from pipeline.export.solid_geometry import SHAPE_COLUMNS

NO_NUMBER = -1.7976931348623157e308
"""Null of a floating-point column: the lowest number of 64 bits."""
NO_INTEGER = -(2**31)
"""Null of a column of 32-bit integers."""
NO_TEXT = ""
"""Null of a column of texts: an empty text there is read as null, too."""
TILE = "tile"
"""The column that the folders' names carry."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredColumn:
    """One property of a class."""

    name: str
    """Name, that of the column."""
    kind: str
    """An entry of `columns.KINDS`."""
    nullable: bool
    """Whether it has a value for null (`noData`); a column of only nulls is left out of a table."""

    @property
    def definition(self) -> dict[str, Any]:
        """The property in the class."""
        words = KINDS[self.kind].tiles.split(", ")
        found: dict[str, Any] = {"type": words[0]}
        if words[0] == "SCALAR":
            found["componentType"] = words[1]
        if self.nullable:
            found["noData"] = self.no_data
        else:
            found["required"] = True
        return found

    @property
    def no_data(self) -> float | int | str:
        """What is stored for null."""
        return {"int32": NO_INTEGER, "int64": NO_NUMBER, "double": NO_NUMBER}.get(self.kind, NO_TEXT)

    def stored(self, values: Sequence[Any]) -> tuple[bytes, bytes | None]:
        """Values as bytes, and of texts the bytes of their offsets."""
        if self.kind == "bool":
            return np.packbits(np.array(values, bool), bitorder="little").tobytes(), None
        filled = [self.no_data if value is None else value for value in values]
        if self.kind in {"int32", "int64", "double"}:
            return np.array(filled, "<i4" if self.kind == "int32" else "<f8").tobytes(), None
        texts = [(text_of(value) or NO_TEXT).encode() for value in filled]
        return b"".join(texts), np.cumsum([0, *map(len, texts)]).astype("<u4").tobytes()


def stored_column(field: pa.Field) -> StoredColumn:
    """A column of a table as a property; raises RunError if there is no type for it."""
    kind = kind_of(field.type)
    if kind not in KINDS or KINDS[kind].tiles == "none" or (kind == "bool" and field.nullable):
        raise RunError(
            f"column {field.name} has type {field.type}{' with nulls' if field.nullable else ''}, for which 3D Tiles "
            "have none: add it to the mapping"
        )
    return StoredColumn(name=field.name, kind=kind, nullable=field.nullable)


COLUMNS = (
    *(stored_column(field) for field in BUILDINGS if field.name not in {"geometry", *SHAPE_COLUMNS}),
    StoredColumn(name=TILE, kind="string", nullable=False),
)
"""The properties of a building: its record without shapes, which are what is drawn."""
BLOCK_COLUMNS = tuple(c for c in COLUMNS if c.name in {"building_id", "status", "roof_type", "height_m", TILE})
"""The properties of a coarse block."""
