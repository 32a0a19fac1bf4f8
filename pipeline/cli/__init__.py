"""The science commands. Each imports what it composes only when it runs, since start-up time counts."""

from collections.abc import Mapping

from pipeline.cli.app import command_line

__all__ = ["COMMANDS", "command_line"]

COMMANDS: Mapping[str, str] = {
    "reconstruct": "pipeline.cli.modelling:reconstruct",
    "rerun": "pipeline.cli.remodelling:rerun",
    "compare": "pipeline.cli.comparing:compare",
    "classify": "pipeline.cli.classifying:classify",
    "inspect": "pipeline.cli.measuring:inspect",
    "evaluate": "pipeline.cli.measuring:evaluate",
    "report": "pipeline.cli.measuring:report",
    "publish": "pipeline.cli.publishing:publish",
    "solar": "pipeline.cli.solar:solar",
    "party-walls": "pipeline.cli.party_walls:party_walls",
    "digest": "pipeline.cli.measuring:digest",
    "replay": "pipeline.cli.remodelling:replay",
    "simulate": "pipeline.cli.simulating:simulate",
    "demo": "pipeline.cli.simulating:demo",
    "warm-up": "pipeline.cli.simulating:warm_up",
    "worker": "pipeline.cli.cluster:worker",
    "batch": "pipeline.cli.batch:batch",
}
"""Where each command or group is, in the order of `gablework --help`."""
