"""Command lines run within the test's process."""

from typer.testing import CliRunner

from pipeline.cli import command_line
from service.cli import COMMANDS

app = command_line(COMMANDS)


def invoke(*words: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command line."""
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.stdout, result.stderr
