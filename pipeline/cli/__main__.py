"""`python -m pipeline.cli`: the science commands, without the service."""

from __future__ import annotations

import sys

from pipeline.cli import COMMANDS, command_line
from pipeline.runtime.isolation.start_up import start_own_process

if __name__ == "__main__":
    start_own_process()
    command_line(COMMANDS, sys.argv[1:])(prog_name="gablework")
