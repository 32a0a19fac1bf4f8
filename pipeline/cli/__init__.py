"""The science commands. Each composes what stands below and imports it only when it runs: start-up counts."""

from pipeline.cli.app import app
from pipeline.cli.cluster import worker
from pipeline.cli.measuring import digest, evaluate, inspect
from pipeline.cli.modelling import compare, reconstruct, replay
from pipeline.cli.options import AsJson
from pipeline.cli.simulating import demo, simulate, warm_up

__all__ = ["AsJson", "app"]

# as `gablework --help` lists them
for _command in (reconstruct, compare, inspect, evaluate, digest, replay, simulate, demo, warm_up, worker):
    app.command()(_command)
