"""Tasks on their way to other processes, which must have the same versions."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pipeline.errors import GableworkError, VersionMismatchError
from pipeline.runtime.monitoring.logs import wants_json
from pipeline.runtime.monitoring.measurement import Measured, Result, Task, measure, peak_of_process
from pipeline.runtime.monitoring.versions import fingerprint, versions_here


def measure_in_child(work: tuple[Callable[[Task], Result], Task, str]) -> Measured[Result]:
    """Run one task in a child process; an unexpected error carries its traceback as a note."""
    try:
        return measure(*work)
    except GableworkError:
        raise
    except Exception as error:
        # a traceback does not survive pickling, a note does
        error.add_note(traceback.format_exc())
        raise


def pack_tasks(function: Callable[[Task], Result], tasks: Sequence[Task]) -> bytes:
    """A function and some of its tasks as bytes for another process.

    A Dask scheduler unpickles what it passes on; with bytes it need not import what only workers need.
    """
    return pickle.dumps((function, tasks), protocol=pickle.HIGHEST_PROTOCOL)


def measure_packed(client_fingerprint: str, packed: bytes, stage: str = "") -> list[Measured[Any]]:
    """Run and measure a client's packed tasks one after the other, if this process has the client's versions.

    If it has others VersionMismatchError is raised, since a late worker must not mix other versions into a result. This
    happens before the tasks are unpickled, which could then fail in strange ways.
    """
    if wants_json():
        from pipeline.runtime.monitoring.log_lines import configure_as_json

        configure_as_json()
    if client_fingerprint != fingerprint():
        process, _ = peak_of_process()
        differing = differences(versions_of(client_fingerprint), versions_here())
        raise VersionMismatchError(mismatch_message([f"worker {process}: {', '.join(differing)}"]))
    function, tasks = pickle.loads(packed)  # noqa: S301 - from the client, whose code the worker runs anyway
    return [measure(function, task, stage) for task in tasks]


def mismatch_message(faults: list[str]) -> str:
    """The message of a version mismatch, from the differences of each process."""
    return (
        f"the processes do not run the same versions: {'; '.join(faults)}. "
        "Install the same gablework with the same locks everywhere (one image), then start again"
    )


def versions_of(line: str) -> dict[str, str]:
    """The versions in a fingerprint.

    >>> versions_of(fingerprint()) == dict(versions_here())
    True
    >>> versions_of("gablework=0.1.0;numpy=2.1")
    {'gablework': '0.1.0', 'numpy': '2.1'}
    """
    return dict(entry.split("=", 1) for entry in line.split(";"))


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Differences in words, for the packages of `ours`.

    >>> differences({"numpy": "2.1", "numba": "0.63"}, {"numpy": "2.0", "numba": "0.63"})
    ['numpy 2.0 where the client has 2.1']
    >>> differences({"numba": "0.63"}, {})
    ['no numba where the client has 0.63']
    """
    found = []
    for name, version in ours.items():
        other = theirs.get(name, "none")
        if other != version:
            has = f"no {name}" if other == "none" else f"{name} {other}"
            found.append(f"{has} where the client has {'none' if version == 'none' else version}")
    return found
