"""What the threads of a driver do again and again, also while the database does not answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pipeline.backoff import Backoff, Pauses
from service.driver.leased_job import LOG
from service.errors import StoreError

DATABASE = Backoff(first_s=0.5, longest_s=15.0)
"""Pauses between tries to reach the database."""


def repeat(
    action: Callable[[], float],
    wait: Callable[[float], object],
    is_over: Callable[[], bool],
    *,
    complaint: str,
    facts: Mapping[str, object],
) -> None:
    """Repeat an action, after a fault too: a thread that ended would leave a driver that looks alive.

    Parameters
    ----------
    action : callable
        Returns the seconds until it is called again.
    wait : callable
        Waits for so many seconds, or until the driver ends.
    is_over : callable
        Whether it is called no more.
    complaint : str
        Says what could not be done.
    facts : mapping
        Additional fields of a log line.
    """
    pauses = Pauses(DATABASE)
    while not is_over():
        try:
            wait_s = action()
        except StoreError as error:
            wait_s = pauses.next_s()
            LOG.warning("%s, next try in %g s: %s", complaint, wait_s, error, extra=facts)
        except Exception:  # noqa: BLE001 - it is logged, and tried again
            wait_s = pauses.next_s()
            LOG.exception("an unexpected fault: %s, next try in %g s", complaint, wait_s, extra=facts)
        else:
            pauses.begin_anew()
        wait(wait_s)
