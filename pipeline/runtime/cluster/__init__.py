"""Executors of a run's tasks: in this process, in child processes, or on a Dask cluster.

*What may a worker do?* A worker runs tasks: plain functions of one argument. It reads the inputs and the run's scratch
folder and writes its outputs there. It plans nothing, changes no shared state, and may die at any time (`dispatch`).
Each worker models buildings in its own child processes (`pipeline.runtime.isolation`).

`serial_executor` defines what a run needs of an executor; `local_executor` serves small jobs, `dask_executor` the
others. `worker` is the command `gablework worker`; `worker_fork_server`, `worker_preload` and `worker_setup` start a
worker's process. `priorities`, `memory_needs` and `tls` decide what runs first, where it fits, and who may connect.
"""
