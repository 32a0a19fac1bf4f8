"""Reading of point clouds and footprints, and storage of results."""

from pipeline.io.crs import SpatialReference
from pipeline.io.inputs import find_inputs
from pipeline.io.locations import is_url, shown
from pipeline.io.places import arrow_at, place_below, storage_at
from pipeline.io.source import ReadOptions, Source, SourceInfo, open_source
from pipeline.io.storage import LocalStorage, Storage, sha256_of

__all__ = [
    "LocalStorage",
    "ReadOptions",
    "Source",
    "SourceInfo",
    "SpatialReference",
    "Storage",
    "arrow_at",
    "find_inputs",
    "is_url",
    "open_source",
    "place_below",
    "sha256_of",
    "shown",
    "storage_at",
]
