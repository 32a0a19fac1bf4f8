"""A run: plan, ingest, ground, split, join, reconstruct, publish; serial or on Dask."""
