"""`python -m pipeline.cli`: the science commands, without the service."""

from __future__ import annotations

from pipeline.cli import app
from pipeline.runtime.isolation.start_up import start_own_process

if __name__ == "__main__":
    start_own_process()
    app(prog_name="gablework")
