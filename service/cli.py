"""The console script `gablework`: the science commands and those of the service."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from pipeline.cli import COMMANDS as SCIENCE
from pipeline.cli import command_line
from pipeline.runtime.isolation.start_up import start_own_process

COMMANDS: Mapping[str, str] = {
    **SCIENCE,
    "submit": "service.client_commands:submit",
    "watch": "service.client_commands:watch",
    "fetch": "service.client_commands:fetch",
    "request": "service.client_commands:request",
    "serve": "service.commands:serve",
    "driver": "service.commands:drive",
    "backup": "service.commands:backup",
    "restore": "service.commands:restore",
    "jobs": "service.client_commands:jobs",
    "keys": "service.commands:keys",
}
"""Where each command or group is, in the order of `gablework --help`."""


def main() -> None:
    """Run the command line; ends the process with an exit code of `pipeline.console.ExitCode`."""
    start_own_process()
    command_line(COMMANDS, sys.argv[1:])(prog_name="gablework")


if __name__ == "__main__":
    main()
