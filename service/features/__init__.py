"""The rows of runs, as pages of features: of finished jobs, of jobs that run, and of runs that the operator publishes.

Each run has one index (`index`, `writing`), a SQLite file with the rows of its tables. All that is asked for becomes a
condition on these rows (`pages`, `cql2`): a job's buildings, and collections of OGC API - Features. Modules that write,
or that transform coordinates, load Arrow and PROJ; routes import them when they are needed.
"""
