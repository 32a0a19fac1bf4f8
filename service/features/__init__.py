"""The tables of runs as collections of OGC API - Features: finished jobs, and runs that the operator publishes.

Features are read from the run's Parquet files, a row group at a time, so memory does not grow with the run. An index
beside the state (`row_index`) says how many rows each row group has, where they lie, and which tile has which id. The
modules that read import Arrow; routes import them when they are needed.
"""
