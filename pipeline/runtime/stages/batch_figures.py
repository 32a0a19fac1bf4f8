"""The figures of modelled buildings: of each, of a batch, and of a run."""

from __future__ import annotations

import dataclasses
import heapq
from collections import Counter
from collections.abc import Iterable, Mapping

from pipeline.model import Reason, Status
from pipeline.runtime.manifest import SLOWEST, SlowBuilding
from pipeline.tiling import Tile

LOST = frozenset({Reason.CRASHED, Reason.TIMED_OUT, Reason.OUT_OF_MEMORY, Reason.INTERNAL_ERROR})
"""Reasons caused by processes or by gablework, not by the building's points: each deserves a log line."""
REJECTED = "rejected"
"""The status, in the figures of a run, of a candidate that becomes a rejected object."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Modelled:
    """The figures of one building; the model itself stays in scratch."""

    building_id: str
    owner: Tile
    status: str
    """As in the records, or `REJECTED`."""
    reason: str | None
    roof_type: str
    faces: int
    points: int
    seconds: float
    reused: bool = False
    """Whether the model was taken from an earlier batch, of the same input."""
    ended_s: float = 0.0
    """When it was done, in seconds since 1970 by the clock of its machine."""
    detail: str = ""
    """Of a building that failed: the measured figure and the limit, or what happened."""
    retried: str = ""
    """What happened to the process that modelled it first, if it was modelled again in another one."""
    content: str = ""
    """Digest of all that is published of it."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class BatchFigures:
    """The figures of a batch, which travel to the driver; only failed, retried and slow buildings are listed."""

    count: int
    """Number of candidates."""
    statuses: Mapping[str, int]
    """Candidates by status, `REJECTED` too."""
    reasons: Mapping[str, int]
    """Candidates that are not ok, by reason."""
    rejected: Mapping[str, int]
    """Candidates that became rejected objects, by reason; the other counts but `statuses` are without them."""
    roof_types: Mapping[str, int]
    """Candidates by roof type."""
    faces: int
    """Roof faces of all models."""
    reused: int
    """Models taken from earlier batches."""
    slowest: str
    """Milliseconds and ids of those that took longest, as words: as objects they would take most of the memory."""
    content: int
    """Sum of the digests of all that is published."""
    notable: tuple[Modelled, ...]
    """Buildings of which the run hears: failed, retried, or slow."""
    seconds: Mapping[str, float]
    """Wall-clock seconds of each building by its id; empty unless they are compared."""

    @property
    def failed(self) -> int:
        """How many failed."""
        return self.statuses.get(Status.FAILED.value, 0)

    @classmethod
    def of(cls, models: Iterable[Modelled], slow_s: float, *, each: bool) -> BatchFigures:
        """The figures of a batch; buildings of `slow_s` seconds are slow, and `each` keeps the seconds of every one."""
        models = list(models)
        shown = [model for model in models if model.status != REJECTED]
        return cls(
            count=len(models),
            statuses=Counter(model.status for model in models),
            reasons=Counter(model.reason for model in shown if model.reason is not None),
            rejected=Counter(model.reason or "" for model in models if model.status == REJECTED),
            roof_types=Counter(model.roof_type for model in shown),
            faces=sum(model.faces for model in shown),
            reused=sum(model.reused for model in models),
            slowest=" ".join(
                f"{milliseconds} {name}"
                for milliseconds, name in heapq.nlargest(
                    SLOWEST, ((round(1000.0 * model.seconds), model.building_id) for model in models)
                )
            ),
            content=sum(int(model.content, 16) for model in models if model.content),
            notable=tuple(
                model
                for model in models
                if model.status == Status.FAILED.value or model.retried or model.seconds >= slow_s
            ),
            seconds={model.building_id: model.seconds for model in models} if each else {},
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Counted:
    """The counts of a run's models."""

    statuses: Counter[str]
    """Candidates by status."""
    reasons: Counter[str]
    """Candidates that are not ok, by reason."""
    rejected: Counter[str]
    """Candidates that became rejected objects, by reason; the other counts of candidates are without them."""
    roof_types: Counter[str]
    """Candidates by roof type."""
    faces: int
    """Roof faces of all models."""
    made: int
    """Candidates modelled by this run; the others were taken from earlier ones."""
    slowest: tuple[SlowBuilding, ...]
    """The candidates that took longest."""
    seconds: dict[str, float]
    """Wall-clock seconds of each building by its id; empty unless they are compared."""

    @classmethod
    def of(cls, batches: Iterable[BatchFigures], made: int) -> Counted:
        """The counts of some batches, of whose candidates this run modelled `made`."""
        statuses, reasons, rejected, roof_types = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
        seconds: dict[str, float] = {}
        slowest: list[tuple[int, str]] = []
        faces = 0
        for batch in batches:
            statuses.update(batch.statuses)
            reasons.update(batch.reasons)
            rejected.update(batch.rejected)
            roof_types.update(batch.roof_types)
            faces += batch.faces
            seconds.update(batch.seconds)
            words = batch.slowest.split()
            slowest = heapq.nlargest(SLOWEST, (*slowest, *zip(map(int, words[::2]), words[1::2], strict=True)))
        del statuses[REJECTED]
        return cls(
            statuses=statuses,
            reasons=reasons,
            rejected=rejected,
            roof_types=roof_types,
            faces=faces,
            made=made,
            slowest=tuple(SlowBuilding(building_id=name, seconds=longest / 1000.0) for longest, name in slowest),
            seconds=seconds,
        )
