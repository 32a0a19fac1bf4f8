"""Observation of runs: events, log lines, measured tasks, counts, the machine and the versions of its packages.

*Where do I see what a run does?* Its driver sends events to a listener (`progress`) and logs with the ids of run,
tile and batch (`logs`). Each task is measured where it runs and counted by its process (`measurement`);
`pipeline.runtime.cluster.run_metrics` shows both to Prometheus.
"""
