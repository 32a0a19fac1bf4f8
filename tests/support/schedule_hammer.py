"""A replica that ticks through shared time as fast as it can, and ends jobs; a process of its own for tests.

`python schedule_hammer.py URL NAME START STEP_MINUTES TICKS LAP` reads its own, injected clock: every process walks
over the same times, so that all of them see the same slots due. It prints a line for every job that it made, and waits
for a line on its standard input before every lap of so many ticks.
"""

import datetime as dt
import sys

from pipeline.schedule import Outcome, state
from service.store import JobStore, ticks


def main(url: str, start: dt.datetime, step: dt.timedelta, number_of_ticks: int, lap: int) -> None:
    """Tick, and bring to its end what waits."""
    with JobStore(url) as store:
        for number in range(number_of_ticks):
            if number % lap == 0 and not sys.stdin.readline():
                sys.exit("the test has ended")
            entries = store.schedules.tick(now=start + number * step)
            for run in entries:
                if run.outcome is Outcome.SUBMITTED and run.job_id is not None:
                    print(run.job_id, flush=True)
            # every second tick, so that some slots come while a job is under way
            if number % 2:
                for run in entries:
                    if run.job_id is not None:
                        store.dismiss(run.job_id)


if __name__ == "__main__":
    # these replicas are hours apart, which replicas by one database's clock never are; in this process alone
    state.PUT_BACK = ticks.PUT_BACK = dt.timedelta(days=1)
    main(
        sys.argv[1],
        dt.datetime.fromisoformat(sys.argv[3]),
        dt.timedelta(minutes=int(sys.argv[4])),
        int(sys.argv[5]),
        int(sys.argv[6]),
    )
