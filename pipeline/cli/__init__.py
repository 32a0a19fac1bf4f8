"""The science commands. Each imports what it composes only when it runs, since start-up time counts."""

from collections.abc import Mapping

from pipeline.cli.app import command_line

__all__ = ["COMMANDS", "command_line"]

COMMANDS: Mapping[str, str] = {
    "reconstruct": "pipeline.cli.modelling:reconstruct",
    "rerun": "pipeline.cli.remodelling:rerun",
    "compare": "pipeline.cli.compare_command:compare",
    "classify": "pipeline.cli.classifying:classify",
    "inspect": "pipeline.cli.measure_commands:inspect",
    "evaluate": "pipeline.cli.measure_commands:evaluate",
    "report": "pipeline.cli.measure_commands:report",
    "publish": "pipeline.cli.publish_command:publish",
    "solar": "pipeline.cli.solar:solar",
    "party-walls": "pipeline.cli.party_walls:party_walls",
    "digest": "pipeline.cli.measure_commands:digest",
    "replay": "pipeline.cli.remodelling:replay",
    "simulate": "pipeline.cli.simulating:simulate",
    "demo": "pipeline.cli.simulating:demo",
    "warm-up": "pipeline.cli.simulating:warm_up",
    "worker": "pipeline.cli.cluster:worker",
    "batch": "pipeline.cli.batch:batch",
}
"""Where each command or group is, in the order of `gablework --help`."""
