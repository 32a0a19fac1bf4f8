"""Executors: where tasks run. In this process, in its children, or on a Dask cluster."""
