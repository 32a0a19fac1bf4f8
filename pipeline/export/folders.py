"""Folders of a run directory that only some runs write."""

POINTS_FOLDER = "points"
"""The points as 3D Tiles."""
TERRAIN_FOLDER = "terrain"
"""The terrain of all tiles."""
