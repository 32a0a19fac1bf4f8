"""Faults, the stages in which they strike, and the outcome of the job, as rows of a table."""

import dataclasses
import signal
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from deployment import STAGES, Deployment, Ended, kill_process
from processes import wait_for

QUEUE = "queue"
ON_WORKERS = ("ingest", "split", "reconstruct", "publish")
EVERYWHERE = (QUEUE, *STAGES)


@dataclasses.dataclass(frozen=True)
class Moment:
    """When a fault strikes."""

    job_id: str
    """The running job."""
    pid: int
    """A process held in the stage; 0 in the queue."""


def kill_worker_process(service: Deployment, moment: Moment) -> None:
    """Kill only the process, as the kernel does when memory runs out; its nanny starts another."""
    kill_process(moment.pid)


def kill_worker(service: Deployment, moment: Moment) -> None:
    """Lose a machine: worker, nanny and child at once."""
    name = service.worker_of(moment.pid)
    service.gone.add(name)
    service.running[name].kill()


def kill_all_workers(service: Deployment, moment: Moment) -> None:
    """Lose all machines; others come when the job has reported that it waits."""
    service.gone.update(service.workers)
    for name in service.workers:
        service.running[name].kill()
    service.gates.open()
    wait_for(
        lambda: any(event.kind == "waiting" for event in service.events(moment.job_id)),
        "the event that the job waits for workers",
    )
    service.gone.clear()


def killed(name: str) -> Callable[[Deployment, Moment], None]:
    """Kill a program; its supervisor restarts it."""

    def strike(service: Deployment, moment: Moment) -> None:
        service.running[name].kill()

    return strike


def freeze_driver(service: Deployment, moment: Moment) -> None:
    """Freeze a driver until another one has its job, then let it continue."""
    silent = service.freeze("driver")
    attempt = service.job(moment.job_id).attempt
    service.start("driver")
    wait_for(lambda: service.job(moment.job_id).attempt == attempt + 1, "the claim of another driver")
    silent.process.send_signal(signal.SIGCONT)
    service.replaced.append(silent)


@dataclasses.dataclass(frozen=True)
class Fault:
    """A fault that strikes in several stages of a job."""

    name: str
    """Text in the table."""
    strike: Callable[[Deployment, Moment], None]
    """Causes it."""
    stages: Sequence[str]
    """Stages in which it strikes, in the order of a job."""
    begun_again: Sequence[str] = ()
    """Stages in which the job is begun again."""

    @property
    def begun(self) -> int:
        """Number of begun attempts by the end of the job."""
        return 1 + sum(stage in self.begun_again for stage in self.stages)


FAULTS = (
    Fault("worker's process killed, its nanny starts another", kill_worker_process, ON_WORKERS),
    Fault("one of two workers killed for good", kill_worker, ON_WORKERS),
    Fault("all workers killed, others come later", kill_all_workers, ("reconstruct",)),
    Fault("scheduler killed", killed("scheduler"), EVERYWHERE, begun_again=ON_WORKERS),
    Fault("driver killed", killed("driver"), EVERYWHERE, begun_again=STAGES),
    Fault("driver frozen until another has the job", freeze_driver, ("split",), begun_again=STAGES),
    Fault("driver frozen until another has the job", freeze_driver, ("outputs",), begun_again=STAGES),
    Fault("API killed", killed("api"), EVERYWHERE),
)


@dataclasses.dataclass(frozen=True)
class Row:
    """Outcome of a job."""

    fault: str
    stages: str
    """Stages in which it struck."""
    status: str
    begun: int
    """Number of attempts."""
    ended: int
    """Number of final events."""
    content: str
    """Comparison with the digest of an undisturbed run."""
    marked: str
    """Buildings that killed their process."""
    lost_s: float
    """Seconds longer than the undisturbed run."""

    @property
    def outcome(self) -> tuple[str, ...]:
        """All columns except the seconds, which differ from run to run."""
        return (self.fault, self.stages, self.status, str(self.begun), str(self.ended), self.content, self.marked)


def strike(service: Deployment, fault: Fault, tile: Path, settings: Mapping[str, Any]) -> Ended:
    """Submit a job, let the fault strike in its stages, one after the other, and wait for the job's end."""
    stages = [stage for stage in fault.stages if stage != QUEUE]
    title = f"{fault.name}: {', '.join(fault.stages)}"
    service.gates.close(stages[0])
    if QUEUE in fault.stages:
        idle = service.freeze("driver")
        job_id = service.submit(tile, settings, title)
        fault.strike(service, Moment(job_id, 0))
        if idle.alive:
            idle.process.send_signal(signal.SIGCONT)
    else:
        job_id = service.submit(tile, settings, title)
    begun = 1
    for stage, following in zip(stages, (*stages[1:], None), strict=True):
        pid = service.held(job_id, stage)
        assert service.job(job_id).attempt == begun, f"begun {service.job(job_id).attempt} times before {stage}"
        begun += stage in fault.begun_again
        if following is not None:
            service.gates.close(following)
        # restart what the last stage has lost
        service.restore()
        fault.strike(service, Moment(job_id, pid))
        service.gates.open(stage)
    return service.ended(job_id)


def without(buildings: Mapping[str, tuple[str, str]], names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """The buildings except some."""
    return {name: buildings[name] for name in buildings.keys() - set(names)}


def row(fault: str, stages: Sequence[str], ended: Ended, undisturbed: Ended) -> Row:
    """Outcome of a job, compared with an undisturbed one."""
    reasons = {name: reason for name, (_, reason) in ended.buildings.items() if reason in COSTLY}
    rest_is_same = without(ended.buildings, reasons) == without(undisturbed.buildings, reasons)
    content = "same" if ended.digest == undisturbed.digest else "same but for them" if rest_is_same else "differs"
    return Row(
        fault=fault,
        stages=", ".join(stages),
        status=ended.job.status.value,
        begun=ended.job.attempt,
        ended=ended.ends,
        content=content,
        marked=", ".join(f"{list(reasons.values()).count(reason)} {reason}" for reason in sorted({*reasons.values()})),
        lost_s=ended.seconds - undisturbed.seconds,
    )


COSTLY = ("crashed", "timed_out", "out_of_memory")

HEADER = ("fault", "strikes in", "job", "begun", "ended", "content", "buildings marked", "seconds lost")


def markdown(rows: Sequence[Row]) -> str:
    """The table."""
    cells = [(*(cell or "none" for cell in row.outcome), f"{max(row.lost_s, 0.0):.0f}") for row in rows]
    lines = [HEADER, ["---"] * len(HEADER), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def without_seconds(page: str) -> list[list[str]]:
    """The rows of the page's table without the last column, the seconds."""
    lines = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in page.splitlines() if "|" in line]
    start = lines.index(list(HEADER))
    return [line[:-1] for line in lines[start + 2 :] if len(line) == len(HEADER)]
