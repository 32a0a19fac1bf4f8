"""The commands as a user meets them: help, usage errors, input errors, machine output, options that they share."""

import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from command_line import app, invoke

from pipeline import __version__
from pipeline.cli.command_options import worker_count
from pipeline.cli.party_walls import party_walls
from pipeline.cli.solar import solar
from pipeline.extras.party_walls.party_wall_settings import PartyWallSettings
from pipeline.extras.solar.solar_settings import SolarSettings
from pipeline.parameters import Parameters

COMMANDS = (
    *("reconstruct", "rerun", "compare", "classify", "inspect", "simulate", "digest"),
    *("evaluate", "warm-up", "demo", "replay", "report", "publish", "solar", "party-walls"),
    *("worker", "batch"),
)


def ascii_tile(folder: Path) -> Path:
    """A small sloping terrain with a box on it, as an ASCII file."""
    rows = [
        f"{1000 + 0.5 * i:.2f} {2000 + 0.5 * j:.2f} {40 + 0.01 * i + (5 if 20 < i < 40 and 20 < j < 36 else 0):.2f}"
        for i in range(60)
        for j in range(60)
    ]
    path = folder / "tile.xyz"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_the_commands_are_the_documented_ones() -> None:
    # the service mounts its own on the same application where it is loaded
    mounted = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    of_service = {"serve", "driver", "keys", "backup", "restore", "submit", "watch", "fetch", "jobs", "request"}
    assert mounted - of_service == set(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str) -> None:
    code, said, _ = invoke(command, "--help")
    assert code == 0
    assert command in said


def test_the_version_is_reported() -> None:
    assert invoke("--version") == (0, f"{__version__}\n", "")


@pytest.mark.parametrize(
    "words",
    [
        ("inspect",),
        ("reconstruct", "a.laz"),
        ("reconstruct", "a.laz", "--out", "run", "--bbox", "1", "2", "3"),
        ("reconstruct", "a.laz", "--out", "run", "--workers", "-1"),
        ("digest", "run", "--no-such-option"),
        ("no-such-command",),
    ],
)
def test_a_wrong_command_line_is_exit_code_2(words: tuple[str, ...]) -> None:
    assert invoke(*words)[0] == 2


@pytest.mark.parametrize("option", [("--method", "magic"), ("--classes", "maybe"), ("--settings", "no-such.toml")])
def test_a_wrong_setting_is_exit_code_2_and_names_it(tmp_path: Path, option: tuple[str, str]) -> None:
    code, _, said = invoke("reconstruct", str(ascii_tile(tmp_path)), "--out", str(tmp_path / "run"), *option)
    assert code == 2
    assert option[1] in said
    assert not (tmp_path / "run").exists()


def test_a_missing_input_is_exit_code_3_and_names_it(tmp_path: Path) -> None:
    for words in (("inspect", "no-such.laz"), ("reconstruct", "no-such.laz", "--out", str(tmp_path / "run"))):
        code, _, said = invoke(*words)
        assert code == 3
        assert "no-such.laz" in said
        assert "Traceback" not in said


def test_a_folder_that_is_no_run_is_exit_code_4(tmp_path: Path) -> None:
    code, _, said = invoke("digest", str(tmp_path))
    assert code == 4
    assert str(tmp_path) in said


def test_errors_for_machines_are_json(tmp_path: Path) -> None:
    code, said, _ = invoke("digest", str(tmp_path), "--json")
    assert json.loads(said)["error"]["exit_code"] == code == 4


def test_inspect_says_what_a_tile_holds(tmp_path: Path) -> None:
    code, said, _ = invoke("inspect", str(ascii_tile(tmp_path)), "--crs", "EPSG:28992")
    assert code == 0
    assert "3600 used of 3600" in said
    assert "EPSG:28992" in said


@pytest.mark.parametrize("command", ["reconstruct", "classify"])
def test_a_tile_far_outside_the_area_of_its_crs_is_refused_with_place_area_and_fix(
    tmp_path: Path, command: str
) -> None:
    out = tmp_path / "out"
    words = (command, str(ascii_tile(tmp_path)), "--crs", "EPSG:2193", "--out", str(out), "--workers", "0")
    code, _, said = invoke(*words)
    assert code == 3
    plain = " ".join(said.split())
    for part in ("EPSG:2193", "New Zealand", "° S", "--crs EPSG:n", "--allow-outside-area-of-use"):
        assert part in plain
    assert not list(out.glob("*"))
    assert invoke(*words, "--allow-outside-area-of-use")[0] == 0


def test_a_batch_names_its_key_for_a_tile_far_outside(tmp_path: Path) -> None:
    ascii_tile(tmp_path)
    text = '[inputs]\npaths = ["tile.xyz"]\ncrs = "EPSG:2193"\n{}[output]\npath = "models"\n[cluster]\nworkers = 0\n'
    (tmp_path / "city.toml").write_text(text.format(""))
    code, _, said = invoke("batch", "plan", str(tmp_path / "city.toml"))
    assert code == 3
    assert "[inputs] allow_outside_area_of_use = true" in " ".join(said.split())
    (tmp_path / "city.toml").write_text(text.format("allow_outside_area_of_use = true\n"))
    assert invoke("batch", "plan", str(tmp_path / "city.toml"))[0] == 0


def test_inspect_shows_the_place_and_warns_of_one_that_a_run_refuses(tmp_path: Path) -> None:
    code, said, warned = invoke("inspect", str(ascii_tile(tmp_path)), "--crs", "EPSG:2193", "--json")
    found = json.loads(said)
    assert code == 0
    longitude, latitude = found["location"]["longitude_latitude"]
    assert (longitude, latitude) == pytest.approx((83.0, -75.8), abs=0.1)
    assert found["location"]["area"]["name"].startswith("New Zealand")
    assert any("--allow-outside-area-of-use" in warning for warning in found["warnings"])
    assert "--allow-outside-area-of-use" in warned
    near = json.loads(invoke("inspect", str(ascii_tile(tmp_path)), "--json")[1])
    assert near["location"] is None


def test_inspect_counts_the_raised_box_for_machines(tmp_path: Path) -> None:
    code, said, events = invoke("inspect", str(ascii_tile(tmp_path)), "--json")
    found = json.loads(said)
    assert code == 0
    assert found["used_points"] == 3600
    assert found["raised_objects"] == 1
    assert found["density_per_m2"] == pytest.approx(4.0, rel=0.1)
    assert found["elevation_m"] == [40.0, 45.39]
    assert all("kind" in json.loads(line) for line in events.splitlines())


def test_the_console_script_runs_as_a_program() -> None:
    command = [sys.executable, "-m", "service.cli", "inspect", "no-such.laz"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 3
    assert result.stderr.startswith("error: no-such.laz: no such file")


# --- options that several commands share


@pytest.mark.parametrize(("text", "workers"), [("auto", None), ("0", 0), ("3", 3), ("1024", 1024)])
def test_workers_are_a_number_or_left_to_the_estimate(text: str, workers: int | None) -> None:
    assert worker_count(text) == workers


@pytest.mark.parametrize("text", ["many", "", "-1", "1.5", "1025", "AUTO", "²"])
def test_workers_that_are_no_number_are_named_with_what_to_use(text: str) -> None:
    with pytest.raises(typer.BadParameter) as raised:
        worker_count(text)
    assert str(raised.value) == f"{text!r}: use auto, or a whole number from 0 to 1024"


@pytest.mark.parametrize(
    "words",
    [
        ("reconstruct", "a.laz", "--out", "run"),
        ("rerun", "run"),
        ("compare", "a.laz", "--methods", "kmeans", "--out", "out"),
        ("classify", "a.laz", "--out", "out"),
        ("demo",),
    ],
    ids=lambda words: words[0],
)
def test_every_command_with_workers_refuses_what_is_no_number(words: tuple[str, ...]) -> None:
    code, _, error = invoke(*words, "--workers", "many")
    assert code == 2
    assert "'many': use auto, or a whole number from 0 to 1024" in " ".join(error.split())


@pytest.mark.parametrize(
    ("command", "settings", "options"),
    [
        (party_walls, PartyWallSettings(), {"max_distance": "max_distance_m", "max_angle": "max_angle_deg",
                                            "min_area": "min_area_m2"}),
        (solar, SolarSettings(), {"albedo": "albedo", "reach": "reach_m", "samples": "samples"}),
    ],
)  # fmt: skip
def test_options_default_to_the_settings(command: Any, settings: Parameters, options: dict[str, str]) -> None:
    for option, name in options.items():
        assert inspect.signature(command).parameters[option].default == getattr(settings, name)
