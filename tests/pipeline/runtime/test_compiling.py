"""What is compiled before a job, and what is said about it; nothing is compiled here."""

import importlib
import stat
from collections.abc import Callable, Iterable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import invoke

from pipeline.compiler import store, warm_up
from pipeline.compiler.warm_up import Listed, about_s
from pipeline.errors import RunError
from pipeline.runtime import compile_listed, compiling
from pipeline.runtime.compiling import RECONSTRUCT, compile_first, compiling_s, kernel_groups, missing_kernels
from pipeline.runtime.monitoring.progress import Event


@pytest.fixture
def cold(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine without compiled kernels."""
    monkeypatch.setattr(store, "folder_of_kernels", lambda: tmp_path / "kernels")
    monkeypatch.setattr(store, "shipped_folder", lambda: tmp_path / "none")
    return tmp_path / "kernels"


def compiler(*, fails: Exception | None = None) -> Callable[..., int]:
    """Reports each kernel, and compiles none."""

    def compile_kernels(
        kernels: Iterable[Listed], processes: int, on_progress: Callable[[int, int, float], None], **_: Any
    ) -> int:
        assert processes >= 1
        whole = list(kernels)
        if fails is not None:
            raise fails
        for done in range(1, len(whole) + 1):
            on_progress(done, len(whole), float(len(whole) - done))
        return len(whole)

    return compile_kernels


def said(monkeypatch: pytest.MonkeyPatch, groups: tuple[str, ...] = RECONSTRUCT, **options: Any) -> list[Event]:
    monkeypatch.setattr(warm_up, "compile_kernels", compiler(**options))
    events: list[Event] = []
    compile_first(events.append, groups)
    return events


def test_the_first_word_says_what_is_done_once_and_for_how_long(cold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "cores", lambda: 2)
    monkeypatch.setattr(compile_listed, "cores", lambda: 2)
    first, *rest = said(monkeypatch)
    kernels = warm_up.listed(RECONSTRUCT)
    assert (first.kind, first.stage, first.total) == ("stage", "compile", len(kernels))
    assert first.message == f"compiling, once, about {about_s(kernels, 2):.0f} s"
    assert [event.done for event in rest] == list(range(1, len(kernels) + 1))
    assert rest[0].message == f"compiling, once, about {len(kernels) - 1} s left"
    assert rest[-1].message == ""
    assert {event.stage for event in rest} == {"compile"}


def test_nothing_is_said_or_done_where_all_is_compiled(cold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "kernels_are_compiled", lambda: True)
    assert said(monkeypatch) == []
    assert compiling_s() == 0.0
    # those of other groups are looked at by themselves
    assert missing_kernels(("terrain",)) == missing_kernels(("reconstruct", "terrain")) == warm_up.listed(["terrain"])


def test_one_kernel_that_is_missing_makes_a_group_incomplete(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = {one.kernel: True for one in warm_up.listed()}
    kernels_by_name = importlib.import_module("pipeline.compiler.kernel")  # the package has a function of its name
    monkeypatch.setattr(kernels_by_name, "kernel_named", lambda name: SimpleNamespace(is_compiled=compiled[name]))
    kernels = warm_up.listed(["terrain"])
    assert missing_kernels(("terrain", "compare")) == []
    for end in (kernels[0], kernels[-1]):
        compiled[end.kernel] = False
        assert missing_kernels(("terrain", "compare")) == kernels
        compiled[end.kernel] = True


def test_the_forecast_grows_with_the_code_and_falls_with_the_cores(cold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert about_s([], 4) == 0.0
    small, large = warm_up.listed(["terrain"]), warm_up.listed()
    assert 0.0 < about_s(small, 2) < about_s(large, 4) < about_s(large, 2) < 2.0 * about_s(large, 4)
    monkeypatch.setattr(compiling, "cores", lambda: 2)
    assert 10.0 < compiling_s() < 60.0
    assert compiling_s(("reconstruct", "compare")) > compiling_s()


def test_a_folder_that_cannot_be_written_is_named_with_the_fix(cold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cold.parent.joinpath("kernels").write_text("a file in the place of the folder")
    cold.chmod(stat.S_IRUSR)
    monkeypatch.setattr(store.os, "access", lambda *_: False)  # for root, who may write anywhere
    (warning,) = said(monkeypatch)
    assert warning.kind == "warning"
    assert str(cold) in warning.message
    assert "NUMBA_CACHE_DIR" in warning.message


@pytest.mark.parametrize("error", [BrokenProcessPool("a process died"), OSError("no more processes")])
def test_a_job_goes_on_where_kernels_cannot_be_compiled_ahead(
    cold: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    first, warning = said(monkeypatch, fails=error)
    assert first.kind == "stage"
    assert warning.kind == "warning"
    assert str(error) in warning.message


def test_options_need_kernels_of_their_own() -> None:
    assert kernel_groups() == kernel_groups(method="arrangement", terrain="none") == RECONSTRUCT
    assert kernel_groups(method="kmeans", points=True, terrain="tin") == (
        "reconstruct",
        "compare",
        "classify",
        "terrain",
    )
    assert set(kernel_groups(method="kmeans", points=True, terrain="tin")) <= set(warm_up.groups())


COMMANDS = {
    "reconstruct": ("--out", "{out}"),
    "compare": ("--methods", "arrangement,kmeans", "--out", "{out}"),
    "classify": ("--out", "{out}"),
}


@pytest.fixture
def compiled_groups(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """Gets the groups that commands compile, which is where they end."""
    found: list[tuple[str, ...]] = []

    def note(_: object, groups: tuple[str, ...]) -> None:
        found.append(groups)
        raise RunError("compiled")

    monkeypatch.setattr(compiling, "compile_first", note)
    monkeypatch.setattr(compiling, "missing_kernels", warm_up.listed)
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_a_mistyped_name_or_option_is_an_error_before_anything_is_compiled(
    command: str, tmp_path: Path, suburb: Path, compiled_groups: list[tuple[str, ...]]
) -> None:
    options = [word.format(out=tmp_path / "out") for word in COMMANDS[command]]
    wrong = tmp_path / "settings.toml"
    wrong.write_text("[settings]\ntile_size_meters = 100.0\n")
    for words, named in (
        ([str(tmp_path / "nicht.laz")], "nicht.laz"),
        ([str(suburb), "--footprints", str(tmp_path / "nicht.gpkg")], "nicht.gpkg"),
        ([str(suburb), "--settings", str(wrong)], "tile_size_meters"),
    ):
        code, _, said = invoke(command, *words, *options)
        assert (code != 0, named in said) == (True, True), said
    assert compiled_groups == []


def test_groups_follow_the_settings_file_and_the_earlier_run(
    tmp_path: Path, suburb: Path, compiled_groups: list[tuple[str, ...]], reconstruct: Any
) -> None:
    file = tmp_path / "settings.toml"
    file.write_text('[settings]\nmethod = "kmeans"\nterrain = "tin"\n')
    invoke("reconstruct", str(suburb), "--out", str(tmp_path / "out"), "--settings", str(file))
    made = reconstruct(suburb, settings={"method": "kmeans"})
    invoke("rerun", made.run_dir)
    assert compiled_groups == [("reconstruct", "compare", "terrain"), ("reconstruct", "compare")]


def test_a_batch_compiles_only_once_its_files_and_folders_are_found(
    tmp_path: Path, suburb: Path, compiled_groups: list[tuple[str, ...]]
) -> None:
    batch = tmp_path / "city.toml"
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "notes.txt").write_text("another's file")
    for inputs, out, named in (
        (f'paths = ["{tmp_path}/nicht.laz"]', "out", "nicht.laz"),
        (f'paths = ["{suburb}"]\nfootprints = "nicht.gpkg"', "out", "nicht.gpkg"),
        (f'paths = ["{suburb}"]\naoi = "nicht.geojson"', "out", "nicht.geojson"),
        (f'paths = ["{suburb}"]', "taken", "[output] path"),
    ):
        batch.write_text(f'[inputs]\n{inputs}\n[output]\npath = "{out}"\n[work]\npath = "work"\n')
        code, _, said = invoke("batch", "run", str(batch))
        assert (code != 0, named in said.replace("\n", "")) == (True, True), said
        assert compiled_groups == []
    batch.write_text(f'[inputs]\npaths = ["{suburb}"]\n[output]\npath = "out"\n[work]\npath = "work"\n')
    invoke("batch", "run", str(batch))
    assert compiled_groups == [("reconstruct",)]
