"""Where an epoch has data: the bounds of its inputs, its tiles, its area of interest."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipeline.errors import GableworkError
from pipeline.extras.footprints.footprints_file import read_area
from pipeline.io.crs import SpatialReference
from pipeline.io.storage import sha256_of
from pipeline.model import FloatArray
from pipeline.ruler.evaluation.building_matching import share_in_extent
from pipeline.runtime.manifest import RunManifest


@dataclasses.dataclass(frozen=True, kw_only=True)
class Coverage:
    """Where a run has data, in metres."""

    area: Any
    """Common area of the inputs, the tiles and the area of interest; None if run.json does not record it."""
    failed: Any
    """The tiles that failed; empty if none did."""
    notes: tuple[str, ...]
    """Unknown facts, one sentence each."""

    def shrunk(self, edge_m: float) -> Coverage:
        """Without places nearer to the end of the data than `edge_m`."""
        area = None if self.area is None else self.area.buffer(-edge_m, join_style="mitre")
        return dataclasses.replace(self, area=area)

    def share(self, footprints: Any) -> FloatArray:
        """Share of each footprint, (n,), that is covered and not in a failed tile; 1 if the coverage is unknown."""
        share = np.ones(len(footprints)) if self.area is None else share_in_extent(footprints, self.area)
        return share if self.failed.is_empty else np.maximum(share - share_in_extent(footprints, self.failed), 0.0)

    def touches_failed(self, footprints: Any) -> Any:
        """Which footprints, (n,) bool, reach into a tile that failed."""
        return shapely.intersects(self.failed, footprints)


def coverage_of(manifest: RunManifest, reference: SpatialReference) -> Coverage:
    """The coverage of a run from its manifest.

    Runs of earlier versions record neither the lattice nor the bounds of their inputs; missing facts do not narrow the
    coverage, and a note says so.
    """
    notes, area = [], None
    bounds = [entry.bounds_m for entry in manifest.inputs if entry.bounds_m is not None]
    if bounds:
        area = shapely.union_all(shapely.box(*np.array(bounds).T))
    failed: Any = shapely.Polygon()
    if manifest.lattice and manifest.tiles:
        tiles = shapely.union_all(manifest.squares(sorted(manifest.tiles)))
        area = tiles if area is None else shapely.intersection(area, tiles)
        failed = shapely.union_all(manifest.squares(sorted(manifest.failed_tiles)))
    if area is None:
        notes.append(
            "run.json does not record where its data lie: buildings outside cannot be distinguished from new or gone"
        )
    elif not bounds:
        notes.append("run.json does not record the bounds of its inputs: coverage is that of whole tiles")
    aoi = manifest.request.get("aoi")
    if aoi is not None and area is not None:
        drawn = _area_of_interest(str(aoi), manifest, reference)
        if drawn is None:
            notes.append(f"its area of interest {aoi} is not there as the run read it: coverage is not cut to it")
        else:
            area = shapely.intersection(area, drawn)
    return Coverage(area=area, failed=failed, notes=tuple(notes))


def _area_of_interest(path: str, manifest: RunManifest, reference: SpatialReference) -> Any | None:
    """The polygons of the file in metres; None if it is missing or has changed."""
    known = {entry.path: entry.sha256 for entry in manifest.inputs}
    if not Path(path).is_file() or known.get(path) != sha256_of(path):
        return None
    try:
        area = read_area(path, reference)
    except GableworkError:
        return None
    unit_m = reference.horizontal_unit_m
    return area if unit_m == 1.0 else shapely.transform(area, lambda xy: xy * unit_m)
