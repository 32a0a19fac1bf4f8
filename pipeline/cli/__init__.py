"""The science commands. Each imports what it composes only when it runs, since start-up time counts."""

from pipeline.cli.app import app
from pipeline.cli.batch import batch
from pipeline.cli.classifying import classify
from pipeline.cli.cluster import worker
from pipeline.cli.measuring import digest, evaluate, inspect, report
from pipeline.cli.modelling import compare, reconstruct, replay, rerun
from pipeline.cli.options import AsJson
from pipeline.cli.party_walls import party_walls
from pipeline.cli.publishing import publish
from pipeline.cli.simulating import demo, simulate, warm_up
from pipeline.cli.solar import solar

__all__ = ["AsJson", "app"]

# in the order of `gablework --help`
_COMMANDS = (
    *(reconstruct, rerun, compare, classify, inspect, evaluate, report, publish, solar, party_walls),
    *(digest, replay),
    *(simulate, demo, warm_up, worker),
)
for _command in _COMMANDS:
    app.command()(_command)
app.add_typer(batch, name="batch")
