"""What meshes a run can write."""

MESHES = ("building", "tile", "glb", "none")
"""One OBJ a building, one OBJ a tile, one GLB a tile, none."""
