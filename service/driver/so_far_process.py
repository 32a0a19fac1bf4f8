"""The process that shows the buildings of a running job: it follows the run's scratch and writes what readers see.

It is a process of its own, so that neither the driver nor a worker does anything for readers. It ends when its standard
input is closed: then no client reads any longer, or the driver is gone.
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path

PAUSE_S = 1.0
"""Least pause between two looks at scratch."""
_SHARE = 10.0
"""The pause is at least so many times as long as it took to list all batches and to copy the index."""
_TURN_S = 1.0
"""Seconds of work after which the new buildings are shown, though there are more."""
_NICENESS = 5
"""Once it has started, the workers go first."""


def follow(run_dir: Path, folder: Path, wait: Callable[[float], bool]) -> None:
    """Show the buildings of a run until `wait` is true.

    Parameters
    ----------
    run_dir : Path
        The run directory; the run may not have begun yet.
    folder : Path
        What readers see.
    wait : callable
        Waits for so many seconds; true if no client reads any longer.
    """
    from pipeline.runtime.models_so_far import ModelsSoFar
    from service.outputs.buildings_so_far import BuildingsSoFar

    while (models := ModelsSoFar.of_run(run_dir)) is None:
        if wait(PAUSE_S):
            return
    with BuildingsSoFar(folder, models.context, models.crs) as shown:
        is_first, pause_s = True, 0.0
        while not wait(pause_s):
            began_s, is_new, is_left = time.monotonic(), False, False
            places = models.places()
            listing_s = time.monotonic() - began_s
            for place in places:
                if place.name in shown.batches:
                    continue
                if time.monotonic() - began_s > _TURN_S:
                    is_left = True
                    break
                buildings = models.buildings(place)
                if buildings is None:
                    break
                shown.add(place.name, place.unit, buildings)
                is_new = True
            showing_s = time.monotonic()
            if is_new or is_first:
                shown.show()
                is_first = False
            looking_s = listing_s + time.monotonic() - showing_s
            pause_s = max(0.0 if is_left else PAUSE_S, _SHARE * looking_s)


def _wait_for_end(seconds: float) -> bool:
    """Wait until standard input is closed, at most so many seconds; whether it is."""
    readable, _, _ = select.select([sys.stdin], [], [], seconds)
    return bool(readable)


def main() -> None:
    """Follow a run: `python -m service.driver.so_far_process RUN_DIR FOLDER`."""
    run_dir, folder = map(Path, sys.argv[1:])
    # a reader waits for this
    import service.outputs.buildings_so_far  # noqa: F401

    os.nice(_NICENESS)
    follow(run_dir, folder, _wait_for_end)


if __name__ == "__main__":
    main()
