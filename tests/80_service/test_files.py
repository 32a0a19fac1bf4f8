"""The state folder belongs to its account alone."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_service import settings_in
from typer.testing import CliRunner

from service.app import start
from service.cli import app
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
