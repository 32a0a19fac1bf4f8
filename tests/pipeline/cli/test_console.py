"""Progress, errors and exit codes as people, logs and machines see them."""

import io
import json

import pytest
import typer

from pipeline.console import EXIT_CODES, LOG_INTERVAL_S, Console, ExitCode, exit_code_of
from pipeline.errors import (
    BuildingError,
    CrsError,
    EmptyInputError,
    GableworkError,
    InputError,
    RunError,
    SettingsError,
    UnreadableInputError,
)
from pipeline.model import Reason
from pipeline.runtime.monitoring.progress import Event


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    """A stream that says that a person reads it."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (SettingsError(["vigilance is 7: use 0 to 1"]), 2),
        (InputError("a.laz", "is bad", "Mend it."), 3),
        (UnreadableInputError("a.laz", "is no LAS", "Give a LAS."), 3),
        (EmptyInputError("a.laz", "holds no point", "Give points."), 3),
        (CrsError("a.laz", "is geographic", "Project it."), 3),
        (RunError("out exists"), 4),
        (BuildingError(Reason.NO_PLANE, "0 planes"), 5),
        (GableworkError("unknown"), 5),
        (ZeroDivisionError("division by zero"), 5),
        (KeyboardInterrupt(), 130),
    ],
)
def test_every_error_ends_with_its_exit_code(
    error: BaseException, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as caught, Console():
        raise error
    assert caught.value.exit_code == code == exit_code_of(error)
    assert "error: " in capsys.readouterr().err


def test_every_exit_code_is_explained() -> None:
    assert list(EXIT_CODES) == list(ExitCode)


def test_an_input_error_is_one_line_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit), Console():
        raise CrsError("a.laz", "has the geographic CRS EPSG:4326", "Reproject it to a metric CRS")
    assert capsys.readouterr().err == "error: a.laz: has the geographic CRS EPSG:4326. Reproject it to a metric CRS\n"


def test_all_faults_of_the_settings_are_reported_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit), Console():
        raise SettingsError(["vigilance is 7: use 0 to 1", "tau is -1: use 1 to 100"])
    reported = ["error: vigilance is 7: use 0 to 1", "error: tau is -1: use 1 to 100"]
    assert capsys.readouterr().err.splitlines() == reported


def test_a_fault_of_our_own_shows_its_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit), Console():
        raise ZeroDivisionError("division by zero")
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "please report it" in said


def test_json_errors_carry_path_problem_and_fix(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit), Console(as_json=True):
        raise EmptyInputError("a.laz", "holds no point", "Give a file with points.")
    error = json.loads(capsys.readouterr().out)["error"]
    assert (error["type"], error["exit_code"], error["path"]) == ("EmptyInputError", 3, "a.laz")
    assert (error["problem"], error["fix"]) == ("holds no point", "Give a file with points.")


def test_an_exit_asked_for_passes_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as caught, Console():
        raise typer.Exit(ExitCode.TILES_FAILED)
    assert caught.value.exit_code == 1
    assert capsys.readouterr() == ("", "")


def test_log_lines_of_progress_are_throttled_and_the_last_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    console = Console(clock=clock)
    for done in range(1, 101):
        clock.now = done * LOG_INTERVAL_S / 10
        console.on_event(Event(kind="progress", stage="reconstruct", done=done, total=100))
    lines = capsys.readouterr().err.splitlines()
    assert 9 <= len(lines) <= 12
    assert lines[-1] == "reconstruct 100/100"


def test_json_events_are_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)
    console.on_event(Event(kind="stage", stage="split", total=4))
    console.on_event(Event(kind="warning", message="no vertical unit"))
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    counts = {"done": 0, "total": 4, "kept": 0, "failed": 0, "facts": {}}
    assert events[0] == {"kind": "stage", "stage": "split", "message": "", **counts}
    assert events[1] == {"kind": "warning", "message": "no vertical unit"}


def test_quiet_keeps_the_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(quiet=True)
    console.on_event(Event(kind="progress", stage="split", done=1, total=4))
    console.on_event(Event(kind="warning", message="no vertical unit"))
    assert capsys.readouterr().err == "warning: no vertical unit\n"


def test_a_terminal_gets_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with Console() as console:
        console.on_event(Event(kind="stage", stage="split", total=4))
        console.on_event(Event(kind="progress", stage="split", done=4, total=4))
        console.on_event(Event(kind="warning", message="no vertical unit"))
    text = terminal.getvalue()
    assert "4/4" in text
    assert "no vertical unit" in text


def test_a_terminal_is_reported_that_a_run_waits_for_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with Console() as console:
        console.on_event(Event(kind="stage", stage="split", total=4))
        console.on_event(Event(kind="waiting", stage="split", message="no worker has been there for 3 s"))
    assert "no worker has been there for 3 s" in terminal.getvalue()


def test_tables_are_silent_for_machines(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)
    console.table("Roofs", ["type", "count"], [["gable", 1]])
    console.say("hello")
    console.document({"buildings": 1})
    assert json.loads(capsys.readouterr().out) == {"buildings": 1}


def test_figures_are_set_to_the_right_and_words_to_the_left(capsys: pytest.CaptureFixture[str]) -> None:
    Console().table("", ["roof", "share"], [["gable", "98.5 %"], ["hip", "1 %"]])
    lines = [line.strip("│┃ ") for line in capsys.readouterr().out.splitlines()]
    assert "gable │ 98.5 %" in lines
    assert "hip   │    1 %" in lines


def test_a_table_without_rows_is_not_shown(capsys: pytest.CaptureFixture[str]) -> None:
    Console().table("Reasons", ["reason", "count"], [])
    assert capsys.readouterr().out == ""
