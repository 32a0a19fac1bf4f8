"""3D Tiles on the globe."""
