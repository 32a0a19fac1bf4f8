"""Reading of point clouds and footprints, and storage of results."""

from pipeline.io.crs import SpatialReference
from pipeline.io.formats import find_inputs
from pipeline.io.source import ReadOptions, Source, SourceInfo, open_source

__all__ = ["ReadOptions", "Source", "SourceInfo", "SpatialReference", "find_inputs", "open_source"]
