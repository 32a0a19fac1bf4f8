"""An early start of the fork server for the children of a small job. Cheap to import.

The server loads what the children need while the command itself reads its options, imports and plans.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pipeline.runtime.resources import Resources

Job = Literal["reconstruct", "classify"]

_METHOD = "arrangement"
"""The default method; a child loads other methods itself."""
_STAGES = (
    "numpy.ma",
    "pipeline.runtime.isolation.isolated_items",
    "pipeline.runtime.stages.ingest",
    "pipeline.runtime.stages.ground_stage",
    "pipeline.runtime.stages.split",
    "pipeline.strip_alignment",
)
_LOADS = {
    "reconstruct": ("pipeline.runtime.stages.publish", "pipeline.export.tile", "pipeline.runtime.digest"),
    "classify": ("pipeline.extras.classify.label", "pipeline.extras.classify.write_classified"),
}
_SCENE = "pipeline.runtime.stages.rehearsal:rehearse_scene"


_SMALL_BYTES = 500_000
"""About 120 thousand LAZ points, which one process classifies in half a second (`engine.ALONE_S`)."""


def is_surely_small(inputs: Sequence[str]) -> bool:
    """Whether inputs of `classify` are local files so small that no children will be needed."""
    paths = [Path(name) for name in inputs]
    return all(path.is_file() for path in paths) and sum(path.stat().st_size for path in paths) < _SMALL_BYTES


def loads_of(job: Job, *, footprints: bool, method: str | None = None) -> list[str]:
    """Loads of the children of a job, as in `isolation.child_main`; `footprints` and `method` as in `start_early`."""
    loads = [*_STAGES, *_LOADS[job], f"{_SCENE}:given" if footprints else _SCENE]
    if job == "reconstruct":
        loads.append(f"pipeline.runtime.stages.rehearsal:load_once:{method or _METHOD}")
    return loads


def has_idle_child() -> bool:
    """Whether a child of this process is idle; a process that never loaded the pool has none."""
    pool = sys.modules.get("pipeline.runtime.isolation.child_pool")
    return pool is not None and bool(pool.has_idle_child())


def start_early(job: Job, resources: Resources, *, footprints: bool = False, method: str | None = None) -> None:
    """Start the server of a job that may be small, unless it runs elsewhere or a server exists.

    It loads the job's stages; if footprints are given no surfaces are searched. The method is None for the default one.
    """
    if resources.workers is not None or resources.scheduler is not None:
        return
    # loaded before the fork because this process needs it, too: nearly every job reads LAS
    import pipeline.io.las  # noqa: F401
    from pipeline.runtime.isolation.child_pool import preload

    if job == "reconstruct" and footprints:
        import pyarrow as pa  # noqa: F401 - reading footprints loads both

    preload(loads_of(job, footprints=footprints, method=method))
