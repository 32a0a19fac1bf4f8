"""The counts of a run, over all stages, and why there is nothing to count."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pipeline.io.source import CAUSES
from pipeline.model import Status
from pipeline.runtime.plan import Plan
from pipeline.runtime.stages.batch_figures import Counted
from pipeline.runtime.stages.ground import Ground
from pipeline.runtime.stages.ingested import Ingested, without_roofs
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import Splits

NOTHING_FOUND = "no building was found"
"""Begins the first warning of a run without candidates."""


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
        **{status.value: by_status[status.value] for status in Status},
        "rejected": sum(one.figures.count for one in joined.rejected) + found.rejected.total(),
        "reused": by_status.total() + found.rejected.total() - found.made,
        "small_surfaces": joined.small_fragments,
        "roof_faces": found.faces,
        "class_6_in_candidates": sum(s.audit[0] for s in splits.figures),
        "other_classes_in_candidates": sum(s.audit[1] for s in splits.figures),
        "class_6_elsewhere": sum(s.audit[2] for s in splits.figures),
    }


def about_emptiness(ingested: Sequence[Ingested], ground: Ground, joined: Joined, *, trust: bool) -> str:
    """Why no building can be modelled, or that none was found; empty where some were."""
    classes: Counter[int] = Counter()
    for found in ingested:
        classes.update(found.classes)
    by_classes = without_roofs(classes, trust=trust)
    if by_classes or joined.candidates:
        return by_classes
    rejected = sum(listed.figures.count for listed in joined.rejected)
    outliers = sum(cells.outliers for cells in ground.cells.values())
    lone = f", {outliers} of which are outliers: are they too few, or is a unit wrong" if outliers else ""
    left = f"; {rejected} objects were rejected, each with its reason" if rejected else ""
    return f"{NOTHING_FOUND} in {classes.total()} points{lone}{left}"
