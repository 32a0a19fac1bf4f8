"""Layers that GDAL writes from a stream of batches, so memory does not grow with the run."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.errors import RunError


def write_layer(
    path: Path, name: str, schema: pa.Schema, batches: Iterable[pa.RecordBatch], driver: str, **options: Any
) -> int:
    """Write a stream of batches as a layer of a file; returns the number of rows.

    Raises RunError if the file cannot be written, and whatever the `batches` raise.

    Parameters
    ----------
    path : Path
        The file, which no one else reads yet. The caller brings it to the disk.
    name : str
        Name of the layer.
    schema : pyarrow.Schema
        That of the batches.
    batches : iterable of pyarrow.RecordBatch
        The rows; one batch after the other is held in memory.
    driver : str
        GDAL's name of the format.
    options
        Those of `pyogrio.raw.write_arrow`.
    """
    import pyogrio.raw

    stream = _Stream(batches)
    with warnings.catch_warnings():
        # an unknown CRS is stored as unknown
        warnings.filterwarnings("ignore", message="'crs' was not provided")
        try:
            pyogrio.raw.write_arrow(
                pa.RecordBatchReader.from_batches(schema, iter(stream)), path, layer=name, driver=driver, **options
            )
        except (RuntimeError, OSError) as fault:  # those of pyogrio are RuntimeErrors
            if stream.fault is not None:
                raise stream.fault from None
            raise RunError(
                f"layer {name} cannot be written to {path.name}: {str(fault)[:160]}. Free space, or give another --out"
            ) from fault
    return stream.rows


@contextlib.contextmanager
def gdal_options(options: Mapping[str, str]) -> Iterator[None]:
    """Set options of GDAL, which are those of the whole process, and set them back."""
    import pyogrio

    before = {name: pyogrio.get_gdal_config_option(name) for name in options}
    pyogrio.set_gdal_config_options(dict(options))
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options(before)


class _Stream:
    """Batches on their way through C, which loses their errors: counted, and the error kept."""

    def __init__(self, batches: Iterable[pa.RecordBatch]) -> None:
        self._batches = batches
        self.rows = 0
        self.fault: BaseException | None = None

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        try:
            for batch in self._batches:
                self.rows += batch.num_rows
                yield batch
        except BaseException as fault:
            self.fault = fault
            raise
