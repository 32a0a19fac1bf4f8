"""The counts of a run: of its models, and over all stages."""

from __future__ import annotations

import dataclasses
import heapq
from collections import Counter
from collections.abc import Sequence

from pipeline.io.source import CAUSES
from pipeline.runtime.manifest import SLOWEST, SlowBuilding
from pipeline.runtime.plan import Plan
from pipeline.runtime.stages.ground import Ground
from pipeline.runtime.stages.ingested import Ingested
from pipeline.runtime.stages.model_batch import REJECTED
from pipeline.runtime.stages.reconstruct import Models
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import Splits


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
    """Wall-clock seconds of each building by its id; empty unless requested."""

    @classmethod
    def of(cls, models: Models, *, each: bool) -> Counted:
        """Count the models; `each` stores the seconds of every one."""
        statuses, reasons, rejected, roof_types = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
        seconds: dict[str, float] = {}
        slowest: list[tuple[float, str]] = []
        faces = 0
        for model in models.each():
            if model.status == REJECTED:
                rejected[model.reason or ""] += 1
            else:
                statuses[model.status] += 1
                if model.reason is not None:
                    reasons[model.reason] += 1
                roof_types[model.roof_type] += 1
                faces += model.faces
            if each:
                seconds[model.building_id] = model.seconds
            slowest.append((round(model.seconds, 3), model.building_id))
            if len(slowest) >= 2 * SLOWEST:
                slowest = heapq.nlargest(SLOWEST, slowest)
        return cls(
            statuses=statuses,
            reasons=reasons,
            rejected=rejected,
            roof_types=roof_types,
            faces=faces,
            made=models.made,
            slowest=tuple(SlowBuilding(building_id=i, seconds=s) for s, i in heapq.nlargest(SLOWEST, slowest)),
            seconds=seconds,
        )


def run_counts(
    plan: Plan, ingested: Sequence[Ingested], ground: Ground, splits: Splits, joined: Joined, found: Counted
) -> dict[str, int]:
    """The counts in run.json."""
    by_status = found.statuses
    dropped: Counter[str] = Counter()
    for entry in ingested:
        dropped.update(entry.findings.dropped)
    return {
        "points_promised": plan.points,
        "points": sum(s.points for s in splits.figures),
        **{f"dropped_{cause}": dropped[cause] for cause in sorted(CAUSES)},
        "duplicates": sum(cells.duplicates for cells in ground.cells.values()),
        "outliers": sum(cells.outliers for cells in ground.cells.values()),
        "tiles": len(splits.figures),
        "candidates": by_status.total(),
        "ok": by_status["ok"],
        "fallback": by_status["fallback"],
        "failed": by_status["failed"],
        "rejected": len(joined.rejected) + found.rejected.total(),
        "reused": by_status.total() + found.rejected.total() - found.made,
        "small_surfaces": joined.small_fragments,
        "roof_faces": found.faces,
        "class_6_in_candidates": sum(s.audit[0] for s in splits.figures),
        "other_classes_in_candidates": sum(s.audit[1] for s in splits.figures),
        "class_6_elsewhere": sum(s.audit[2] for s in splits.figures),
    }
