"""Keeps runs from using the reserve of the disk: the newest job is stopped when free space falls below it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from service.disk import Disk
from service.driver.leased_job import LOG, LeasedJob, Stop
from service.jobs import LogLevel

LOOK_S = 0.5
"""Seconds between two looks. Two workers that write 200 MB/s each use less than half of the reserve in this time."""


class DiskWatch:
    """Looks at the disk of the state folder.

    Parameters
    ----------
    disk : Disk
        The disk with its reserve.
    held : callable
        The jobs that the driver runs, oldest first.
    """

    def __init__(self, disk: Disk, held: Callable[[], Sequence[LeasedJob]]) -> None:
        self._disk = disk
        self._held = held
        self._was_short = False

    def look(self) -> bool:
        """Whether the reserve is free. If not, one job is stopped, and the others have time until its files are gone.

        Raises
        ------
        OSError
            The folder cannot be read.
        """
        free_bytes = self._disk.free_bytes
        is_short = free_bytes < self._disk.reserve_bytes
        if is_short != self._was_short:
            self._was_short = is_short
            words = "jobs wait" if is_short else "jobs run again"
            LOG.warning(
                "%d bytes of the disk are free, the reserve is %d: %s", free_bytes, self._disk.reserve_bytes, words
            )
        if is_short:
            held = self._held()
            if held and not any(one.stopped_for is not None for one in held):
                LOG.warning("the job is stopped: the disk is full except for its reserve", extra=held[-1].facts)
                held[-1].note("stopped: the disk is full except for its reserve", level=LogLevel.WARNING)
                held[-1].stop(Stop.NO_SPACE)
        return not is_short
