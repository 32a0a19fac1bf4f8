"""The buildings of a run that goes on, in the form of the outputs: the same index, features and CityJSON files.

The files of features and of CityJSON only grow. The index comes after them and says what is there, so readers never
see half a building. The next writer of the same folder cuts off what the index does not know.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Self

from pipeline.export.facts import RecordContext
from pipeline.export.records import plane_rows
from pipeline.export.tile import building_rows, city_lines
from pipeline.io.storage import LocalStorage
from pipeline.runtime.stages.model_batch import StoredResult
from service.outputs.building_index import FEATURES_NAME, NAME, GrowingIndexFile
from service.outputs.catalogue import NAME as CATALOGUE_NAME
from service.outputs.catalogue import Catalogue
from service.outputs.footprints import Wgs84Transformation, feature_texts
from service.outputs.single_building import cityjson_path


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
        self._to_wgs84 = Wgs84Transformation.of_run(crs)
        self._stack = ExitStack()
        self._corners: dict[str, list[float]] = {}
        folder.mkdir(exist_ok=True)

    def __enter__(self) -> Self:
        """Open the files, and cut off what the index does not know."""
        self._index = self._stack.enter_context(GrowingIndexFile(self._folder / NAME))
        self.batches = self._index.batches
        """Names of the batches that are there."""
        sizes = self._index.city_sizes
        for path in self._folder.glob("cityjson/*/*"):
            tile = path.parent.name.removeprefix("tile=")
            if tile in sizes:
                os.truncate(path, sizes[tile])
            else:
                path.unlink()
        features = self._folder / FEATURES_NAME
        features.touch()
        os.truncate(features, self._index.features_size)
        self._features = self._stack.enter_context(features.open("ab"))
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
        with self._city_file(tile) as stream:
            lines = city_lines(results, rows, context, f"buildings of tile {tile}", self._corners.get(tile))
            places = self._add_city(tile, stream, lines)
        for result, feature in zip(
            results, feature_texts([{**row, "tile": tile} for row in rows], self._to_wgs84), strict=True
        ):
            start = self._features.tell()
            self._features.write(feature.text + b"\n")
            self._index.add(
                record=feature.record,
                feature=(start, len(feature.text), feature.geometry_start, feature.geometry_size),
                native=feature.native,
                city=places[feature.building_id],
                planes=[_without_shape(row) for row in plane_rows(result, context)],
                decisions=(),
                bounds=feature.bounds,
                bounds_deg=feature.bounds_deg,
            )
        self._index.add_batch(batch)
        self.batches.add(batch)

    def show(self) -> None:
        """Let readers see what was added since."""
        self._features.flush()
        self._index.show()
        catalogue = Catalogue(outputs={}, crs=self._to_wgs84.crs, n_buildings=self._index.n_buildings)
        LocalStorage(root=self._folder).put(CATALOGUE_NAME, catalogue.to_json().encode())

    @contextmanager
    def _city_file(self, tile: str) -> Iterator[BinaryIO]:
        path = cityjson_path(self._folder, tile)
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as stream:
            if stream.tell() and tile not in self._corners:
                stream.seek(0)
                self._corners[tile] = json.loads(stream.readline())["transform"]["translate"]
                stream.seek(0, os.SEEK_END)
            yield stream

    def _add_city(self, tile: str, stream: BinaryIO, lines: Iterator[str]) -> dict[str, tuple[int, int]]:
        """Append features to a tile's file; start and size of each building's line."""
        header = next(lines)
        if tile not in self._corners:
            self._corners[tile] = json.loads(header)["transform"]["translate"]
            stream.write(f"{header}\n".encode())
        places = {}
        for line in lines:
            text = line.encode()
            places[json.loads(line)["id"]] = (stream.tell(), len(text))
            stream.write(text + b"\n")
        return places


def _without_shape(row: dict[str, Any]) -> dict[str, Any]:
    """A row of the table of planes as the outputs have it with the building."""
    return {name: value for name, value in row.items() if name not in {"geometry", "building_id"}}
