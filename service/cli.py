"""The console script `gablework`: mounts the science commands and, later, the service's own; imports lazily."""

from __future__ import annotations

from pipeline.cli import app


def main() -> None:
    """Run the command line; ends the process with an exit code of `pipeline.console.ExitCode`."""
    app(prog_name="gablework")


if __name__ == "__main__":
    main()
