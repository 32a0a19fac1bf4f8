"""The stages of a run in their order: ingest, cells, ground, split, join, outline, reconstruct, publish."""
