"""The demo of the README, on a smaller suburb."""

import json
from pathlib import Path
from typing import Any

import pytest
from command_line import invoke

pytestmark = pytest.mark.slow


Made = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The folder of a demo on two workers, and what it printed."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    code, said, error = invoke("demo", "--out", str(folder), "--size", "110", "110", "--workers", "2", "--json")
    assert code == 0, error
    return folder, json.loads(said)


def figures(reported: dict[str, Any]) -> dict[str, float]:
    """The measures over all buildings by name."""
    return {row["name"]: row["value"] for row in reported["measures"] if row["subset"] == "all"}


def test_every_house_is_found_and_nothing_else(made: Made) -> None:
    measured = figures(made[1])
    houses = next(row["n"] for row in made[1]["measures"] if row["name"] == "delivery.lod2")
    assert houses >= 5
    assert measured["delivery.lod2"] == 1.0
    assert measured["delivery.false_models"] == 0


def test_the_roofs_lie_where_they_are(made: Made) -> None:
    assert figures(made[1])["surface.median"] < 0.05


def test_what_the_demo_points_at_is_there(made: Made) -> None:
    folder, reported = made
    assert Path(reported["picture"]).read_bytes().startswith(b"\x89PNG")
    assert "</html>" in (folder / "report" / "report.html").read_text()
    assert (folder / "scene" / "suburb.laz").is_file()
    models = reported["statuses"]["ok"] + reported["statuses"].get("fallback", 0)
    assert len(list((folder / "run" / "meshes").glob("*/*.obj"))) == models


def test_one_process_gives_the_same_content_as_two_workers(made: Made, tmp_path: Path) -> None:
    folder, reported = made
    tile = str(folder / "scene" / "suburb.laz")
    _, said, _ = invoke("reconstruct", tile, "--out", str(tmp_path / "run"), "--workers", "0", "--json")
    assert json.loads(said)["digest"] == reported["digest"]


def test_the_same_picture_and_figures_come_from_the_run_alone(made: Made, tmp_path: Path) -> None:
    folder, reported = made
    picture = tmp_path / "again.png"
    truth = str(folder / "scene" / "truth")
    _, said, _ = invoke("evaluate", str(folder / "run"), "--truth", truth, "--picture", str(picture), "--json")
    assert json.loads(said)["measures"] == reported["measures"]
    assert picture.read_bytes() == (folder / "demo.png").read_bytes()
