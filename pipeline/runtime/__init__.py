"""A run: plan, ingest, split, join, reconstruct, publish; serial or on Dask."""
