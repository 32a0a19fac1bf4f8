"""gablework batch: plan, run, status, as a user types them."""

import json
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import pytest
from command_line import app
from typer.testing import CliRunner

from pipeline.batch.batch_file import read_batch
from pipeline.batch.batch_status import buildings_before
from pipeline.batch.estimates import estimate
from pipeline.cli.batching import _end_by_signals
from pipeline.errors import RunError
from pipeline.io import storage_at
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.digest import run_digest
from pipeline.runtime.scratch.work_folder import DRIVER_LOCK, locked_file, locked_work, make_work


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A batch of one tile of some houses."""
    folder = tmp_path_factory.mktemp("batch")
    simulate("suburb", folder / "tiles", 3, size_m=(70.0, 70.0), density_per_m2=4.0)
    (folder / "city.toml").write_text(
        '[inputs]\npaths = ["tiles/*.laz"]\n[settings]\ntile_size_m = 40.0\n[output]\npath = "models"\n'
        "[cluster]\nworkers = 0\n"
    )
    return folder


@pytest.fixture
def text(folder: Path) -> str:
    """The batch file, for another folder."""
    return (folder / "city.toml").read_text().replace("tiles/", f"{folder}/tiles/")


@pytest.fixture
def file(text: str, tmp_path: Path) -> Path:
    """The same batch with a folder of its own for work and results."""
    (tmp_path / "city.toml").write_text(text)
    return tmp_path / "city.toml"


def call(*words: str | Path) -> tuple[int, str, str]:
    ended = CliRunner().invoke(app, ["batch", *map(str, words)])
    return ended.exit_code, ended.stdout, ended.stderr


def rows(text: str) -> dict[str, str]:
    lines = [line.split("│")[1:3] for line in text.splitlines() if line.startswith("│")]
    return {name.strip(): value.strip() for name, value in lines}


def test_a_batch_is_planned_run_and_reported(folder: Path) -> None:
    file = folder / "city.toml"
    code, reported, _ = call("plan", file)
    assert code == 0
    plan = rows(reported)
    assert plan["inputs"].startswith("files: 1, 0.0 million points")
    assert "of 40 m" in plan["tiles"]
    assert not (folder / "models").exists()
    code, reported, error = call("status", file)
    assert code == 4
    assert "this batch was never run" in error
    code, reported, _ = call("run", file, "--json")
    assert code == 0
    first = json.loads(reported)
    assert first["statuses"]["ok"] > 0
    assert (folder / "models" / "run.html").is_file()
    assert rows(call("status", file)[1])["state"] == "finished"
    status = json.loads(call("status", file, "--json")[1])
    assert status["buildings"]["done"] == first["counts"]["candidates"]
    assert status["message"] == f"digest {first['digest']}"
    again = json.loads(call("run", file, "--json")[1])
    assert again["digest"] == first["digest"]
    status = json.loads(call("status", file, "--json")[1])
    assert all(stage["kept"] == stage["done"] for name, stage in status["stages"].items() if name != "join")


def test_a_batch_that_leaves_its_workers_to_the_estimate_gives_what_one_process_gives(file: Path, text: str) -> None:
    digests = {}
    for workers in ("0", '"auto"'):
        file = file.with_name(f"city{len(digests)}.toml")
        file.write_text(text.replace("workers = 0", f"workers = {workers}").replace('"models"', f'"{file.stem}"'))
        code, reported, error = call("run", file, "--json")
        assert code == 0, error
        digests[workers] = json.loads(reported)["digest"]
        manifest = json.loads((file.with_suffix("") / "run.json").read_text())
        assert (len(manifest["peak_memory_bytes"]) > 1) is (workers != "0")
    assert digests['"auto"'] == digests["0"]


@pytest.mark.slow
def test_a_tile_index_and_a_bucket_are_inputs_and_results_of_a_batch(folder: Path, tmp_path: Path, bucket: str) -> None:
    (tmp_path / "index").mkdir()
    tile = next((folder / "tiles").glob("*.laz"))
    (tmp_path / "index" / "tiles.txt").write_text(f"# the survey\n{tile}\n")
    file = tmp_path / "city.toml"
    text = (folder / "city.toml").read_text().replace("tiles/*.laz", "index/tiles.txt")
    file.write_text(text.replace('"models"', f'"{bucket}/models"'))
    assert rows(call("plan", file)[1])["inputs"].startswith("files: 1, ")
    code, reported, error = call("run", file, "--json")
    assert code == 0, error
    assert json.loads(reported)["digest"] == run_digest(f"{bucket}/models")
    assert b"Failures" not in storage_at(f"{bucket}/models").get("run.html")
    again = json.loads(call("run", file, "--json")[1])
    assert again["digest"] == json.loads(reported)["digest"]
    assert again["counts"]["reused"] == again["counts"]["candidates"]


def test_the_report_is_that_of_the_last_run_or_none(file: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert call("run", file)[0] == 0
    page = file.with_name("models") / "run.html"
    assert page.is_file()
    file.write_text(text.replace("[output]\n", "[output]\nreport = false\n"))
    assert call("run", file)[0] == 0
    assert not page.exists()

    def fails(run_dir: str) -> str:
        raise RunError(f"{run_dir} is full")

    monkeypatch.setattr("pipeline.batch.batch_run.write_run_page", fails)
    file.write_text(text)
    code, _, error = call("run", file)
    assert code == 0
    assert "the run is complete, its report could not be written" in error


def test_a_batch_of_other_points_is_looked_at_again(file: Path) -> None:
    assert call("run", file)[0] == 0
    batch, (count, points) = read_batch(file), buildings_before(str(file.with_suffix(".work")))
    found = estimate(batch, known=(count, points))
    assert (found.buildings, found.buildings_from) == (count, "as many as in the run before")
    assert estimate(batch, known=(count, points + 1)).buildings_from == "as many as such an area often has"


def test_times_are_reported_before_the_first_run(file: Path, text: str) -> None:
    file.write_text(text + '[schedule]\ncron = "30 2 * * *"\ntime_zone = "Europe/Amsterdam"\n')
    code, reported, _ = call("status", file)
    assert (code, rows(reported)["state"]) == (0, "never run")
    assert rows(reported)["next times"].count("02:30 CE") == 3
    assert "next times" in rows(call("plan", file)[1])


@pytest.mark.parametrize(("hangup", "times"), [(signal.SIG_IGN, 2), (signal.SIG_DFL, 3)])
def test_a_schedule_ends_by_signals_and_under_nohup_outlives_its_terminal(hangup: Any, times: int) -> None:
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    reported: list[int] = []
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        signal.signal(signal.SIGHUP, hangup)
        _end_by_signals(lambda: reported.append(1))
        for number in numbers:
            signal.raise_signal(number)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert len(reported) == times


def test_a_batch_that_someone_runs_is_refused(file: Path) -> None:
    with locked_work(str(file.with_suffix(".work"))):
        code, _, error = call("run", file)
    assert code == 4
    assert "is at work already" in error


def test_who_comes_second_says_nothing_in_the_status_of_who_came_first(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = file.with_suffix(".work")
    make_work(work)
    (work / "status.json").write_text("of the first")
    # both looked before either held the folder
    monkeypatch.setattr("pipeline.batch.batch_run.refuse_locked", lambda _: None)
    with locked_file(work, DRIVER_LOCK):
        code, _, error = call("run", file)
    assert code == 4
    assert "is at work already" in error
    assert (work / "status.json").read_text() == "of the first"


@pytest.mark.parametrize("command", ["plan", "run"])
@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('[output]\npath = "theirs"\n', "is not empty (theirs.txt"),
        ('[output]\npath = "theirs"\noverwrite = true\n', "holds theirs.txt and no run.json"),
        ('[output]\npath = "models"\n[work]\npath = "theirs"\n', "holds theirs.txt and is no work folder"),
        ('[output]\npath = "models"\n[work]\npath = "models"\n', "lie in one another"),
        ('[output]\npath = "models"\n[work]\npath = "models/work"\n', "lie in one another"),
        ('[output]\npath = "models"\n[cluster]\nworkers = 0\nperformance_report = "no/time.html"\n', "make the folder"),
    ],
)
def test_places_that_cannot_be_written_are_refused_before_anything_runs(
    folder: Path, tmp_path: Path, command: str, lines: str, words: str
) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "theirs.txt").write_text("theirs")
    file = tmp_path / "city.toml"
    file.write_text(f'[inputs]\npaths = ["{folder}/tiles/*.laz"]\n{lines}')
    code, _, error = call(command, file)
    assert code == 4
    assert words in " ".join(error.split())
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["city.toml", "theirs", "theirs.txt"]


@pytest.mark.parametrize(
    ("command", "free", "words"),
    [("plan", 10, "work folder"), ("run", 10, "work folder"), ("plan", 10**12, "")],
)
def test_what_does_not_fit_is_refused_before_anything_runs(
    file: Path, monkeypatch: pytest.MonkeyPatch, command: str, free: int, words: str
) -> None:
    monkeypatch.setattr("pipeline.batch.estimates._free", lambda _: free)
    code, _, error = call(command, file)
    assert code == (4 if words else 0)
    assert words in error
    assert not file.with_name("models").exists()


def test_results_that_are_replaced_need_no_room_beside_themselves(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.batch.estimates._free", lambda path: 10 if path.endswith("models") else 10**12)
    assert "the results in" in call("plan", file)[2]
    (tmp_path / "models").mkdir()
    with (tmp_path / "models" / "large").open("wb") as stream:
        stream.truncate(10**9)
    (tmp_path / "models" / "gone").symlink_to("nowhere")
    assert "the results in" not in call("plan", file)[2]


def test_a_tile_that_no_worker_can_hold_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.batch.estimates.memory_of_workers", lambda **_: (2, 1_000_000))
    code, _, error = call("plan", folder / "city.toml")
    assert code == 4
    assert "Set a smaller tile_size_m, or give the workers more memory" in error


def test_a_limit_that_the_largest_tile_may_exceed_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need = json.loads(call("plan", folder / "city.toml", "--json")[1])["worker_most_bytes"]
    monkeypatch.setattr("pipeline.batch.estimates.memory_of_workers", lambda **_: (2, need - 1))
    code, _, error = call("plan", folder / "city.toml")
    assert code == 0
    assert "a worker may need up to" in " ".join(error.split())


def test_the_disk_that_work_and_results_share_must_hold_both(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported = json.loads(call("plan", file, "--json")[1])
    need = reported["work_bytes"] + reported["out_bytes"]
    monkeypatch.setattr("pipeline.batch.estimates._free", lambda _: need)
    assert call("plan", file)[0] == 0
    monkeypatch.setattr("pipeline.batch.estimates._free", lambda _: need - 1)
    code, _, error = call("plan", file)
    assert code == 4
    assert "of one disk" in " ".join(error.split())


def test_kernels_that_are_yet_to_be_compiled_are_reported_with_their_time(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = []
    for compiled in (True, False):
        seconds = 0.0 if compiled else 30.0
        monkeypatch.setattr("pipeline.runtime.forecast.compiling_s", lambda _groups, seconds=seconds: seconds)
        reported = json.loads(call("plan", folder / "city.toml", "--json")[1])
        assert any("gablework warm-up" in text for text in reported["warnings"]) is not compiled
        ends.append(reported["seconds"][1])
    assert ends[1] == pytest.approx(ends[0] + 60.0)


def test_a_window_is_planned_by_its_share(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "city.toml"
    paths = f'[inputs]\npaths = ["{folder}/tiles/*.laz"]\n'
    rest = '[settings]\ntile_size_m = 40.0\n[output]\npath = "models"\n'
    file.write_text(paths + rest)
    whole = json.loads(call("plan", file, "--json")[1])
    (laz,) = (folder / "tiles").glob("*.laz")
    with laspy.open(laz) as tile:
        (x0, y0, _), (x1, y1, _) = tile.header.mins, tile.header.maxs
    file.write_text(f"{paths}bbox = [{x0}, {y0}, {(x0 + x1) / 2}, {(y0 + y1) / 2}]\n{rest}")
    part = json.loads(call("plan", file, "--json")[1])
    assert part["points"] == pytest.approx(whole["points"] / 4, rel=0.01)
    assert 0 < part["tiles"] < whole["tiles"]
    assert part["buildings"] < whole["buildings"]


def test_what_is_odd_in_every_input_is_reported_once(folder: Path, tmp_path: Path) -> None:
    (laz,) = (folder / "tiles").glob("*.laz")
    for name in ("a.laz", "b.laz", "c.laz"):
        shutil.copy(laz, tmp_path / name)
    file = tmp_path / "city.toml"
    file.write_text('[inputs]\npaths = ["*.laz"]\ncrs = "EPSG:25833"\n[output]\npath = "models"\n')
    reported = json.loads(call("plan", file, "--json")[1])["warnings"]
    assert reported
    assert all(text.startswith(f"{tmp_path}/a.laz and 2 more inputs: ") for text in reported)


def test_faults_name_keys_of_the_batch_file(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "city.toml"
    file.write_text(f'[inputs]\npaths = ["{folder}/tiles/*.laz"]\nbbox = [0, 0, 1, 1]\n[output]\npath = "models"\n')
    for command in ("plan", "run"):
        code, _, error = call(command, file)
        assert code == 3
        assert "lie off [inputs] bbox and [inputs] aoi" in " ".join(error.split())
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "theirs").touch()
    assert "give another [output] path" in " ".join(call("run", file)[2].split())


@pytest.mark.parametrize("command", ["plan", "run"])
def test_columns_of_heights_without_footprints_are_refused(text: str, tmp_path: Path, command: str) -> None:
    (tmp_path / "city.toml").write_text(f'{text}[settings.footprints]\nheight = "h"\n')
    code, _, error = call(command, tmp_path / "city.toml")
    assert code == 2
    assert "height name columns of given footprints, and none are given" in " ".join(error.split())


@pytest.mark.parametrize("words", [["plan"], ["run"], ["status"]])
def test_a_batch_file_with_faults_is_a_usage_error(tmp_path: Path, words: Sequence[str]) -> None:
    file = tmp_path / "city.toml"
    file.write_text("[input]\n")
    code, _, error = call(*words, file)
    assert code == 2
    assert "[input] is not a table of a batch file" in error
    assert "[inputs] paths is missing" in error
