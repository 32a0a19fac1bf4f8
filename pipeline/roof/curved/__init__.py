"""Curved roofs: barrels, cones and domes, recognised by fit and drawn as facets."""
