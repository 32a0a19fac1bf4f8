"""What loads when it is used: tables name it as "module:name"."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any


def loaded(place: str) -> Any:
    """What a "module:name" names; the module is imported at the first call.

    Examples
    --------
    >>> loaded("math:hypot")(3.0, 4.0)
    5.0
    """
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def extra(name: str) -> Any:
    """What an extra does for a run that asks for it; see `EXTRAS`.

    Examples
    --------
    >>> extra("ObjectStorage").__name__
    'ObjectStorage'
    """
    return loaded(f"pipeline.extras.{EXTRAS[name]}")


EXTRAS: Mapping[str, str] = {
    # footprints
    "footprints_of_run": "footprints.given_footprints:footprints_of_run",
    "given_model": "footprints.given_model:given_model",
    "join_footprints": "footprints.footprint_sites:join_footprints",
    "numbers_by_tile": "footprints.given_footprints:numbers_by_tile",
    "read_area": "footprints.footprints_file:read_area",
    "roofs_alone": "footprints.roofs_alone:roofs_alone",
    "with_support_of_seen": "footprints.unseen_slopes:with_support_of_seen",
    "with_unseen_slopes": "footprints.unseen_slopes:with_unseen_slopes",
    "without_voids": "footprints.voids:without_voids",
    # guides
    "followed": "guides.guide_matching:followed",
    "given_guides": "guides.given_guides:given_guides",
    "guide_steps": "guides.guide_matching:guide_steps",
    "guided_faces": "guides.guided_faces:guided_faces",
    "guided_outline": "guides.guide_matching:guided_outline",
    "inner_pieces": "guides.guide_matching:inner_pieces",
    "with_enclosed_planes": "guides.enclosed_planes:with_enclosed_planes",
    # lods
    "FacadePoints": "lods.facades:FacadePoints",
    "at_levels": "lods.levels:at_levels",
    "overhangs_of": "lods.overhang_model:overhangs_of",
    "walls_beneath": "lods.facades:walls_beneath",
    # octree
    "PointsOutput": "octree.points_output:PointsOutput",
    "write_points": "octree.points_output:write_points",
    # overrides
    "overridden": "overrides.apply_overrides:overridden",
    "own_modelling": "overrides.overrides_file:own_modelling",
    "read_overrides": "overrides.overrides_file:read_overrides",
    # papers
    "primitive_partition": "papers.primitives:primitive_partition",
    "unite_flush_walls": "papers.flush_walls:unite_flush_walls",
    # remote
    "ObjectHandler": "remote.arrow_objects:ObjectHandler",
    "ObjectStorage": "remote.object_storage:ObjectStorage",
    "RemoteFile": "remote.remote_file:RemoteFile",
    "files_at": "remote.remote_inputs:files_at",
    # superstructures
    "boxes_of": "superstructures.boxes:boxes_of",
    # templates
    "fit_templates": "templates.fitting:fit_templates",
    "margin_of_templates": "templates.fitting:margin_of_templates",
    # terrain_tin
    "write_terrain": "terrain_tin.terrain_output:write_terrain",
    # vector_files
    "read_tile_index": "vector_files.tile_index:read_tile_index",
}
"""Where the extras add to a run: what the core asks for by name, and its "folder.module:name".

Methods (`METHODS`), ground filters (`FILTERS`), formats of points (`FORMATS`) and commands (`COMMANDS`) have tables of
their own.
"""
