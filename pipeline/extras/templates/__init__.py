"""Templates for sparse roofs."""
