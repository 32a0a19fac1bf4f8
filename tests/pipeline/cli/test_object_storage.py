"""Commands on what lies in an object store."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from command_line import invoke
from object_store import SECRET

from pipeline.console import ExitCode
from pipeline.io import storage_at

if TYPE_CHECKING:
    from object_store import FaultyProxy


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated gable roof."""
    folder = tmp_path_factory.mktemp("scene")
    assert invoke("simulate", "gable", "--out", str(folder), "--size", "40", "40", "--quiet")[0] == 0
    return folder


def document(*words: str) -> Any:
    """What a command prints as JSON; it succeeds and shows no secrets."""
    code, said, events = invoke(*words, "--json")
    assert code == 0, events
    assert SECRET not in said + events
    return json.loads(said)


@pytest.mark.slow
def test_all_commands_that_read_tiles_or_runs_take_urls(scene: Path, bucket: str, tmp_path: Path) -> None:
    tile, run = f"{bucket}/in/gable.laz", f"{bucket}/runs/gable"
    storage_at(bucket).put("in/gable.laz", (scene / "gable.laz").read_bytes())
    here = document("reconstruct", str(scene / "gable.laz"), "--out", str(tmp_path / "run"), "--workers", "0")
    there = document("reconstruct", tile, "--out", run, "--workers", "0")
    assert there["digest"] == here["digest"]
    assert there["run_dir"] == run
    assert document("digest", run)["content_sha256"] == here["digest"]
    picture = tmp_path / "run.png"
    truth = str(scene / "truth")
    measured = document("evaluate", run, "--truth", truth, "--picture", str(picture))
    assert picture.stat().st_size > 10_000
    assert measured["measures"] == document("evaluate", str(tmp_path / "run"), "--truth", truth)["measures"]
    assert measured["statistics"]["statuses"]["ok"] == 1
    facts, facts_here = (document("inspect", place) for place in (tile, str(scene / "gable.laz")))
    assert facts["classes"] == facts_here["classes"]
    assert facts["info"]["path"] == tile


def test_points_to_measure_against_may_lie_in_a_bucket(tmp_path: Path, bucket: str) -> None:
    words = ("simulate", "gable", "--out", str(tmp_path), "--size", "40", "40", "--with-classes", "--quiet")
    assert invoke(*words)[0] == 0
    tile = str(tmp_path / "gable.laz")
    storage_at(bucket).put("gable.laz", Path(tile).read_bytes())
    document("reconstruct", tile, "--out", str(tmp_path / "run"), "--workers", "0")
    here, there = (
        document("evaluate", str(tmp_path / "run"), "--points", place) for place in (tile, f"{bucket}/gable.laz")
    )
    assert there["measures"] == here["measures"]


def test_a_bundle_in_a_bucket_is_replayed(bucket: str) -> None:
    storage_at(bucket).put("run/quarantine/a.bundle", b"no bundle")
    code, _, said = invoke("replay", f"{bucket}/run/quarantine/a.bundle")
    assert code == ExitCode.INPUT
    assert "not a bundle, or broken" in said


def test_a_store_that_denies_ends_with_the_code_of_run_directories(scene: Path, bucket: str, s3: FaultyProxy) -> None:
    s3.script = lambda _: "denied"
    code, _, said = invoke("reconstruct", str(scene / "gable.laz"), "--out", f"{bucket}/run", "--workers", "0")
    assert code == ExitCode.RUN_DIRECTORY
    assert "access is denied" in said


def test_an_input_that_is_not_there_ends_with_the_code_of_inputs(bucket: str, tmp_path: Path) -> None:
    code, _, said = invoke("reconstruct", f"{bucket}/a.laz", "--out", str(tmp_path / "run"), "--workers", "0")
    assert code == ExitCode.INPUT
    assert "there is no such thing" in said


@pytest.mark.slow
def test_workers_find_the_store_by_the_environment(scene: Path, bucket: str, tmp_path: Path) -> None:
    storage_at(bucket).put("in/gable.laz", (scene / "gable.laz").read_bytes())
    here = document("reconstruct", str(scene / "gable.laz"), "--out", str(tmp_path / "run"), "--workers", "0")
    there = document("reconstruct", f"{bucket}/in/", "--out", f"{bucket}/run", "--workers", "2")
    assert there["digest"] == here["digest"]
