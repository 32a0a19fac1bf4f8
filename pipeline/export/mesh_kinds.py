"""What meshes a run can write."""

MESHES = ("building", "tile", "glb", "none")
"""One OBJ per building, one OBJ per tile, one GLB per tile, none."""
