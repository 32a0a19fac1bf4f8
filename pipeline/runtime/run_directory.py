"""The directory of a run while the run goes on: checked, locked, cleared; its manifest at the start and at the end."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import functools
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline import __version__
from pipeline.errors import RunCancelledError, RunError
from pipeline.export.folders import POINTS_FOLDER, TERRAIN_FOLDER
from pipeline.export.stored_coordinates import one_unit
from pipeline.io import SourceInfo, SpatialReference, Storage, shown, storage_at
from pipeline.io.source import CAUSES
from pipeline.model import Status
from pipeline.runtime.manifest import NAME, PAGE, InputFile, PointFileFacts, RunManifest, RunStatus, write_manifest
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.request import RunRequest, input_file, request_record
from pipeline.runtime.run_plan import Plan
from pipeline.runtime.scratch.folder_lock import locked_results
from pipeline.runtime.stages.batch_figures import Counted
from pipeline.runtime.stages.cleanup import publishing
from pipeline.runtime.stages.ground_stage import Ground
from pipeline.runtime.stages.ingested import Ingested, without_roofs
from pipeline.runtime.stages.reconstruct import QUARANTINE
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import Splits
from pipeline.settings import RunSettings
from pipeline.tiling import MM

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints
    from pipeline.extras.guides.given_guides import GivenGuides
    from pipeline.extras.overrides.apply_overrides import EntryOutcome

FOOTPRINTS = "footprints.json"
"""File of the run directory with the faults of the given footprints, one by one."""
GUIDES = "guides.json"
"""The same of the given guides."""
OVERRIDES = "overrides.json"
"""File of the run directory with the outcome of each entry of the overrides."""

_RESULTS = ("buildings", "planes", "rejected", "decisions", "meshes", "cityjson", "state", QUARANTINE)


@dataclasses.dataclass(kw_only=True)
class RunDirectory:
    """A run directory that a run writes."""

    request: RunRequest
    settings: RunSettings
    """Those of the models in it."""
    run_dir: str
    """A path, or a URL."""
    manifest: RunManifest
    progress: Progress
    """Of the run; of its part that writes this directory, where it writes several."""
    check_same: Callable[[], None] = dataclasses.field(init=False)
    """Raises FolderLostError if the run directory was removed since it was locked."""

    @classmethod
    def of(
        cls,
        request: RunRequest,
        out: str,
        settings: RunSettings,
        plan: Plan,
        progress: Progress,
        started_at: dt.datetime,
    ) -> RunDirectory:
        """The directory of a run that is about to begin; it exists and may be written."""
        return cls(
            request=request,
            settings=settings,
            run_dir=_checked(out, overwrite=request.overwrite, work=request.work),
            manifest=RunManifest(
                status=RunStatus.RUNNING,
                engine_version=__version__,
                method=settings.general.method,
                settings=settings.as_dict(),
                settings_hash=settings.settings_hash,
                started_at=started_at,
                crs=_crs_facts(plan.reference),
                request=request_record(request),
                lattice={
                    "tile_size_m": plan.grid.size_mm / MM,
                    "origin_x_m": plan.grid.origin_x_mm / MM,
                    "origin_y_m": plan.grid.origin_y_mm / MM,
                },
                source_licence=request.licence,
            ),
            progress=progress,
        )

    @property
    def storage(self) -> Storage:
        """Its storage."""
        return storage_at(self.run_dir)

    def lock(self, locks: contextlib.ExitStack) -> None:
        """Lock it until the stack ends, and look again: who held it a moment ago may have left something."""
        self.check_same = locks.enter_context(locked_results(self.run_dir))
        check_out(self.run_dir, overwrite=self.request.overwrite, work=self.request.work)

    def begin(self, footprints: GivenFootprints | None, guides: GivenGuides | None) -> None:
        """Remove an earlier run, except what the work folder knows; readers see that the directory changes."""
        work = self.request.work
        known = work is not None and _is_of_work(self.run_dir, work)
        write_manifest(self.run_dir, self.manifest, self.storage.put)
        outdated = [FOOTPRINTS, GUIDES, OVERRIDES, PAGE]
        if not (known and self.request.points):
            outdated.append(POINTS_FOLDER)
        if not (known and self.settings.general.terrain != "none"):
            outdated.append(TERRAIN_FOLDER)
        self.storage.clear(outdated if known else [*outdated, *_RESULTS])
        for name, given in ((FOOTPRINTS, footprints), (GUIDES, guides)):
            if given is not None:
                put_json(self.run_dir, name, given.report)

    def put_overrides(self, entries: Sequence[EntryOutcome]) -> None:
        """Write what became of each entry of the overrides."""
        put_json(self.run_dir, OVERRIDES, [entry.as_dict() for entry in entries])

    def fail(self, error: BaseException) -> None:
        """Write how the run ended."""
        cancelled = isinstance(error, RunCancelledError | KeyboardInterrupt)
        message = f"{type(error).__name__}: {error}".removesuffix(": ")
        ended = dataclasses.replace(
            self.manifest,
            status=RunStatus.CANCELLED if cancelled else RunStatus.FAILED,
            warnings=(*self.progress.warnings, message),
        )
        write_manifest(self.run_dir, ended, self.storage.put)

    def finish(self, **found: Any) -> RunManifest:
        """Write the manifest of the finished run: fields of `RunManifest` beside those that the run's progress has."""
        # a work folder in which only an interrupted run resumes is gone now
        gone = {} if self.request.resources.work is not None else {"work": None}
        manifest = dataclasses.replace(
            self.manifest,
            request={**self.manifest.request, **gone},
            finished_at=dt.datetime.now(tz=dt.UTC),
            timings_s={name: round(seconds, 3) for name, seconds in self.progress.timings.items()},
            peak_memory_bytes=self.progress.peaks,
            warnings=tuple(self.progress.warnings),
            headline=self.progress.headline,
            **found,
        )
        write_manifest(self.run_dir, manifest, self.storage.put)
        return manifest


def input_files(
    request: RunRequest, paths: Sequence[str], ingested: Sequence[Ingested], plan: Plan
) -> tuple[InputFile, ...]:
    """The inputs for the manifest."""
    sources = {info.path: info for info in plan.sources}
    inputs = [
        InputFile(
            path=shown(path),
            sha256=found.sha256,
            size_bytes=sources[shown(path)].file_size,
            n_points=sum(found.points_by_tile.values()),
            bounds_m=_plan_bounds_m(found),
            file=_file_facts(sources[shown(path)]),
        )
        for path, found in zip(paths, ingested, strict=True)
    ]
    others = (request.footprints, request.guides, request.aoi, request.overrides)
    inputs.extend(input_file(name) for name in others if name is not None)
    return tuple(inputs)


@functools.lru_cache(maxsize=64)
def _as_mapping(dimensions: tuple[tuple[str, str], ...]) -> Mapping[str, str]:
    """Dimensions by name; one object for all files that have the same."""
    return dict(dimensions)


def _file_facts(info: SourceInfo) -> PointFileFacts:
    """An input as a whole, for the manifest."""
    x0, y0, _, x1, y1, _ = info.bounds_m
    return PointFileFacts(
        format=info.format,
        n_points=info.point_count,
        bounds_m=(x0, y0, x1, y1),
        acquired=(info.acquired_from, info.acquired_to) if info.acquired_from and info.acquired_to else None,
        dimensions=_as_mapping(info.facts.dimensions),
    )


def _plan_bounds_m(found: Ingested) -> tuple[float, float, float, float] | None:
    """Bounds of an input's kept points."""
    if found.bounds_mm is None:
        return None
    x0, y0, _, x1, y1, _ = found.bounds_mm
    return x0 / MM, y0 / MM, x1 / MM, y1 / MM


def put_json(run_dir: str | Path, name: str, content: object) -> None:
    """Write a document of a run directory, whole or not at all."""
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    storage_at(run_dir).put(name, text.encode())


def _is_of_work(run_dir: str, work: str) -> bool:
    """Whether a run directory was written from this work folder, which then knows what is there."""
    from pipeline.runtime.manifest_reading import read_manifest

    try:
        known = read_manifest(run_dir).request.get("work")
    except RunError:
        from pipeline.runtime.scratch.work_folder import is_known

        # missing or damaged
        return is_known(work, publishing(run_dir))
    return known == str(Path(work).resolve())


def _checked(out: str, *, overwrite: bool, work: str | None = None) -> str:
    """The run directory, a path or URL, made and checked."""
    check_out(out, overwrite=overwrite, work=work)
    storage = storage_at(out)
    try:
        storage.make()
    except OSError as error:
        raise RunError(f"{storage.place} cannot be written: {error.strerror or error}. Give another --out") from error
    return storage.place


def check_out(out: str, *, overwrite: bool, work: str | None = None) -> None:
    """Refuse a run directory that must not be written, by its content; makes nothing.

    Raises RunError if it is not empty and `overwrite` is not set, or it cannot be read.
    """
    storage = storage_at(out)
    run_dir = storage.place
    try:
        # a run that was interrupted before it wrote anything left only its work
        left = [name for name in storage.names() if work is None or Path(run_dir, name) != Path(work)]
        of_work = work is not None and _is_of_work(run_dir, work)
        if left and not overwrite and not of_work:
            raise RunError(f"{run_dir} is not empty ({left[0]} …): give another --out, or --overwrite")
        if left and NAME not in left and not of_work:
            raise RunError(f"{run_dir} holds {left[0]} and no run.json, so it is no run: give another --out")
    except OSError as error:
        raise RunError(f"{run_dir} cannot be read: {error.strerror or error}. Give another --out") from error


def _crs_facts(reference: SpatialReference) -> dict[str, object]:
    return {
        "epsg": reference.epsg,
        "name": reference.name,
        "wkt": reference.wkt,
        "horizontal_unit_m": reference.horizontal_unit_m,
        "vertical_unit_m": reference.vertical_unit_m,
        "vertical_unit_assumed": reference.vertical_unit_assumed,
        "cityjson_vertical_unit_m": one_unit(reference).vertical_unit_m,
    }


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
