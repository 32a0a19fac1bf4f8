"""Faults that strike a batch run, the stages at which they do, and what became of it, as rows of a table."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.dataset as pads
import pytest
from deployment import Gates, kill_process
from faults import asked
from object_store import FaultyProxy
from object_store import environment as environment_of
from processes import Program, Programs, free_port, program

from pipeline.io.urls import filesystem_of
from pipeline.runtime.digest import run_digest

STAGES = ("ingest", "split", "reconstruct", "publish")
REFUSED, INTERRUPTED, KILLED = 4, 130, -signal.SIGKILL
"""Exit codes."""


class BatchRun:
    """A batch file in a folder of its own, run by real processes.

    Parameters
    ----------
    programs : Programs
        Starts and ends them.
    folder : Path
        Gets batch file, work folder and results.
    tiles : Path
        The inputs.
    external : bool
        Whether scheduler and workers are processes of their own.
    faults : mapping, optional
        Further faults, as `tests/faults` understands them.
    store, bucket : optional
        An object store that holds input and results in place of the folder.
    """

    def __init__(
        self,
        programs: Programs,
        folder: Path,
        tiles: Path,
        *,
        external: bool = False,
        faults: Mapping[str, Any] | None = None,
        store: FaultyProxy | None = None,
        bucket: str = "",
    ) -> None:
        folder.mkdir()
        self.folder = folder
        self.gates = Gates(folder / "gates")
        self.full = folder / "full"
        self.full.mkdir()
        self.store = store
        self._programs = programs
        self.out = str(folder / "models")
        inputs = str(tiles)
        if store is not None:
            self.out, inputs = f"{bucket}/models", f"{bucket}/in/{tiles.name}"
            filesystem_of(inputs).put_file(str(tiles), inputs)
        self.environment = {
            "OPENBLAS_NUM_THREADS": "1",
            **({} if store is None else environment_of(store.endpoint)),
            **asked.environment(pause=self.gates.asked, full=dict.fromkeys(STAGES, str(self.full)), **(faults or {})),
        }
        self.port = free_port()
        self.workers: list[Program] = []
        self.scheduler: Program | None = None
        cluster = f'scheduler = "tcp://127.0.0.1:{self.port}"' if external else "workers = 2"
        self.file = folder / "batch.toml"
        self.file.write_text(
            f"[inputs]\npaths = [{json.dumps(inputs)}]\n[settings]\ntile_size_m = 60.0\n"
            f"[output]\npath = {json.dumps(self.out)}\nmeshes = {json.dumps('building' if store is None else 'tile')}\n"
            f"[cluster]\n{cluster}\nbuilding_timeout_s = 60.0\n"
        )
        if external:
            self.start_scheduler()
            self.workers = [
                self._start("worker", "worker", "--scheduler", f"tcp://127.0.0.1:{self.port}") for _ in "ab"
            ]

    def start_scheduler(self) -> None:
        """Start the scheduler, also again."""
        command = [str(program("dask")), "scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        self.scheduler = self._programs.start("scheduler", command, env=self.environment)
        self.scheduler.wait_for_port(self.port)

    def _start(self, name: str, *arguments: str) -> Program:
        return self._programs.start(name, [str(program("gablework")), *arguments], env=self.environment)

    def start(self) -> Program:
        """Begin the run, or go on with it."""
        return self._start("driver", "batch", "run", str(self.file), "--quiet")

    def held(self, driver: Program, stage: str) -> int:
        """Wait until a task is held in a stage; its process."""
        return driver.wait_for(lambda: self.gates.reached(stage), f"a task in {stage}")

    def status(self) -> dict[str, Any]:
        """What the status command tells."""
        command = [str(program("gablework")), "batch", "status", str(self.file), "--json"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stderr
        found: dict[str, Any] = json.loads(ended.stdout)
        return found

    @property
    def digest(self) -> str:
        """Of the content of the results."""
        return run_digest(self.out)

    def buildings(self) -> dict[str, tuple[str, str | None]]:
        """Status and reason of every building."""
        rows = pads.dataset(Path(self.out, "buildings")).to_table(["building_id", "status", "reason"])
        return {row["building_id"]: (row["status"], row["reason"]) for row in rows.to_pylist()}


@dataclasses.dataclass(frozen=True)
class Row:
    """What became of a batch run."""

    fault: str
    stage: str
    first: str
    """How the driver ended, and what the status command said then."""
    second: str
    """The same of the second driver; empty where there was none to be."""
    content: str
    """Against that of an undisturbed run."""
    done_twice: str
    """Whether buildings were modelled again that were done before."""

    @property
    def cells(self) -> tuple[str, ...]:
        """As the table has them."""
        return (self.fault, self.stage, self.first, self.second or "not needed", self.content, self.done_twice)


HEADER = ("fault", "while the run is in", "first run", "run again", "content", "modelled twice")


def kill_driver(run: BatchRun, driver: Program, pid: int) -> None:
    """Driver, embedded scheduler and workers, all at once."""
    driver.kill()


def interrupt(run: BatchRun, driver: Program, pid: int) -> None:
    """Ctrl-C reaches the driver; its tasks are let through, as they would end by themselves."""
    os.kill(driver.pid, signal.SIGINT)
    run.gates.open()


def terminate(run: BatchRun, driver: Program, pid: int) -> None:
    """As systemd and Kubernetes end a process."""
    os.kill(driver.pid, signal.SIGTERM)
    run.gates.open()


def kill_worker(run: BatchRun, driver: Program, pid: int) -> None:
    """What the kernel does when memory runs out."""
    kill_process(pid)
    run.gates.open()


def fill_disk(run: BatchRun, driver: Program, pid: int) -> None:
    """No byte can be written any more."""
    (run.full / "full").touch()
    run.gates.open()


def kill_scheduler(run: BatchRun, driver: Program, pid: int) -> None:
    """The scheduler's machine is gone."""
    assert run.scheduler is not None
    run.scheduler.kill()
    run.gates.open()


def second_driver(run: BatchRun, driver: Program, pid: int) -> None:
    """Somebody starts the same batch once more: it refuses, and the first goes on."""
    other = run.start()
    assert other.ended() == REFUSED
    assert "is at work already" in other.text
    run.gates.open()


def every(what: str, *, of: int) -> Callable[[BatchRun, Program, int], None]:
    """From now on something becomes of one in so many of the store's requests."""

    def strike_store(run: BatchRun, driver: Program, pid: int) -> None:
        assert run.store is not None
        run.store.reset()
        run.store.script = lambda request: what if request.number % of == 0 else "pass"
        run.gates.open()

    return strike_store


def silent_at_first(run: BatchRun, driver: Program, pid: int) -> None:
    """The first two requests are never answered."""
    assert run.store is not None
    run.store.reset()
    run.store.script = lambda request: "silent" if request.number <= 2 else "pass"
    run.gates.open()


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something that goes wrong while a batch run is in a stage."""

    name: str
    strike: Callable[[BatchRun, Program, int], None]
    code: int
    """How the driver ends."""
    state: str
    """What the status command says then."""
    stages: Sequence[str] = STAGES
    external: bool = False
    """Whether scheduler and workers are processes of their own."""
    in_store: bool = False
    """Whether input and results lie in an object store, which it strikes."""


TOUCHED = ("ingest", "publish")
"""Stages that use the store."""

FAULTS = (
    Fault("driver killed, its embedded cluster too", kill_driver, KILLED, "dead"),
    Fault("driver killed, workers elsewhere go on", kill_driver, KILLED, "dead", external=True),
    Fault("Ctrl-C", interrupt, INTERRUPTED, "interrupted"),
    Fault("SIGTERM", terminate, INTERRUPTED, "interrupted", stages=("split", "reconstruct")),
    Fault("worker's process killed", kill_worker, 0, "finished"),
    Fault("scheduler killed", kill_scheduler, REFUSED, "failed", external=True),
    Fault("disk full", fill_disk, REFUSED, "failed"),
    Fault("a second driver", second_driver, 0, "finished", stages=("reconstruct",)),
    Fault("store: 1 of 6 requests refused as busy", every("busy", of=6), 0, "finished", TOUCHED, in_store=True),
    Fault("store: 1 of 6 answers lost", every("lost", of=6), 0, "finished", ("publish",), in_store=True),
    Fault("store: 1 of 6 answers cut in half", every("half", of=6), 0, "finished", ("ingest",), in_store=True),
    Fault("store: all answers late", every("late", of=1), 0, "finished", ("publish",), in_store=True),
    Fault("store: two requests never answered", silent_at_first, 0, "finished", TOUCHED, in_store=True),
    Fault("store: no access any more", every("denied", of=1), REFUSED, "failed", TOUCHED, in_store=True),
)
ENDINGS = {0: "done", REFUSED: "error", INTERRUPTED: "interrupted", KILLED: "killed"}


def strike(run: BatchRun, fault: Fault, stage: str, undisturbed: str) -> Row:
    """Let a fault strike in a stage, mend it, and run the batch again where it is not finished."""
    run.gates.close(stage)
    driver = run.start()
    pid = run.held(driver, stage)
    fault.strike(run, driver, pid)
    code = driver.ended()
    assert code in ENDINGS, driver.tail()
    assert "Traceback" not in driver.text, driver.tail()
    first = run.status()
    told = [f"{ENDINGS[code]}, {first['state']}"]
    run.gates.open()
    (run.full / "full").unlink(missing_ok=True)
    if run.store is not None:
        run.store.reset()
    before = first["stages"].get("reconstruct", {"done": 0})["done"]
    twice = "no"
    if first["state"] != "finished":
        if run.scheduler is not None and not run.scheduler.alive:
            run.start_scheduler()
        again = run.start()
        assert again.ended() == 0, again.tail()
        last = run.status()
        told.append(f"done, {last['state']}")
        twice = "no" if last["stages"]["reconstruct"]["kept"] >= before else "yes"
    content = "same" if run.digest == undisturbed else "differs"
    return Row(fault.name, stage, told[0], "".join(told[1:]), content, twice)


PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "batch_faults.md"


def rows_told() -> list[list[str]]:
    """The rows of the page's table, cell by cell."""
    lines = [line.strip("| ").split(" | ") for line in PAGE.read_text().splitlines() if line.startswith("|")]
    assert tuple(lines[0]) == HEADER
    return lines[2:]


def check(run: BatchRun, fault: Fault, stage: str, undisturbed: BatchRun) -> None:
    """A batch run outlives a fault, and the page says how."""
    row = strike(run, fault, stage, undisturbed.digest)
    assert row.first.endswith(fault.state), row
    assert (row.content, row.done_twice) == ("same", "no"), row
    assert list(row.cells) in rows_told(), f"{PAGE} has no row | {' | '.join(row.cells)} |"


def cases(*, in_store: bool) -> list[Any]:
    """Faults of a place and the stages at which they strike, for pytest."""
    found = [(fault, stage) for fault in FAULTS if fault.in_store == in_store for stage in fault.stages]
    return [pytest.param(fault, stage, id=f"{fault.name}: {stage}") for fault, stage in found]
