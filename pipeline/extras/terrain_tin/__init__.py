"""Terrain as triangles."""
