"""Outlines of buildings that people drew, in the CRS of the models."""

from __future__ import annotations

import dataclasses

import shapely

from pipeline.extras.footprints.footprints_file import read_footprints
from pipeline.extras.footprints.placed_features import off_the_data
from pipeline.io import shown, storage_at
from pipeline.io.crs import SpatialReference
from pipeline.io.crs_resolution import resolve_reference
from pipeline.io.places import file_at
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.runtime.manifest import NAME
from pipeline.runtime.manifest_reading import read_manifest


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutlineSet:
    """The outlines of a file, or of simulated truth."""

    name: str
    """Its name in the report."""
    outlines: tuple[shapely.Geometry, ...]
    """2D (multi)polygons in metres, as they were drawn."""
    notes: tuple[str, ...] = ()
    """Omissions of the reader, as sentences for the report."""


def read_outlines(path: str, layer: str | None, models: ModelSet) -> OutlineSet:
    """The outlines of a vector file around some models.

    Raises InputError if it cannot be read, or none of them is where the models are.
    """
    reference = _reference_of(models)
    area = shapely.box(*shapely.total_bounds([model.footprint for model in models.models])) if models.models else None
    given = read_footprints(path, reference, layer=layer, area=area)
    if area is not None and not any(area.intersects(polygon) for polygon in given.polygons):
        raise off_the_data(shown(path), "footprints", given.elsewhere, area, reference)
    return OutlineSet(name=file_at(path).name, outlines=given.polygons, notes=given.warnings)


def _reference_of(models: ModelSet) -> SpatialReference:
    """The CRS of some models; unknown if nothing states it."""
    if models.kind == "run" and storage_at(models.path).has(NAME):
        return SpatialReference.of_facts(read_manifest(models.path).crs)
    if models.crs is None or not models.crs.startswith("EPSG:"):
        return SpatialReference()
    return resolve_reference(path=models.path, crs=models.crs)[0]
