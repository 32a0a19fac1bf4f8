"""Faults that strike a batch run, the stages at which they do, and what became of it, as rows of a table."""

import dataclasses
import itertools
import json
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.dataset as pads
import pytest
from command_line import app
from deployment import Gates, kill_process
from faults import asked
from object_store import FaultyProxy
from object_store import environment as environment_of
from processes import Program, Programs, free_port, program
from typer.testing import CliRunner

from pipeline.extras.remote.urls import filesystem_of
from pipeline.runtime.digest import run_digest

STAGES = ("ingest", "split", "reconstruct", "publish")
REFUSED, INTERRUPTED, KILLED = 4, 130, -signal.SIGKILL
"""Exit codes."""


SETTINGS = {"tile_size_m": 60.0}
"""Several tiles, so that both workers have work in every stage."""


@dataclasses.dataclass(frozen=True)
class Undisturbed:
    """What a batch delivers when nothing happens to it."""

    digest: str
    buildings: Mapping[str, tuple[str, str | None]]


def buildings_of(run_dir: str) -> dict[str, tuple[str, str | None]]:
    """Status and reason of every building."""
    rows = pads.dataset(Path(run_dir, "buildings")).to_table(["building_id", "status", "reason"])
    return {row["building_id"]: (row["status"], row["reason"]) for row in rows.to_pylist()}


class BatchRun:
    """A batch file in a folder of its own, run by real processes.

    The folder gets batch file, work folder and results. `external` says whether scheduler and workers are processes of
    their own; `faults` are further ones, as `support/faults` understands them; `store` and `bucket` are an object store
    that holds input and results in place of the folder.
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
            f"[inputs]\npaths = [{json.dumps(inputs)}]\n[settings]\ntile_size_m = {SETTINGS['tile_size_m']}\n"
            f"[output]\npath = {json.dumps(self.out)}\nmeshes = {json.dumps('building' if store is None else 'tile')}\n"
            f"[cluster]\n{cluster}\nbuilding_timeout_s = 60.0\n"
        )
        if external:
            self.start_scheduler()
            address = f"tcp://127.0.0.1:{self.port}"
            self.workers = [self._start("worker", "worker", "--scheduler", address) for _ in "ab"]

    def start_scheduler(self) -> None:
        """Start the scheduler, also again."""
        self.scheduler = self._programs.start_scheduler(self.port, env=self.environment)

    def _start(self, name: str, *arguments: str) -> Program:
        return self._programs.start(name, [str(program("gablework")), *arguments], env=self.environment)

    def start(self) -> Program:
        """Begin the run, or go on with it."""
        return self._start("driver", "batch", "run", str(self.file), "--quiet")

    def mend(self) -> None:
        """The disk has room, the store answers, and the scheduler is there again."""
        (self.full / "full").unlink(missing_ok=True)
        if self.store is not None:
            self.store.reset()
        if self.scheduler is not None and not self.scheduler.alive:
            self.start_scheduler()

    def held(self, driver: Program, stage: str) -> int:
        """Wait until a task is held in a stage; its process."""
        return driver.wait_for(lambda: self.gates.reached(stage), f"a task in {stage}")

    def status(self) -> dict[str, Any]:
        """Output of the status command, run in this process, which is faster than starting another."""
        ended = CliRunner().invoke(app, ["batch", "status", str(self.file), "--json"])
        assert ended.exit_code == 0, ended.stderr
        found: dict[str, Any] = json.loads(ended.stdout)
        return found

    @property
    def digest(self) -> str:
        """Digest of the content of the results."""
        return run_digest(self.out)

    def buildings(self) -> dict[str, tuple[str, str | None]]:
        """Status and reason of every building."""
        return buildings_of(self.out)


@dataclasses.dataclass(frozen=True)
class Row:
    """What became of a batch that a fault struck in one stage after the other."""

    fault: str
    stages: str
    """Where it struck, in that order."""
    struck: str
    """How each driver ended that was struck, and what the status command said then."""
    last: str
    """The same of the driver that nothing happened to; empty where there was none to be."""
    content: str
    """Against that of an undisturbed run."""
    done_twice: str
    """Whether buildings were modelled again that the run before had done; `ONE_RUN` where there was none."""

    @property
    def cells(self) -> tuple[str, ...]:
        """As the table has them."""
        return (self.fault, self.stages, self.struck, self.last or "not needed", self.content, self.done_twice)


ONE_RUN = "-"
"""There was one run, so none before it had done anything."""

HEADER = ("fault", "strikes in", "run that is struck", "run after the last", "content", "modelled twice")


def kill_driver(run: BatchRun, driver: Program, pid: int) -> None:
    """Driver, embedded scheduler and workers, all at once."""
    driver.kill()


def interrupt(run: BatchRun, driver: Program, pid: int) -> None:
    """Ctrl-C reaches the driver."""
    os.kill(driver.pid, signal.SIGINT)


def terminate(run: BatchRun, driver: Program, pid: int) -> None:
    """As systemd and Kubernetes end a process."""
    os.kill(driver.pid, signal.SIGTERM)


def kill_worker(run: BatchRun, driver: Program, pid: int) -> None:
    """What the kernel does when memory runs out."""
    kill_process(pid)


def fill_disk(run: BatchRun, driver: Program, pid: int) -> None:
    """No byte can be written any more."""
    (run.full / "full").touch()


def kill_scheduler(run: BatchRun, driver: Program, pid: int) -> None:
    """The scheduler's machine is gone."""
    run.scheduler.kill()


def second_driver(run: BatchRun, driver: Program, pid: int) -> None:
    """Start the same batch again: it refuses, and the first one continues."""
    other = run.start()
    assert other.ended() == REFUSED
    assert "is at work already" in other.text


def every(what: str, *, of: int) -> Callable[[BatchRun, Program, int], None]:
    """From now on something becomes of one in so many of the store's requests."""

    def strike_store(run: BatchRun, driver: Program, pid: int) -> None:
        run.store.reset()
        run.store.script = lambda request: what if request.number % of == 0 else "pass"

    return strike_store


def silent_at_first(run: BatchRun, driver: Program, pid: int) -> None:
    """The first two requests are never answered."""
    run.store.reset()
    run.store.script = lambda request: "silent" if request.number <= 2 else "pass"


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something that goes wrong while a batch run is in a stage, and again in the next."""

    name: str
    strike: Callable[[BatchRun, Program, int], None]
    code: int
    """How the driver ends."""
    state: str
    """What the status command says then."""
    stages: Sequence[str] = STAGES
    """Where it strikes, in the order of a run."""
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


def strike(run: BatchRun, fault: Fault, undisturbed: str) -> Row:
    """Let a fault strike in its stages, one after the other: in one run, or where it ends that in the next."""
    struck, last, twice = (_in_one_run if fault.code == 0 else _in_one_run_each)(run, fault)
    content = "same" if run.digest == undisturbed else "differs"
    return Row(fault.name, ", ".join(fault.stages), struck, last, content, twice)


def _in_one_run(run: BatchRun, fault: Fault) -> tuple[str, str, str]:
    for stage in fault.stages:
        run.gates.close(stage)
    driver = run.start()
    for stage in fault.stages:
        fault.strike(run, driver, run.held(driver, stage))
        run.gates.open(stage)
    return _ended(run, driver), "", ONE_RUN


def _in_one_run_each(run: BatchRun, fault: Fault) -> tuple[str, str, str]:
    endings, modelled = [], []
    for stage in fault.stages:
        run.gates.close(stage)
        driver = run.start()
        pid = run.held(driver, stage)
        # the status is written once a second at most: what was done before this stage is in it now
        driver.wait_for(lambda stage=stage: run.status()["stage"] == stage, f"a status of {stage}")
        fault.strike(run, driver, pid)
        # what is held goes on, as it would end by itself
        run.gates.open()
        endings.append(_ended(run, driver))
        modelled.append(_modelled(run))
        run.mend()
    last = _ended(run, run.start())
    modelled.append(_modelled(run))
    return "; ".join(dict.fromkeys(endings)), last, "yes" if modelled_twice(modelled) else "no"


def modelled_twice(runs: Sequence[tuple[int, int]]) -> bool:
    """Whether a run kept fewer buildings than the run before it had done.

    Each run is (kept, done): buildings taken as they were kept, and those done when it ended, kept ones included.
    """
    return any(kept < done for (_, done), (kept, _) in itertools.pairwise(runs))


def _ended(run: BatchRun, driver: Program) -> str:
    """How a driver ended, and what the status command says."""
    code = driver.ended()
    assert code in ENDINGS, driver.tail()
    assert "Traceback" not in driver.text, driver.tail()
    return f"{ENDINGS[code]}, {run.status()['state']}"


def _modelled(run: BatchRun) -> tuple[int, int]:
    """How many buildings the last run took as they were kept, and how many were done when it ended."""
    stage = run.status()["stages"].get("reconstruct", {"kept": 0, "done": 0})
    return stage["kept"], stage["done"]


PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "batch_faults.md"


def rows_of_page() -> list[list[str]]:
    """The rows of the page's table, cell by cell."""
    lines = [line.strip("| ").split(" | ") for line in PAGE.read_text().splitlines() if line.startswith("|")]
    assert tuple(lines[0]) == HEADER
    return lines[2:]


def check(run: BatchRun, fault: Fault, undisturbed: Undisturbed) -> None:
    """A batch run outlives a fault, and the page says how."""
    row = strike(run, fault, undisturbed.digest)
    assert row.struck.endswith(fault.state), row
    assert (row.content, row.done_twice) == ("same", ONE_RUN if fault.code == 0 else "no"), row
    assert list(row.cells) in rows_of_page(), f"{PAGE} has no row | {' | '.join(row.cells)} |"


def cases(*, in_store: bool) -> list[Any]:
    """Faults of a place, for pytest."""
    return [pytest.param(fault, id=fault.name) for fault in FAULTS if fault.in_store == in_store]
