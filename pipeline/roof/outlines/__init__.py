"""Outlines as a surveyor draws them: the shortest description of the edge of some points."""
