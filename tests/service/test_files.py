"""The state folder belongs to its account alone."""

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import app
from live_service import settings_in
from typer.testing import CliRunner

from pipeline.console import ExitCode
from service.app import start
from service.errors import StartUpError
from service.files import StateFolder, keep_private
from service.store import JobStore


@pytest.fixture(autouse=True)
def usual_umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


def modes(state: Path) -> set[str]:
    """The modes of a state folder, of its folders and of the database's files."""
    found = [state, *state.iterdir()]
    return {oct(stat.S_IMODE(path.stat().st_mode)) for path in found}


def test_the_first_key_makes_a_folder_that_others_cannot_read(tmp_path: Path) -> None:
    state = tmp_path / "state"
    result = CliRunner().invoke(app, ["keys", "create", "--name", "a", "--state", str(state)])
    assert result.exit_code == 0
    assert (state / "service.db").is_file()
    assert modes(state) == {"0o700", "0o600"}


def test_a_service_takes_the_rights_of_others_from_an_old_folder(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    with JobStore(settings.database) as store:
        start(settings, store)
        for path in (settings.state, *settings.state.iterdir()):
            path.chmod(0o755 if path.is_dir() else 0o644)
        start(settings, store)
        assert {path.name for path in settings.state.iterdir()} >= {"service.db", "service.db-wal"}
        assert modes(settings.state) == {"0o700", "0o600"}


def test_a_group_keeps_its_rights_if_the_folder_is_shared_with_it(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path / "state")
    folder.root.mkdir()
    folder.root.chmod(0o2775)
    database = folder.root / "service.db"
    database.touch()
    database.chmod(0o664)
    folder.make()
    keep_private(database)
    assert stat.S_IMODE(folder.root.stat().st_mode) == 0o2770
    assert stat.S_IMODE(database.stat().st_mode) == 0o660


def test_the_folder_of_another_account_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(path: Path, mode: int) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    tmp_path.chmod(0o755)
    monkeypatch.setattr(Path, "chmod", refuse)
    keep_private(tmp_path)
    assert f"{tmp_path} can be read by other users" in caplog.text


# --- paths of the wrong kind -----------------------------------------------------------------------------------------


@pytest.fixture
def wrong(tmp_path: Path) -> dict[str, Path]:
    """Paths that cannot be folders."""
    file = tmp_path / "file"
    file.write_text("content")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    return {"file": file, "below a file": file / "below", "link": tmp_path / "link"}


WRONG = ("file", "below a file", "link")


@pytest.mark.parametrize("command", ["serve --no-driver", "driver", "keys list", "keys create --name a"])
@pytest.mark.parametrize("kind", WRONG)
def test_a_state_folder_that_is_none_is_refused_with_its_path_and_the_fix(
    command: str, kind: str, wrong: dict[str, Path]
) -> None:
    result = CliRunner().invoke(app, [*command.split(), "--state", str(wrong[kind])])
    assert result.exit_code == ExitCode.USAGE
    assert f"the state folder {wrong[kind]} cannot be used: " in result.stderr
    assert ("leads nowhere" if kind == "link" else f"{wrong['file']} is not a folder") in result.stderr
    assert "name a folder with --state, or GABLEWORK_STATE" in result.stderr
    assert "fault of gablework" not in result.stderr


@pytest.mark.parametrize("kind", WRONG)
def test_a_backup_neither_comes_from_nor_goes_to_what_is_no_folder(
    kind: str, wrong: dict[str, Path], tmp_path: Path
) -> None:
    state = tmp_path / "state"
    assert CliRunner().invoke(app, ["keys", "list", "--state", str(state)]).exit_code == 0
    for words, match in (
        (["backup", "--state", state, "--to", wrong[kind]], f"the backup cannot go to {wrong[kind]}: "),
        (["backup", "--state", wrong[kind], "--to", tmp_path / "b"], f"the state folder {wrong[kind]} "),
    ):
        result = CliRunner().invoke(app, [str(word) for word in words])
        assert result.exit_code == ExitCode.USAGE
        assert match in result.stderr
    assert CliRunner().invoke(app, ["backup", "--state", str(state), "--to", str(tmp_path / "b")]).exit_code == 0
    result = CliRunner().invoke(app, ["restore", str(tmp_path / "b"), "--state", str(wrong[kind])])
    assert result.exit_code == ExitCode.USAGE
    assert f"the service cannot be restored into {wrong[kind]}: " in result.stderr


def test_a_database_that_is_a_folder_or_below_a_file_is_refused(wrong: dict[str, Path], tmp_path: Path) -> None:
    for place in (tmp_path, wrong["below a file"]):
        result = CliRunner().invoke(app, ["keys", "list", "--database-url", f"sqlite:///{place}"])
        assert result.exit_code == ExitCode.USAGE
        assert f"the SQLite database cannot be {place}: " in result.stderr


def test_a_root_of_inputs_that_is_a_file_is_refused_and_one_that_comes_later_is_not(
    wrong: dict[str, Path], tmp_path: Path
) -> None:
    for root, refused in ((wrong["file"], True), (tmp_path / "mounted later", False)):
        settings = settings_in(tmp_path, input_roots=(root,))
        expected = pytest.raises(StartUpError, match="is not a folder") if refused else contextlib.nullcontext()
        with JobStore(settings.database) as store, expected:
            start(settings, store)


def test_a_folder_that_this_account_may_not_write_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda place, _mode: Path(place) != tmp_path)
    with pytest.raises(StartUpError, match=rf"may not write into {tmp_path}\. Change that, or name a folder"):
        StateFolder(tmp_path / "state").prepare()
