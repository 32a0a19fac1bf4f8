"""Tile indexes: files that name point files, as survey offices publish them.

There are two kinds. A text file has one path or URL per line; blank lines and comments (#) are skipped. A vector file
(any that footprints may be in) has one feature per tile, its outline, and a column that names the file:
the first of `COLUMNS` that exists (in any case), else the only column in which every value names a point file or is a
URL. Relative names begin at the index.
"""

from __future__ import annotations

import dataclasses
import posixpath
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import urljoin, urlsplit

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.errors import UnreadableInputError
from pipeline.extras.vector_files.nearby import TILES
from pipeline.extras.vector_files.vector_layer import read_layer
from pipeline.io.crs import SpatialReference, horizontal_part
from pipeline.io.crs_given import parse_crs
from pipeline.io.formats import POINT_SUFFIXES, VECTOR_SUFFIXES, lines_of, names_points
from pipeline.io.locations import is_url, name_in, shown
from pipeline.io.places import file_at

if TYPE_CHECKING:
    import pyproj

COLUMNS = ("location", "path", "url", "href", "filename", "file_name", "file", "name")
"""Columns that name the file of a tile, in this order."""
AROUND = 100.0
"""How far off an area, in the units of its CRS, a tile is still taken: outlines are those of the nominal sheets, and
those of another CRS bend."""
_LONGEST_TEXT = 1 << 26


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileIndex:
    """The files that an index names."""

    path: str
    """The index, for messages."""
    locations: tuple[str, ...]
    """Paths and URLs, each once, in the index's order."""
    outlines: npt.NDArray[np.object_] | None = None
    """(n,) shapely geometries, None where a tile has none; None as a whole of text files."""
    crs: str | None = None
    """CRS of the outlines, as the index has it; None if unknown."""

    def within(self, area: shapely.Geometry, reference: SpatialReference) -> tuple[str, ...]:
        """The files whose tiles come near an area; of what has no outline all."""
        if self.outlines is None:
            return self.locations
        boxes = self._boxes_in(reference)
        near: npt.NDArray[np.bool_] = shapely.dwithin(area, boxes, AROUND) | shapely.is_missing(boxes)
        return tuple(location for location, there in zip(self.locations, near.tolist(), strict=True) if there)

    def _boxes_in(self, reference: SpatialReference) -> npt.NDArray[np.object_]:
        """The boxes around the outlines in the inputs' CRS; None if they cannot be computed."""
        assert self.outlines is not None
        bounds = shapely.bounds(self.outlines)
        own: pyproj.CRS | None = None if self.crs is None else horizontal_part(parse_crs(self.crs, path=self.path))
        target = reference.horizontal_crs
        if own is not None and target is not None and not own.equals(target, ignore_axis_order=True):
            import pyproj

            known = np.flatnonzero(np.isfinite(bounds).all(axis=1))
            try:
                project = pyproj.Transformer.from_crs(own, target, always_xy=True).transform_bounds
            except pyproj.exceptions.ProjError:  # one has no place on Earth: any tile may be near
                return np.full(len(bounds), None, dtype=object)
            found = [project(x0, y0, x1, y1, 21) for x0, y0, x1, y1 in bounds[known].tolist()]
            bounds[known] = np.reshape(found, (-1, 4))
        placed = np.isfinite(bounds).all(axis=1) & (bounds[:, 0] <= bounds[:, 2]) & (bounds[:, 1] <= bounds[:, 3])
        boxes = np.full(len(bounds), None, dtype=object)
        boxes[placed] = shapely.box(bounds[placed, 0], bounds[placed, 1], bounds[placed, 2], bounds[placed, 3])
        return boxes


def read_tile_index(location: str) -> TileIndex:
    """The files that an index names.

    Raises UnreadableInputError if it cannot be read, names nothing, or does not say which column names the files.
    """
    label = shown(location)
    if PurePosixPath(name_in(location)).suffix.lower() in VECTOR_SUFFIXES:
        names, outlines, crs = _of_layer(location)
    else:
        names, outlines, crs = _of_text(location), None, None
    whole = [_whole(location, name) for name in names]
    first = {name: k for k, name in reversed(list(enumerate(whole)))}
    rows = sorted(first.values())
    if not rows:
        raise UnreadableInputError(label, "the tile index names no files", "Check the index")
    return TileIndex(
        path=label,
        locations=tuple(whole[k] for k in rows),
        outlines=None if outlines is None else outlines[rows],
        crs=crs,
    )


def _of_text(location: str) -> list[str]:
    """The lines of a text index."""
    file = file_at(location)
    try:
        with file.open("rb") as stream:
            text = stream.read(_LONGEST_TEXT).decode("utf-8-sig")
    except OSError as fault:
        raise UnreadableInputError(
            str(file), f"cannot be read ({fault.strerror or fault})", "Check the path and its permissions"
        ) from fault
    except UnicodeDecodeError as fault:
        raise UnreadableInputError(str(file), f"a tile index must be UTF-8 ({fault})", "Write it again") from fault
    lines = lines_of(text)
    strange = next((line for line in lines if not names_points(line)), None)
    if strange is not None:
        raise UnreadableInputError(
            str(file),
            f"the line {strange[:80]!r} names no point file",
            f"Name one file or URL a line; files end in {', '.join(POINT_SUFFIXES)}",
        )
    return lines


def _of_layer(location: str) -> tuple[list[str], npt.NDArray[np.object_], str | None]:
    """Names, outlines and CRS of a vector index."""
    layer = read_layer(location, None, shape=TILES)
    column = _column(shown(location), layer.columns)
    rows = [k for k, value in enumerate(layer.columns[column]) if isinstance(value, str) and value.strip()]
    return [str(layer.columns[column][k]).strip() for k in rows], layer.geometries[rows], layer.crs


def _column(label: str, columns: Mapping[str, Sequence[Any]]) -> str:
    """The column that names the files."""
    of_name = {str(name).lower(): str(name) for name in columns}
    for name in COLUMNS:
        if name in of_name and _names(columns[of_name[name]]):
            return of_name[name]
    found = [str(name) for name, values in columns.items() if _names(values)]
    if len(found) == 1:
        return found[0]
    what = f"{len(found)} columns name files ({', '.join(found)})" if found else "no column names point files"
    raise UnreadableInputError(
        label,
        f"{what}; its columns are {', '.join(map(str, columns)) or '(none)'}",
        f"Name the column that counts {COLUMNS[0]}, or write the files into a text file, one a line",
    )


def _names(values: Sequence[Any]) -> bool:
    """Whether a column names point files: all values that there are, and one at least."""
    there = [value for value in values if value is not None and value == value and value != ""]  # noqa: PLR0124 - nan
    return bool(there) and all(isinstance(value, str) and names_points(value) for value in there)


def _whole(index: str, name: str) -> str:
    """A name of an index as a path or URL."""
    if is_url(name):
        return name
    if not is_url(index):
        return str(Path(index).parent / name)
    if PurePosixPath(name).is_absolute() and index.lower().startswith("s3://"):
        raise UnreadableInputError(
            shown(index), f"it names {name!r}, a file of this machine", "Name files by URLs, or relative to the index"
        )
    if index.lower().startswith("s3://"):
        bucket, _, key = index[len("s3://") :].partition("/")
        joined = posixpath.normpath(posixpath.join(posixpath.dirname(key), name))
        return f"s3://{bucket}/{joined.removeprefix('../')}"
    # as a browser would; the query of a signed index is that of the index alone
    return urljoin(urlsplit(index)._replace(query="", fragment="").geturl(), name)
