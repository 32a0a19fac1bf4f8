"""Reading of point clouds and footprints, and storage of results."""

from pipeline.io.crs import SpatialReference
from pipeline.io.footprints import Footprints, read_area, read_footprints
from pipeline.io.formats import find_inputs
from pipeline.io.source import ReadOptions, Source, SourceInfo, open_source
from pipeline.io.storage import LocalStorage, sha256_of

__all__ = [
    "Footprints",
    "LocalStorage",
    "ReadOptions",
    "Source",
    "SourceInfo",
    "SpatialReference",
    "find_inputs",
    "open_source",
    "read_area",
    "read_footprints",
    "sha256_of",
]
