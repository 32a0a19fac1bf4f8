"""The buildings of a run that goes on: an index that grows, and a file with their city objects.

The file only grows. The index comes after it and says what is there, so readers never see half a building. The next
writer of the same folder cuts off what the index does not know.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import pyarrow as pa

from pipeline.export.facts import RecordContext
from pipeline.export.record_rows import SCHEMAS, plane_rows
from pipeline.export.tile import building_rows, city_lines
from pipeline.runtime.stages.model_batch import StoredResult
from service.features.feature_writing import GrowingIndex
from service.features.index import NAME
from service.outputs.catalogue import Catalogue, ResultsCrs
from service.outputs.single_building import SO_FAR_CITY


class BuildingsSoFar:
    """Writes the buildings of a run that goes on, batch after batch; a context manager.

    Parameters
    ----------
    folder : Path
        Where to write; made if it is missing, continued if it is there.
    context : RecordContext
        Facts of the run.
    crs : mapping, optional
        The `crs` entry of run.json.
    """

    def __init__(self, folder: Path, context: RecordContext, crs: Mapping[str, Any] | None) -> None:
        self._folder = folder
        self._context = context
        self._crs = crs
        self._stack = ExitStack()
        folder.mkdir(exist_ok=True)

    def __enter__(self) -> Self:
        """Open the files, and cut off what the index does not know."""
        self._index = self._stack.enter_context(GrowingIndex(self._folder / NAME, self._crs))
        self.batches = self._index.batches
        """Names of the batches that are there."""
        city = self._folder / SO_FAR_CITY
        city.touch()
        os.truncate(city, self._index.figure("SELECT coalesce(max(start + size), 0) FROM city"))
        self._city = self._stack.enter_context(city.open("ab"))
        return self

    def __exit__(self, *raised: object) -> None:
        """Close the files; what was not shown is added again by the next writer."""
        self._stack.close()

    def add(self, batch: str, tile: str, stored: Sequence[StoredResult]) -> None:
        """Append the buildings of a batch, which belong to one tile."""
        results = [entry.result for entry in stored]
        facts = {entry.result.building_id: entry.facts for entry in stored}
        context = dataclasses.replace(self._context, facts=facts)
        # meshes are written only when the whole tile is published
        rows = building_rows(results, context, tile, "none")
        header, *lines = city_lines(results, rows, context, f"buildings of tile {tile}")
        for line in lines:
            text = f"{header}\n{line}\n".encode()
            place = (json.loads(line)["id"], self._city.tell(), len(text))
            self._index.connection.execute("INSERT INTO city VALUES (?,?,?)", place)
            self._city.write(text)
        planes = [row for result in results for row in plane_rows(result, context)]
        for table, found in (("buildings", rows), ("planes", planes)):
            self._index.add(table, tile, pa.Table.from_pylist(found, SCHEMAS[table]))
        self._index.connection.execute("INSERT INTO batch VALUES (?)", (batch,))
        self.batches.add(batch)

    def show(self) -> None:
        """Let readers see what was added since."""
        self._city.flush()
        self._index.show()
        count = self._index.figure("SELECT count(*) FROM buildings")
        Catalogue(outputs={}, crs=ResultsCrs.of(self._index.crs), n_buildings=count).write(self._folder)
