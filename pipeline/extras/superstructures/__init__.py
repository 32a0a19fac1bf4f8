"""Boxes of what stands on roofs."""
