"""One layer of a vector file, read by GDAL."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.errors import UnreadableInputError
from pipeline.extras.vector_files.gdal_source import VALID, WHAT, GdalSource, gdal_source
from pipeline.extras.vector_files.nearby import BATCH, Boxes, Nearby, Shape, VectorLayer, cells_limit
from pipeline.extras.vector_files.vector_text import BYTES, Texts, without_controls
from pipeline.io.library_faults import in_our_words
from pipeline.io.reading import moved

_Batch: TypeAlias = tuple[npt.NDArray[np.int64], npt.NDArray[np.object_]]
"""Feature ids and WKB of some features."""


def read_by_gdal(path: Path, layer: str | None, boxes: Boxes | None, shape: Shape) -> VectorLayer:
    """The layer, as `pipeline.extras.vector_files.vector_layer.read_layer` describes it.

    Raises UnreadableInputError if the file cannot be read, has not the layer, has too many values near the
    boxes, or names a server that knows its CRS.
    """
    with gdal_source(path) as source:
        return _read_source(path, source, layer, boxes, shape)


def _read_source(path: Path, source: GdalSource, layer: str | None, boxes: Boxes | None, shape: Shape) -> VectorLayer:
    """The layer of a file as GDAL is given it."""
    import pyogrio

    about = None
    with in_our_words(path, WHAT, VALID):
        if source.is_one_document:
            about = pyogrio.read_info(source.name, encoding=BYTES, force_feature_count=True)
            layers = {str(about["layer_name"]): about["geometry_type"]}
        else:
            layers = {str(name): kind for name, kind in pyogrio.list_layers(source.name)}
    name = _chosen(path, layers, layer, shape)
    near, nearby = (None, None) if boxes is None else _near(path, source, name, boxes, shape)
    with in_our_words(path, WHAT, VALID):
        about = about or pyogrio.read_info(source.name, layer=name, encoding=BYTES, force_feature_count=near is None)
        _check_cells(path, about["features"] if near is None else len(near), len(about["fields"]))
        meta, feature_ids, wkb, columns, is_decoded = _read(source, name, near)
    none = near is not None and len(near) == 0
    kept = slice(0, 0) if none else slice(None)
    feature_ids = feature_ids[kept].astype(np.int64)
    texts = Texts()
    named: dict[str, Sequence[Any]] = {}
    for field, column in zip(meta["fields"], columns, strict=True):
        if is_decoded:
            title = without_controls(str(field))
        else:
            raw = str(field).encode(BYTES)
            title = texts.of_bytes(raw, f"the name of column {raw!r}")
        values: Any = column[kept]
        if is_decoded and values.dtype == object:
            values = [without_controls(value) for value in values]
        elif values.dtype == object:
            rows = feature_ids.tolist()
            values = [texts.of_value(value, title, row) for value, row in zip(values, rows, strict=True)]
        if title != "gml_id" or values != [f"{name}.{number}" for number in feature_ids.tolist()]:
            named[title] = values  # else GDAL made the ids up when it wrote the file
    return VectorLayer.of(
        wkb[kept],
        feature_ids=feature_ids,
        columns=named,
        elsewhere=(nearby or Nearby(None, meta["crs"])).elsewhere,
        warnings=texts.warnings,
    )


def _chosen(path: Path, layers: dict[str, str | None], layer: str | None, shape: Shape) -> str:
    """The one layer that is wanted."""
    if layer is None:
        # The kind is None for tables without geometry and "Unknown" where a layer does not say.
        found = [name for name, kind in layers.items() if kind and (shape.word in kind or "Unknown" in kind)]
        found = found or [name for name, kind in layers.items() if kind]
    else:
        found = [name for name in layers if name == layer]
    if len(found) != 1:
        raise UnreadableInputError(
            str(path),
            f"layer {layer!r} is not there" if layer else f"{len(found)} layers could be the {shape.named}",
            f"{shape.choose}: {', '.join(sorted(layers)) or '(there are none)'}",
        )
    return found[0]


def _check_cells(path: Path, features: int, columns: int) -> None:
    """Refuse a layer with so many values that holding the empty ones is too much."""
    limit = cells_limit(path.stat().st_size)
    if features * columns > limit:
        raise UnreadableInputError(
            str(path),
            f"it has {features} features with {columns} columns each: more than {limit} values for its size",
            "Leave out columns, or cut out the area of the points",
        )


def _read(
    source: GdalSource, layer: str, near: npt.NDArray[np.int64] | None
) -> tuple[dict[str, Any], npt.NDArray[np.int64], npt.NDArray[np.object_], list[npt.NDArray[Any]], bool]:
    """Facts, feature ids, WKB and columns of a layer, and whether its text is decoded or one character per byte."""
    import pyogrio

    none = near is not None and len(near) == 0
    options = {
        "layer": layer,
        "return_fids": True,
        "fids": None if none else near,
        "max_features": 1 if none else None,  # without any feature GDAL gives no columns
    }
    if not source.states_encoding:
        return *pyogrio.raw.read(source.name, encoding=BYTES, **options), False
    try:
        found = pyogrio.raw.read(source.name, **options)  # GDAL follows the encoding
        return *found, found[0]["encoding"] != BYTES
    except UnicodeDecodeError:  # it declares UTF-8 and is not
        return *pyogrio.raw.read(source.name, encoding=BYTES, **options), False


def _near(
    path: Path, source: GdalSource, layer: str, boxes: Boxes, shape: Shape
) -> tuple[npt.NDArray[np.int64] | None, Nearby]:
    """The ids of the features near the boxes, None where all are; and what is known of those that are not."""
    kept = [np.empty(0, np.int64)]
    passed_over = 0
    with in_our_words(path, WHAT, VALID), _opened(source.name, layer) as (crs, batches):
        nearby = Nearby(boxes, crs, shape)
        if nearby.all:
            return None, nearby
        for feature_ids, wkb in batches:
            near = nearby.of(wkb)
            kept.append(feature_ids[near])
            passed_over += int(np.count_nonzero(~near))
    return (np.concatenate(kept) if passed_over else None), nearby


@contextlib.contextmanager
def _opened(source: str, layer: str) -> Iterator[tuple[str | None, Iterator[_Batch]]]:
    """CRS of a layer, and its ids and WKB in batches."""
    import pyogrio

    with contextlib.ExitStack() as stack:
        try:
            meta, reader = stack.enter_context(
                pyogrio.raw.open_arrow(
                    source, layer=layer, columns=[], batch_size=BATCH, return_fids=True, use_pyarrow=True
                )
            )
        except UnicodeDecodeError:  # a column's name; only this way takes an encoding
            meta, ids, wkb, _ = pyogrio.raw.read(source, layer=layer, columns=[], return_fids=True, encoding=BYTES)
            yield meta["crs"], iter([(ids.astype(np.int64), wkb)])
            return
        yield meta["crs"], _batches(meta["geometry_name"] or "wkb_geometry", reader)


def _batches(geometry: str, reader: Any) -> Iterator[_Batch]:
    """Ids and WKB of the batches of an Arrow reader."""
    number = next(name for name in reader.schema.names if name != geometry)
    for batch in reader:
        moved()
        wkb = np.array([*batch.column(geometry).to_pylist(), None], dtype=object)[:-1]
        yield np.asarray(batch.column(number), dtype=np.int64), wkb
