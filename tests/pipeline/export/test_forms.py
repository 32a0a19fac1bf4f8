"""Every form of publishing: all of a run, nothing of it changed, and a result that is whole or the one of before."""

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import small_buildings as small
from command_line import invoke
from small_runs import content, moved, restated, street, tiled_run

from pipeline.errors import RunError, SettingsError
from pipeline.extras.publish.publishing import COMMAND_FORMS, FORMS, Form
from pipeline.io import storage_at
from pipeline.registry import loaded
from pipeline.runtime.digest import run_digest
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.monitoring.progress import Event

Write = Callable[..., Any]
FOLDERS = {"3dtiles", "cityjson", "stac"}
pytestmark = pytest.mark.parametrize("form", FORMS.values(), ids=lambda form: form.name)


@pytest.fixture
def run_dir(tmp_path: Path, contexts: small.Contexts) -> Path:
    """A finished run of four buildings on two tiles."""
    fallback, court, *others = street()
    return tiled_run(tmp_path / "run", {"x85_y447": [fallback, moved(court, 50.0)], "x86_y447": others}, contexts)


@pytest.fixture
def write(form: Form) -> Write:
    """The writer of the form, with what it needs beside."""
    more = {"sky_only": True} if form.name == "solar" else {}
    return lambda run_dir, out, **options: form.write(str(run_dir), str(out), **more, **options)


def place(folder: Path, form: Form, name: str = "out") -> Path:
    """A place for a form in a folder."""
    return folder / (name if form.name in FOLDERS else f"{name}{Path(form.outputs[0].filename).suffix}")


def held(out: Path) -> dict[str, bytes]:
    """All files of a form."""
    return content(out) if out.is_dir() else {"": out.read_bytes()}


def test_it_names_its_writer_and_the_options_that_it_takes(form: Form) -> None:
    taken = inspect.signature(loaded(form.place)).parameters
    assert list(taken)[:2] == ["run_dir", "out"]
    assert {"overwrite", "on_event", *form.options, *form.beside} <= set(taken)
    assert bool(form.root) == bool(form.moved) == any(one.holds == "root" for one in form.outputs)
    assert not form.moved or callable(loaded(form.moved))
    assert set(form.beside.values()) <= {one.output_id for one in form.outputs}


def test_the_run_stays_as_it_is_and_gives_the_same_bytes_each_time(
    form: Form, write: Write, run_dir: Path, tmp_path: Path
) -> None:
    before, digest = content(run_dir), run_digest(str(run_dir))
    first, second = place(tmp_path / "new", form), place(tmp_path / "two", form, "new!")
    published = write(run_dir, first)
    write(run_dir, second)
    assert held(first) == held(second)
    assert (published.place, published.size_bytes) == (str(first), sum(map(len, held(first).values())))
    assert content(run_dir) == before
    assert run_digest(str(run_dir)) == digest
    assert list(first.parent.iterdir()) == [first]


@pytest.mark.parametrize("status", [status for status in RunStatus if status is not RunStatus.FINISHED])
def test_a_run_that_is_not_finished_is_refused(
    form: Form, write: Write, run_dir: Path, tmp_path: Path, status: RunStatus
) -> None:
    restated(run_dir, status=status, tiles=("x85_y447", "x86_y447"), failed_tiles=("x86_y447",))
    with pytest.raises(RunError, match=rf"{run_dir} is {status.value}") as refused:
        write(run_dir, place(tmp_path, form))
    assert ("1 of 2 tiles failed (x86_y447)" in str(refused.value)) == (status is RunStatus.INCOMPLETE)
    assert list(tmp_path.iterdir()) == [run_dir]


def test_a_folder_without_a_run_is_refused(form: Form, write: Write, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with pytest.raises(RunError, match=r"run\.json does not exist: give the directory that a run wrote"):
        write(tmp_path / "run", place(tmp_path, form))


def test_it_is_replaced_only_where_asked(form: Form, write: Write, run_dir: Path, tmp_path: Path) -> None:
    out = place(tmp_path, form)
    write(run_dir, out)
    fresh = held(out)
    changed = min(path for path in (out.rglob("*") if out.is_dir() else [out]) if path.is_file())
    if form.name != "stac":  # a Collection of before says which run it is of
        changed.write_text("of before")
    before = held(out)
    with pytest.raises(RunError, match=r"already.*--overwrite"):
        write(run_dir, out)
    assert held(out) == before
    write(run_dir, out, overwrite=True)
    assert held(out) == fresh


def test_a_place_that_it_cannot_have_is_refused(form: Form, write: Write, run_dir: Path, tmp_path: Path) -> None:
    places = {
        f"s3://bucket/{place(Path(), form)}": "path of this machine",
        place(run_dir, form): "in the run directory",
    }
    (tmp_path / "file").write_text("mine")
    if form.name not in FOLDERS:
        places[tmp_path / "out.zip"] = r"ends in \.zip: give a name that ends in \."
    before = content(tmp_path)
    for out, words in places.items():
        with pytest.raises(SettingsError, match=words):
            write(run_dir, out, overwrite=True)
    taken = tmp_path / "file"
    if form.name not in FOLDERS:
        taken = place(tmp_path / "taken", form)
        taken.mkdir(parents=True)
    with pytest.raises(RunError, match=r"is a folder: give the name of a file|is a file: give the name of a folder"):
        write(run_dir, taken, overwrite=True)
    with pytest.raises(RunError, match="/proc/nothing"):
        write(run_dir, place(Path("/proc/nothing"), form))
    assert content(tmp_path) == before


@pytest.mark.parametrize("fault", [RunError("the disk is gone"), KeyboardInterrupt(), MemoryError()])
def test_where_it_breaks_off_what_was_there_stays(
    form: Form, write: Write, run_dir: Path, tmp_path: Path, fault: BaseException
) -> None:
    def breaking(event: Event) -> None:
        if event.done == event.total:
            raise fault

    out = place(tmp_path / "out", form)
    write(run_dir, out)
    before = content(tmp_path)
    with pytest.raises(type(fault)):
        write(run_dir, out, overwrite=True, on_event=breaking)
    assert content(tmp_path) == before


def test_a_run_that_changes_meanwhile_is_refused(form: Form, write: Write, run_dir: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="changed while it was published"):
        write(run_dir, place(tmp_path, form), on_event=lambda _: restated(run_dir, status=RunStatus.RUNNING))
    assert list(tmp_path.iterdir()) == [run_dir]


def test_a_run_that_lost_a_file_is_refused(form: Form, write: Write, run_dir: Path, tmp_path: Path) -> None:
    table = {"cityjson": "cityjson", "3dtiles": "cityjson", "stac": "cityjson", "solar": "planes"}
    (lost,) = (run_dir / table.get(form.name, "buildings") / "tile=x86_y447").iterdir()
    lost.unlink()
    with pytest.raises(RunError, match=rf"tile=x86_y447/{lost.name} of the run .* is gone|has 2 rows, but"):
        write(run_dir, place(tmp_path, form))
    assert list(tmp_path.iterdir()) == [run_dir]


def test_a_run_with_other_rows_than_it_counts_is_refused(
    form: Form, write: Write, run_dir: Path, tmp_path: Path
) -> None:
    restated(run_dir, counts={"candidates": 5})
    if form.name in COMMAND_FORMS:
        with pytest.raises(RunError, match=r"has 4 rows, but run\.json counts 5"):
            write(run_dir, place(tmp_path, form))
        assert list(tmp_path.iterdir()) == [run_dir]


@pytest.mark.slow
def test_a_run_in_an_object_store_gives_the_same(
    form: Form, write: Write, run_dir: Path, tmp_path: Path, bucket: str
) -> None:
    stored = storage_at(f"{bucket}/run")
    for name, data in content(run_dir).items():
        stored.put(name, data)
    remote, local = place(tmp_path / "remote", form), place(tmp_path / "local", form)
    write(f"{bucket}/run", remote)
    write(run_dir, local)
    if form.name != "stac":  # its files refer to those of the run
        assert held(remote) == held(local)
    assert set(held(remote)) == set(held(local))


def test_the_command_prints_what_it_wrote_and_ends_with_the_code_of_the_fault(
    form: Form, run_dir: Path, tmp_path: Path
) -> None:
    out = place(tmp_path, form)
    own = {"solar": ("--sky-only",)}.get(form.name, ())
    words = ("publish", str(run_dir), "--as", form.name) if form.name in COMMAND_FORMS else (form.name, str(run_dir))
    code, said, _ = invoke(*words, *own, "--out", str(out), "--json")
    document = json.loads(said)
    assert (code, document["place"], document.get("as", form.name)) == (0, str(out), form.name)
    assert sum(document["rows"].values()) > 0
    assert invoke(*words, *own, "--out", str(out))[0] == 4
    assert invoke(*words, *own, "--out", str(out), "--overwrite")[0] == 0
    assert invoke(*words, *own, "--out", str(run_dir / "x"))[0] == 2
