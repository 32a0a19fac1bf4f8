"""The outputs of a job with the buildings of some statuses only, made by a process of its own when first asked for.

They are below the outputs of the job, with a catalogue of their own, and stay as long as these.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from pipeline.model import Status
from service.disk import FULL_BYTES, MAKE_ROOM, Disk, has_no_space
from service.errors import NoSpaceError, NoSuchOutputError, SelectionBusyError, UnexpectedError
from service.features.index import NAME as INDEX
from service.outputs.catalogue import NAME as CATALOGUE
from service.outputs.catalogue import read_catalogue
from service.outputs.kinds import OUTPUTS, SELECTABLE

WAIT_S = 20.0
"""Seconds that a request waits for a selection; then the client is asked to come again."""
_REFUSED = 3
"""Exit code for a run that cannot be selected from; the process says why in the log of the service."""
_FULL = 4
"""Exit code for a disk that is full."""
_COMMAND = (sys.executable, "-m", "service.outputs.selected")
"""The program that makes a selection; its last argument says which."""
LIMIT_S = 1800.0
"""Seconds after which a selection is ended: one that stands still must not keep others from being made."""
_MEMORY_BYTES = 4 << 30
"""Memory of its process. It is not a setting: a run is selected from and written tile by tile."""
_MOST_WAITING = 8
"""Requests that wait at a time, each in a thread of the server; others are asked to come again at once."""
_MOST = 2
"""Selections that one process of the service makes at a time. It is not a setting: each uses a core for seconds."""


def folder_of(out_dir: Path, statuses: Sequence[Status]) -> Path:
    """The folder of a selection, whatever the order of the statuses.

    >>> folder_of(Path("outputs"), [Status.DOUBTFUL, Status.OK]).as_posix()
    'outputs/selected/ok-doubtful'
    """
    return out_dir / "selected" / "-".join(status.value for status in Status if status in statuses)


class Selections:
    """The selections that this process of the service makes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._under_way: dict[Path, Future[None]] = {}
        self._waiting = threading.BoundedSemaphore(_MOST_WAITING)

    def make(
        self, run_dir: Path, out_dir: Path, statuses: Sequence[Status], disk: Disk, geoid_height_m: float | None
    ) -> Path:
        """The folder with the outputs of the buildings of some statuses; they are made if they are not there.

        Raises
        ------
        SelectionBusyError
            It takes longer, or others are being made.
        NoSuchOutputError
            The job has no output of the kind, or its run cannot be selected from.
        NoSpaceError
            The disk has no room for it.
        UnexpectedError
            The process failed.
        """
        place = folder_of(out_dir, statuses)
        if (place / CATALOGUE).is_file():
            return place
        catalogue = read_catalogue(out_dir)
        names = [name for name in catalogue.outputs if name in SELECTABLE]
        if not names:
            raise catalogue.missing("buildings")
        asked = {
            "run_dir": str(run_dir),
            "out_dir": str(place),
            "names": names,
            "statuses": [status.value for status in statuses],
            "geoid_height_m": geoid_height_m,
        }
        with self._lock:
            under_way = self._under_way.get(place)
            if under_way is None:
                if len(self._under_way) >= _MOST:
                    raise SelectionBusyError("other selections of buildings are being made: ask again")
                # a copy of the run, and as much as all outputs
                disk.require(2 * sum(one.size_bytes for one in catalogue.outputs.values()), "a selection of buildings")
                under_way = Future()
                threading.Thread(target=self._run, args=(place, asked, disk, under_way), daemon=True).start()
                self._under_way[place] = under_way  # before the thread ends: that needs the lock
        waits = self._waiting.acquire(blocking=False)
        try:
            under_way.result(WAIT_S if waits else 0.0)
        except TimeoutError:
            raise SelectionBusyError("the selection of buildings is being made: ask again") from None
        finally:
            if waits:
                self._waiting.release()
        return place

    def _run(self, place: Path, asked: Mapping[str, Any], disk: Disk, outcome: Future[None]) -> None:
        """Make a selection; the outcome is set in any case."""
        fault: Exception | None = None
        try:
            # the pipe of standard input ends the process with this one
            with subprocess.Popen(  # noqa: S603 - our own program
                [*_COMMAND, json.dumps(asked)],
                stdin=subprocess.PIPE,
            ) as process:
                try:
                    code = process.wait(LIMIT_S)
                except subprocess.TimeoutExpired:
                    process.kill()
                    code = process.wait()
            if code == _REFUSED:
                fault = NoSuchOutputError("files of this job's run are gone or damaged: submit the job again")
            elif code == _FULL or (code and disk.free_bytes < FULL_BYTES):
                fault = NoSpaceError(f"there is no room on the disk for a selection of buildings. {MAKE_ROOM}")
            elif code:
                fault = UnexpectedError(f"a selection of buildings, which ended with code {code}")
        except OSError as error:
            fault = error
        with self._lock:
            self._under_way.pop(place)
        if fault is None:
            outcome.set_result(None)
        else:
            outcome.set_exception(fault)


def refuse_others(output_id: str) -> None:
    """Refuse an output that a selection cannot have; raises NoSuchOutputError."""
    if output_id not in SELECTABLE:
        offered = ", ".join(SELECTABLE)
        raise NoSuchOutputError(f"{output_id[:80]} is not made for some statuses: leave out status, or use {offered}")


def write_selected(
    run_dir: Path, place: Path, names: Sequence[str], statuses: Sequence[Status], geoid_height_m: float | None
) -> None:
    """Write outputs of the buildings of some statuses into a folder, which appears whole.

    Raises
    ------
    RunError
        The run cannot be selected from, or an output cannot be made.
    OSError
        The folder cannot be written.
    """
    from pipeline.errors import NothingToShowError
    from pipeline.extras.publish.selection import select_run
    from service.outputs.assemble import write_outputs
    from service.outputs.published_forms import formats_of, publish

    place.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", dir=place.parent) as folder:
        run, made = Path(folder, "run"), Path(folder, "made")
        select_run(str(run_dir), run, statuses)
        faults = publish(run, made, formats_of(names), name=place.name, geoid_height_m=geoid_height_m)
        for fault in faults.values():
            # any other fault may be over next time: an output must not be missing for good
            if not isinstance(fault, NothingToShowError):
                raise fault
            sys.stderr.write(f"{fault}\n")
        shutil.rmtree(made / "3dtiles", ignore_errors=True)  # the zip file has its files
        (made / OUTPUTS["3dtiles"].filename).unlink(missing_ok=True)
        write_outputs(run, made, names)
        (made / INDEX).unlink()  # no page shows a selection
        try:
            made.rename(place)
        except OSError:
            # another process of the service was faster
            if not (place / CATALOGUE).is_file():
                raise


def _end_with_owner() -> None:
    """End this process when its standard input is closed."""

    def wait() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def main() -> int:
    """Make a selection: `python -m service.outputs.selected JSON`, with what `Selections.make` asks for."""
    from pipeline.errors import RunError

    _end_with_owner()
    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY_BYTES, _MEMORY_BYTES))
    asked = json.loads(sys.argv[1])
    statuses = [Status(word) for word in asked["statuses"]]
    try:
        write_selected(
            Path(asked["run_dir"]), Path(asked["out_dir"]), asked["names"], statuses, asked["geoid_height_m"]
        )
    except (RunError, OSError) as fault:
        if not isinstance(fault, RunError) and not has_no_space(fault):
            raise
        sys.stderr.write(f"{fault}\n")  # it may name folders of the server
        return _FULL if has_no_space(fault) else _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
