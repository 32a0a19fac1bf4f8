"""What starts and ends the programs of other tests does as it says."""

import signal
import sys
from pathlib import Path

import psutil
import pytest
import sqlalchemy as sa
from processes import REQUIRED, PostgresServer, Program, Programs, free_port, lives, program, wait_for

PARENT = """
import subprocess, sys
subprocess.Popen([sys.executable, "-c", "import time; print('child', flush=True); time.sleep(600)"])
print("parent", flush=True)
import time; time.sleep(600)
"""

POLITE = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
print("ready", flush=True)
time.sleep(600)
"""


def two(programs: Programs) -> tuple[Program, psutil.Process]:
    """A process and its child, both at work."""
    parent = programs.start("parent", [sys.executable, "-c", PARENT])
    parent.wait_for_text("parent")
    parent.wait_for_text("child")
    return parent, parent.children()[0]


def test_the_end_of_a_test_leaves_neither_parent_nor_child(tmp_path: Path) -> None:
    programs = Programs(tmp_path)
    parent, child = two(programs)
    assert parent.alive
    programs.end()
    assert not parent.alive
    wait_for(lambda: not lives(child), "the end of the child")


def test_an_orphan_is_ended_too(tmp_path: Path) -> None:
    programs = Programs(tmp_path)
    parent, child = two(programs)
    parent.kill(group=False)
    assert child.is_running()
    programs.end()
    wait_for(lambda: not lives(child), "the end of the orphan")


def test_stopping_gives_the_exit_code(programs: Programs) -> None:
    polite = programs.start("polite", [sys.executable, "-c", POLITE])
    polite.wait_for_text("ready")
    assert polite.stop() == 7
    rude = programs.start("rude", [sys.executable, "-c", "print('ready', flush=True); import time; time.sleep(600)"])
    rude.wait_for_text("ready")
    assert rude.stop() == -signal.SIGTERM


def test_a_program_that_ends_early_fails_the_wait_with_its_log(programs: Programs) -> None:
    broken = programs.start("broken", [sys.executable, "-c", "raise SystemExit('no such thing')"])
    with pytest.raises(pytest.fail.Exception, match="no such thing"):
        broken.wait_for_port(free_port())


def test_a_missing_program_skips_or_fails_as_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(REQUIRED, raising=False)
    with pytest.raises(pytest.skip.Exception, match="nosuchprogram"):
        program("nosuchprogram")
    monkeypatch.setenv(REQUIRED, "1")
    with pytest.raises(pytest.fail.Exception, match="nosuchprogram"):
        program("nosuchprogram")


@pytest.mark.slow
def test_postgres_gives_every_test_a_database_of_its_own_and_survives_a_stop(postgres_server: PostgresServer) -> None:
    first, second = (sa.create_engine(postgres_server.create_database()) for _ in range(2))
    with first.begin() as connection:
        connection.execute(sa.text("create table things (name text)"))
    assert sa.inspect(first).get_table_names() == ["things"]
    assert sa.inspect(second).get_table_names() == []
    postgres_server.stop()
    postgres_server.start()
    first.dispose()
    assert sa.inspect(first).get_table_names() == ["things"]
    for engine in (first, second):
        engine.dispose()
