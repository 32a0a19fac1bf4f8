"""Commands import what they use and no more: start-up counts."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from pipeline.cli import command_line
from service.cli import COMMANDS

SCIENCE = {"numba", "llvmlite", "scipy", "pyarrow", "matplotlib", "dask", "distributed", "laspy", "pyogrio"}
"""Packages of models, tables, pictures and clusters."""
GEOMETRY = {"numpy", "shapely", "pyproj"}
SERVICE = {"fastapi", "uvicorn", "sqlalchemy", "httpx"}

TELL = """
import atexit, json, os, sys
from pathlib import Path
def tell():
    Path(os.environ["MODULES"]).write_text(json.dumps(sorted({name.split(".")[0] for name in sys.modules})))
atexit.register(tell)
"""
COMMAND = (
    TELL
    + """
from service.cli import main
main()
"""
)
SERVED = (
    TELL
    + """
from starlette.testclient import TestClient
from service.app import create_app
from service.settings import ServiceSettings
with TestClient(create_app(ServiceSettings(state=sys.argv[1])), base_url="http://127.0.0.1:8000") as client:
    for path in ("/processes", "/conformance", "/jobs", "/metrics", "/openapi.json"):
        assert client.get(path).status_code == 200, path
"""
)


def imported(program: str, tmp_path: Path, *arguments: str, code: int = 0) -> set[str]:
    """The packages that a program has imported when it ends."""
    reported = tmp_path / "modules.json"
    command, env = [sys.executable, "-c", program, *arguments], {**os.environ, "MODULES": str(reported)}
    ended = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert ended.returncode == code, ended.stderr
    return set(json.loads(reported.read_text()))


def test_what_a_command_imports_is_seen(tmp_path: Path) -> None:
    assert imported(COMMAND, tmp_path, "inspect", str(tmp_path / "no.laz"), code=3) >= {"typer", "pipeline", "numpy"}


@pytest.mark.parametrize("command", [["--help"], ["reconstruct", "--help"], ["serve", "--help"], ["batch", "--help"]])
def test_help_imports_no_science(command: list[str], tmp_path: Path) -> None:
    assert not imported(COMMAND, tmp_path, *command) & (SCIENCE | GEOMETRY | SERVICE)


def test_the_status_of_a_batch_imports_no_science(tmp_path: Path) -> None:
    file = tmp_path / "city.toml"
    file.write_text('[inputs]\npaths = ["tiles"]\n\n[output]\npath = "models"\n\n[schedule]\ncron = "0 3 * * *"\n')
    found = imported(COMMAND, tmp_path, "batch", "status", str(file))
    assert "tomllib" in found
    assert not found & (SCIENCE | SERVICE)


def test_the_service_that_answers_imports_no_science(tmp_path: Path) -> None:
    found = imported(SERVED, tmp_path, str(tmp_path / "state"))
    assert found >= {"fastapi", "sqlalchemy"}
    assert not found & SCIENCE


def test_the_command_that_is_called_is_built_alone_and_is_the_same() -> None:
    whole = typer.main.get_command(command_line(COMMANDS))
    assert set(whole.commands) == set(COMMANDS)
    for name, command in whole.commands.items():
        alone = typer.main.get_command(command_line(COMMANDS, [name, "--help"]))
        assert list(alone.commands) == [name]
        assert [one.opts for one in alone.commands[name].params] == [one.opts for one in command.params]
    for words in (["recontruct"], ["--version"], []):
        assert set(typer.main.get_command(command_line(COMMANDS, words)).commands) == set(COMMANDS)
