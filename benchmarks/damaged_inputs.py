"""What becomes of damaged inputs: 500 damaged copies of each of eleven kinds, run by the command line or a service.

    python -m benchmarks.damaged_inputs [--per-kind 500] [--seed 1] [--kinds las laz ...] [--processes 2] [--keep DIR]
    python -m benchmarks.damaged_inputs --rest http://127.0.0.1:8000 [--key KEY] ...

Each copy is damaged by a seed of its own (`damage.py`), so the same call damages the same bytes; `--numbers 7 12` runs
single ones. Each run is a process of its own, forked from one that has loaded the modules, with limits of time and
memory. Prints one row per kind:

- named refusal: the command ends with the exit code of an input, a setting or (batch files) a run directory
- run: it ends well, no building failed for a fault of gablework, and our checker finds all solids valid
- internal: the exit code of a fault of gablework, failed tiles, or a building with such a fault
- invalid: a solid breaks a rule
- crash: the process was ended by a signal; hang: it took longer than `--time-limit`

The exit code is 1 if anything but refusals and runs was found; the first lines of each are printed, and their files
stay in `--keep`.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import faulthandler
import gc
import json
import multiprocessing
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.damage import damaged
from benchmarks.entries import markdown_table
from benchmarks.undamaged_inputs import KINDS, Kind, kind_named, write_inputs
from pipeline.console import ExitCode

OUTCOMES = ("named refusal", "run", "internal", "invalid", "crash", "hang")
GOOD = OUTCOMES[:2]
FAULTS = {"internal_error", "crashed", "timed_out", "out_of_memory"}
"""Reasons of a building that are faults of gablework, or of its limits."""
_NOT_JUDGED = 100
"""Exit code of a process whose command or results could not be judged."""
_OUTPUT_BYTES = 4_000
_TRACE_S = 2.0
"""Seconds for a run that hangs to write where it stands."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a run."""

    time_s: float = 60.0
    """Seconds, then it hangs."""
    memory_bytes: int = 3 * 2**30
    """Bytes of data that its process may ask for."""


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


def _be_a_run(case: Case, folder: Path, limits: Limits) -> None:
    """In the forked process: run the command with its output in a file, and judge what it wrote; does not return."""
    code = _NOT_JUDGED
    try:
        os.setsid()
        output = os.open(folder / "output.txt", os.O_CREAT | os.O_WRONLY | os.O_APPEND)
        faulthandler.register(signal.SIGUSR2, file=output)
        for stream in (1, 2):
            os.dup2(output, stream)
        resource.setrlimit(resource.RLIMIT_DATA, (limits.memory_bytes, limits.memory_bytes))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.chdir(folder)
        from pipeline.cli import app

        try:
            app(command(case, folder))
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else _NOT_JUDGED
        if code == ExitCode.DONE:
            code = _NOT_JUDGED
            (folder / "faults.txt").write_text("\n".join(faults_of(folder / "run")), encoding="utf-8")
            code = int(ExitCode.DONE)
    except BaseException:  # noqa: BLE001 - a fork must not go back to its parent's work
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def faults_of(run_dir: Path) -> list[str]:
    """What is wrong with the results of a run: solids that are not valid, buildings that failed by our fault."""
    from pipeline.export.geoparquet import read_table
    from pipeline.quality.validity import check_solid
    from pipeline.ruler.evaluation.reading.run import read_run

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


def run_case(case: Case, originals: Path, folder: Path, limits: Limits) -> Outcome:
    """Fork a process for a case and wait for its end."""
    name, began = case.write(originals, folder), time.monotonic()
    pid = os.fork()
    if not pid:
        _be_a_run(case, folder, limits)
    pidfd = os.pidfd_open(pid)
    in_time = bool(select.select([pidfd], [], [], limits.time_s)[0])
    if not in_time:
        signal.pidfd_send_signal(pidfd, signal.SIGUSR2)
        select.select([pidfd], [], [], _TRACE_S)
    os.close(pidfd)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # it is not reaped yet: the group is its own, with all that it started
    _, status = os.waitpid(pid, 0)
    result, detail = _judged(case, os.waitstatus_to_exitcode(status), folder)
    return Outcome(
        case=case,
        damage=name,
        result=result if in_time else "hang",
        detail=detail,
        seconds=time.monotonic() - began,
    )


def _judged(case: Case, code: int, folder: Path) -> tuple[str, str]:
    """One of `OUTCOMES`, and its reason."""
    output = folder / "output.txt"
    said = output.read_bytes()[-_OUTPUT_BYTES:].decode(errors="replace") if output.exists() else ""
    if code < 0:
        return "crash", f"{signal.Signals(-code).name}: {said}"
    if code == ExitCode.DONE:
        faults = (folder / "faults.txt").read_text(encoding="utf-8")
        return faults.partition(":")[0] or "run", faults or said
    refusals = {ExitCode.USAGE, ExitCode.INPUT, *([ExitCode.RUN_DIRECTORY] if case.kind.name == "batch" else [])}
    with contextlib.suppress(ValueError, KeyError):
        said = json.loads(said[said.index('{\n  "error"') :])["error"]["message"] if code in refusals else said
    return ("named refusal" if code in refusals else "internal"), f"exit code {code}: {said}"


def run_cases(cases: Sequence[Case], keep: Path | None, limits: Limits) -> Iterator[Outcome]:
    """The outcomes of cases, one after the other; files of bad ones are kept."""
    load()
    with tempfile.TemporaryDirectory(prefix="damaged-") as place:
        originals = Path(place, "originals")
        originals.mkdir()
        write_inputs(originals)
        for case in cases:
            folder = Path(place, "case")
            outcome = run_case(case, originals, folder, limits)
            if keep is not None and outcome.result not in GOOD:
                kept = keep / f"{case.kind.name}-{case.number}"
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(folder, kept)
            shutil.rmtree(folder)
            yield outcome


def load() -> None:
    """Load what runs need, so that forked ones begin at once."""
    import pyogrio  # noqa: F401
    import pyproj

    import pipeline.batch.run
    import pipeline.cli
    import pipeline.io.ascii
    import pipeline.io.las
    import pipeline.io.ply
    import pipeline.ruler.evaluation.reading.run  # noqa: F401
    from pipeline.runtime.isolation.fork_server import load_all
    from pipeline.runtime.isolation.preloading import loads_of

    load_all([*loads_of("reconstruct", footprints=False), "pipeline.runtime.stages.rehearsal:rehearse_scene:given"])
    pyproj.CRS.from_epsg(25832)
    gc.collect()
    gc.freeze()


def _run_share(job: tuple[Sequence[Case], Path | None, Limits]) -> list[Outcome]:
    """In a process of its own: the outcomes of a share of the cases."""
    return list(run_cases(*job))


def _shared_out(cases: Sequence[Case], arguments: argparse.Namespace, limits: Limits) -> Iterator[Outcome]:
    """The outcomes of cases that several processes share."""
    shares = [(cases[k :: arguments.processes], arguments.keep, limits) for k in range(arguments.processes)]
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        for share in pool.imap(_run_share, shares):
            yield from share


def table_of(outcomes: Sequence[Outcome]) -> str:
    """One row per kind, and their sum."""
    rows = []
    names = [kind.name for kind in KINDS if any(one.case.kind.name == kind.name for one in outcomes)]
    for name in [*names, "all"]:
        some = [one for one in outcomes if name in {one.case.kind.name, "all"}]
        counts = Counter(one.result for one in some)
        slowest = max((one.seconds for one in some), default=0.0)
        rows.append([name, str(len(some)), *(str(counts[result]) for result in OUTCOMES), f"{slowest:.1f}"])
    return markdown_table(["kind", "files", *OUTCOMES, "slowest, s"], rows)


def parsed(words: Sequence[str] | None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-kind", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", type=kind_named, default=list(KINDS))
    parser.add_argument("--numbers", nargs="+", type=int, help="Only these copies of each kind.")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--time-limit", type=float, default=Limits.time_s)
    parser.add_argument("--keep", type=Path, help="Folder for the files of all that went wrong.")
    parser.add_argument("--shown", type=int, default=20, help="Faults of each kind that are printed.")
    parser.add_argument("--verbose", action="store_true", help="Print a line per case.")
    parser.add_argument("--rest", metavar="URL", help="A running service that gets the files in place of the command.")
    parser.add_argument("--key", help="Its key, if it wants one.")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """Run and print."""
    arguments = parsed(words)
    numbers = arguments.numbers or range(arguments.per_kind)
    cases = [Case(kind=kind, number=number, seed=arguments.seed) for kind in arguments.kinds for number in numbers]
    limits = Limits(time_s=arguments.time_limit)
    found: Iterator[Outcome]
    faulthandler.enable()
    if arguments.rest is not None:
        from benchmarks.damaged_uploads import send_cases

        found = iter(send_cases(arguments.rest, arguments.key, cases, arguments.processes, limits.time_s))
    elif arguments.processes == 1:
        found = run_cases(cases, arguments.keep, limits)
    else:
        found = _shared_out(cases, arguments, limits)
    outcomes, shown = [], Counter[str]()
    for outcome in found:
        outcomes.append(outcome)
        name = outcome.case.kind.name
        if arguments.verbose or (outcome.result not in GOOD and shown[name] < arguments.shown):
            shown[name] += 1
            print(outcome, flush=True)
    print(table_of(outcomes))
    return 0 if all(one.result in GOOD for one in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
