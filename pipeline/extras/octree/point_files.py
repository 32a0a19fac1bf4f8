"""Names of the files that hold the points of a run as 3D Tiles, below its run directory."""

from __future__ import annotations

import re

TILESET = "tileset.json"
"""The root tileset, and in the folder of each tile the tileset of its octree."""
GLOBE_TILESET = "tileset-ecef.json"
"""The root tileset for a globe."""
INDEX = "buildings.json"
"""In the folder of each tile: the nodes that hold points of each building, and the tiles that do."""
TERRAIN = "terrain.json"
"""The terrain beneath them, as one lattice."""
COARSE = "upper"
"""Folder of the nodes above the tiles."""

_TILE = r"x-?\d{1,9}_y-?\d{1,9}"
NAMED_FILE = re.compile(
    "|".join(
        (
            re.escape(TILESET),
            re.escape(GLOBE_TILESET),
            re.escape(TERRAIN),
            rf"{_TILE}/({re.escape(TILESET)}|r[0-7]{{0,20}}\.glb)",
            rf"{COARSE}/\d{{1,3}}_\d{{1,9}}_\d{{1,9}}\.glb",
        )
    ),
    re.ASCII,
)
"""Matches the paths below the folder that tilesets name, and their own."""
