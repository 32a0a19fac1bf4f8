"""Faults, the stages in which they strike, and what became of the job, as rows of a table."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable, Mapping, Sequence
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
    """The job that is under way."""
    pid: int
    """A process that is held in the stage; 0 in the queue."""


def kill_worker_process(service: Deployment, moment: Moment) -> None:
    """What the kernel does when memory runs out: the process alone; its nanny starts another."""
    kill_process(moment.pid)


def kill_worker(service: Deployment, moment: Moment) -> None:
    """A machine is gone: worker, nanny and child at once."""
    name = service.worker_of(moment.pid)
    service.gone.add(name)
    service.running[name].kill()


def kill_all_workers(service: Deployment, moment: Moment) -> None:
    """All machines are gone; others come when the job has told that it waits."""
    service.gone.update(service.workers)
    for name in service.workers:
        service.running[name].kill()
    service.gates.open()
    wait_for(
        lambda: any(event.kind == "waiting" for event in service.events(moment.job_id)),
        "an event that tells that the job waits for workers",
    )
    service.gone.clear()


def killed(name: str) -> Callable[[Deployment, Moment], None]:
    """A program dies; its supervisor starts it again."""

    def strike(service: Deployment, moment: Moment) -> None:
        service.running[name].kill()

    return strike


def freeze_driver(service: Deployment, moment: Moment) -> None:
    """A driver falls silent, another takes its job, and then the first goes on as if nothing had been."""
    silent = service.freeze("driver")
    attempt = service.job(moment.job_id).attempt
    service.start("driver")
    wait_for(lambda: service.job(moment.job_id).attempt == attempt + 1, "the claim of another driver")
    silent.process.send_signal(signal.SIGCONT)
    service.replaced.append(silent)


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something that goes wrong while a job is in a stage, and again in the next."""

    name: str
    """As the table tells it."""
    strike: Callable[[Deployment, Moment], None]
    """Does it."""
    stages: Sequence[str]
    """Where it strikes, in the order of a job."""
    begun_again: Sequence[str] = ()
    """Where the job is begun once more."""

    @property
    def begun(self) -> int:
        """How often the job is begun by its end."""
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
    """What became of a job."""

    fault: str
    stages: str
    """Where it struck, one after the other."""
    status: str
    begun: int
    """How often it was begun."""
    ended: int
    """How often it was told to be over."""
    content: str
    """The digest against that of an undisturbed run."""
    marked: str
    """Buildings that cost their process."""
    lost_s: float
    """Seconds longer than the undisturbed run."""

    @property
    def outcome(self) -> tuple[str, ...]:
        """All but the seconds, which no two runs share."""
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
        # what the stage before has cost is there again
        service.restore()
        fault.strike(service, Moment(job_id, pid))
        service.gates.open(stage)
    return service.ended(job_id)


def row(fault: str, stages: Sequence[str], ended: Ended, undisturbed: Ended) -> Row:
    """What became of a job, against an undisturbed one."""
    reasons = {name: reason for name, (_, reason) in ended.buildings.items() if reason in COSTLY}
    rest_is_same = {name: told for name, told in ended.buildings.items() if name not in reasons} == {
        name: told for name, told in undisturbed.buildings.items() if name not in reasons
    }
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
    told = [(*(cell or "none" for cell in row.outcome), f"{max(row.lost_s, 0.0):.0f}") for row in rows]
    lines = [HEADER, ["---"] * len(HEADER), *told]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def without_seconds(page: str) -> list[list[str]]:
    """The rows of the page's table whose last column are seconds, without it."""
    lines = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in page.splitlines() if "|" in line]
    start = lines.index(list(HEADER))
    return [line[:-1] for line in lines[start + 2 :] if len(line) == len(HEADER)]
