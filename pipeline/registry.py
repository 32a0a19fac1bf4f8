"""What loads when it is used: tables name it as "module:name"."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Mapping
from typing import Any


@functools.cache
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
    >>> extra("PlyFile").__name__
    'PlyFile'
    """
    return loaded(f"pipeline.extras.{EXTRAS[name]}")


EXTRAS: Mapping[str, str] = {
    # footprints
    "with_support_of_seen": "footprints.unseen_slopes:with_support_of_seen",
    "given_model": "footprints.given_model:given_model",
    "with_unseen_slopes": "footprints.unseen_slopes:with_unseen_slopes",
    "without_voids": "footprints.voids:without_voids",
    "read_area": "footprints.footprints_file:read_area",
    "footprints_of_run": "footprints.given_footprints:footprints_of_run",
    "roofs_alone": "footprints.roofs_alone:roofs_alone",
    "join_footprints": "footprints.footprint_sites:join_footprints",
    "numbers_by_tile": "footprints.given_footprints:numbers_by_tile",
    # guides
    "followed": "guides.guide_matching:followed",
    "guide_steps": "guides.guide_matching:guide_steps",
    "guided_outline": "guides.guide_matching:guided_outline",
    "with_enclosed_planes": "guides.enclosed_planes:with_enclosed_planes",
    "guided_faces": "guides.guided_faces:guided_faces",
    "inner_pieces": "guides.guide_matching:inner_pieces",
    "given_guides": "guides.given_guides:given_guides",
    # lods
    "overhangs_of": "lods.overhang_model:overhangs_of",
    "lower_lods": "lods.lower_lods:lower_lods",
    "FacadePoints": "lods.facades:FacadePoints",
    "walls_beneath": "lods.facades:walls_beneath",
    # octree
    "PointsOutput": "octree.points_output:PointsOutput",
    "write_points": "octree.points_output:write_points",
    # overrides
    "about_no_effect": "overrides.apply_overrides:about_no_effect",
    "apply_overrides": "overrides.apply_overrides:apply_overrides",
    "read_overrides": "overrides.overrides_file:read_overrides",
    "own_modelling": "overrides.overrides_file:own_modelling",
    # papers
    "unite_flush_walls": "papers.flush_walls:unite_flush_walls",
    "primitive_partition": "papers.primitives:primitive_partition",
    # ply_ascii
    "PlyFile": "ply_ascii.ply:PlyFile",
    "AsciiFile": "ply_ascii.ascii:AsciiFile",
    # remote
    "files_at": "remote.remote_inputs:files_at",
    "ObjectStorage": "remote.object_storage:ObjectStorage",
    "RemoteFile": "remote.remote_file:RemoteFile",
    # templates
    "fit_templates": "templates.fitting:fit_templates",
    "margin_of_templates": "templates.fitting:margin_of_templates",
    # terrain_tin
    "write_terrain": "terrain_tin.terrain_output:write_terrain",
    # vector_files
    "read_tile_index": "vector_files.tile_index:read_tile_index",
    "ObjectHandler": "remote.arrow_objects:ObjectHandler",
}
"""Where the extras add to a run: what the core asks for by name, and its "folder.module:name".

Methods (`METHODS`), ground filters (`FILTERS`) and commands (`COMMANDS`) have tables of their own.
"""
