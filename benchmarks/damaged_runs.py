"""A damaged copy of an input, run by the command line in a process of its own, and judged; see `damaged_inputs.py`."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import json
import os
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.damage import damaged
from benchmarks.undamaged_inputs import Kind, write_inputs
from pipeline.console import ExitCode
from pipeline.runtime.isolation.child_messages import Finished
from pipeline.runtime.isolation.child_pool import ChildPool
from pipeline.runtime.isolation.supervision import EndCause
from pipeline.runtime.monitoring.progress import never

OUTCOMES = ("named refusal", "run", "internal", "invalid", "crash", "hang")
GOOD = OUTCOMES[:2]
FAULTS = {"internal_error", "crashed", "timed_out", "out_of_memory"}
"""Reasons of a building that are faults of gablework, or of its limits."""
_NOT_JUDGED = 100
"""Exit code of a process whose command or results could not be judged."""
_OUTPUT_BYTES = 4_000
_LOADS = ("benchmarks.damaged_runs:load",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a run."""

    time_s: float = 60.0
    """Seconds, then it hangs."""
    memory_bytes: int = 2 * 2**30
    """Memory that its process may take; it may ask for 1 GiB more."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One damaged copy."""

    kind: Kind
    """The kind of input."""
    number: int
    """Number of the copy."""
    seed: int
    """Seed of all copies."""

    @property
    def file(self) -> str:
        """The file that is damaged."""
        return self.kind.files[self.number % len(self.kind.files)]

    def write(self, originals: Path, folder: Path) -> str:
        """Write all inputs into a new folder, one of them damaged; the name of the damage."""
        folder.mkdir(parents=True)
        for original in originals.iterdir():
            if original.name != self.file:
                os.link(original, folder / original.name)
        whole = (originals / self.file).read_bytes()
        name, made = damaged(self.file, whole, f"{self.seed} {self.kind.name} {self.number}")
        (folder / self.file).write_bytes(made)
        return name


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a case."""

    case: Case
    """The case."""
    damage: str
    """Name of the damage."""
    result: str
    """One of `OUTCOMES`."""
    detail: str
    """The message, or what the process wrote last."""
    seconds: float
    """Wall-clock time."""

    def __str__(self) -> str:
        """A line."""
        case, lines = self.case, self.detail.strip().splitlines()
        # a run that hangs wrote where it stands
        last = "\n".join(lines) if self.result == "hang" else " | ".join(lines[-3:])[-400:]
        return f"{case.kind.name} {case.number} ({case.file}, {self.damage}): {self.result}: {last}"


def command(case: Case, folder: Path) -> list[str]:
    """The words of the command."""
    return [word.format(file=case.file, out=folder / "run") for word in case.kind.arguments]


def run_here(order: tuple[Case, Path]) -> int:
    """In a process of its own: run the command with its output in a file, and judge what it wrote; its exit code."""
    case, folder = order
    output = os.open(folder / "output.txt", os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.chdir(folder)
    code: object = _NOT_JUDGED
    try:
        from pipeline.cli import COMMANDS, command_line

        try:
            command_line(COMMANDS)(command(case, folder))
        except SystemExit as end:
            code = end.code
        if code == ExitCode.DONE:
            code = _NOT_JUDGED
            (folder / "faults.txt").write_text("\n".join(faults_of(folder / "run")), encoding="utf-8")
            code = ExitCode.DONE
    except Exception:  # noqa: BLE001 - what the command does not turn into an exit code is what is looked for
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return int(code) if isinstance(code, int) else _NOT_JUDGED


def faults_of(run_dir: Path) -> list[str]:
    """What is wrong with the results of a run: solids that are not valid, buildings that failed by our fault."""
    from pipeline.export.geoparquet import read_table
    from pipeline.quality.validity import check_solid
    from pipeline.ruler.evaluation.reading.run_models import read_run

    if not run_dir.is_dir():  # a damaged batch file can name another folder
        return []
    rows = read_table(str(run_dir), "buildings").to_pylist()
    found = [
        f"internal: {row['building_id']} {row['reason']}: {row['reason_detail']}"
        for row in rows
        if row["reason"] in FAULTS
    ]
    for model in read_run(run_dir).models:
        codes = [code for solid in model.solids for code in check_solid(solid)]
        found += [f"invalid: {model.building_id} has {codes}"] if codes else []
    return found


def run_case(pool: ChildPool, case: Case, originals: Path, folder: Path, limits: Limits) -> Outcome:
    """Run a case in a fresh process, and wait for its end."""
    name, began = case.write(originals, folder), time.monotonic()
    with pool.borrowed(never, fresh=True, loads=_LOADS) as child:
        (end,) = child.work(
            run_here,
            [(0, (case, folder))],
            timeout_s=limits.time_s,
            memory_bytes=limits.memory_bytes,
            cancelled=never,
            one="run",
        )
        child.end()
    if isinstance(end, Finished):
        result, detail = _judged(case, end.result, folder)
    else:
        output = folder / "output.txt"
        result = "hang" if end.cause is EndCause.TIME else "crash"
        detail = f"{end.detail}\n{end.stderr}\n{_said(output)}"
    return Outcome(case=case, damage=name, result=result, detail=detail, seconds=time.monotonic() - began)


def _said(output: Path) -> str:
    """The end of what a run printed."""
    return output.read_bytes()[-_OUTPUT_BYTES:].decode(errors="replace") if output.exists() else ""


def _judged(case: Case, code: int, folder: Path) -> tuple[str, str]:
    """One of `OUTCOMES`, and its reason."""
    said = _said(folder / "output.txt")
    if code == ExitCode.DONE:
        faults = (folder / "faults.txt").read_text(encoding="utf-8")
        return faults.partition(":")[0] or "run", faults or said
    refusals = {ExitCode.USAGE, ExitCode.INPUT, *([ExitCode.RUN_DIRECTORY] if case.kind.name == "batch" else [])}
    with contextlib.suppress(ValueError, KeyError):
        said = json.loads(said[said.index('{\n  "error"') :])["error"]["message"] if code in refusals else said
    return ("named refusal" if code in refusals else "internal"), f"exit code {code}: {said}"


def run_cases(cases: Sequence[Case], keep: Path | None, limits: Limits, at_once: int) -> Iterator[Outcome]:
    """The outcomes of cases, so many at once; files of bad ones are kept."""
    pool = ChildPool()
    with tempfile.TemporaryDirectory(prefix="damaged-") as place:
        originals = Path(place, "originals")
        originals.mkdir()
        write_inputs(originals)

        def run(case: Case) -> Outcome:
            """In a thread: one case in a process."""
            folder = Path(place, f"{case.kind.name}-{case.number}")
            outcome = run_case(pool, case, originals, folder, limits)
            if keep is not None and outcome.result not in GOOD:
                shutil.copytree(folder, keep / folder.name, dirs_exist_ok=True)
            shutil.rmtree(folder)
            return outcome

        try:
            with ThreadPoolExecutor(at_once) as threads:
                yield from threads.map(run, cases)
        finally:
            pool.close()


@functools.cache
def load() -> None:
    """Load what runs need, once, so that forked ones begin at once."""
    import pyogrio  # noqa: F401
    import pyproj

    import pipeline.batch.batch_run
    import pipeline.cli
    import pipeline.extras.ply_ascii.ascii
    import pipeline.extras.ply_ascii.ply
    import pipeline.io.las
    import pipeline.ruler.evaluation.reading.run_models  # noqa: F401
    from pipeline.runtime.isolation.fork_server import load_all
    from pipeline.runtime.isolation.preloading import loads_of

    load_all([*loads_of("reconstruct", footprints=False), "pipeline.runtime.stages.rehearsal:rehearse_scene:given"])
    pyproj.CRS.from_epsg(25832)
    gc.collect()
