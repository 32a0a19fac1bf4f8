"""The request of a run, and a first look at the inputs that it names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import shapely
from shapely import MultiPolygon, Polygon

from pipeline.io import ReadOptions, SourceInfo, SpatialReference, find_inputs, is_url, open_source, sha256_of, shown
from pipeline.io.places import on_this_machine
from pipeline.io.reading import one_input, set_input_timeout
from pipeline.options import ModelFiles, ModelOptions, options_of
from pipeline.registry import extra
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.manifest import InputFile
from pipeline.runtime.monitoring.progress import Progress, Watch, never
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_plan import MANY_FILES, Plan, check_places, looked_at, make_plan, without_far_files
from pipeline.runtime.scratch.location import SCRATCH
from pipeline.settings import RunSettings

if TYPE_CHECKING:
    from pipeline.extras.vector_files.tile_index import TileIndex


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunRequest(ModelFiles, ModelOptions):
    """What to reconstruct, and how."""

    inputs: tuple[str, ...]
    """Files, folders, patterns, URLs or tile indexes."""
    out: str
    """The run directory, a folder or `s3://bucket/prefix`; new or empty, unless `overwrite`."""
    settings: RunSettings = dataclasses.field(default_factory=RunSettings)
    """All settings."""
    resources: Resources = dataclasses.field(default_factory=Resources)
    """What the run runs with."""
    only_files: bool = False
    """Take each input for the path of a file and follow neither folders, patterns, URLs nor tile indexes: for inputs
    that strangers name."""
    overwrite: bool = False
    """Replace an earlier run in `out`."""

    @property
    def work(self) -> str | None:
        """The folder that stores the outcomes of tasks beyond the run; None if nothing is stored."""
        if self.resources.work is None and self.resources.resume:
            return str(Path(self.out).resolve() / SCRATCH)
        return self.resources.work


def plan_inputs(
    request: RunRequest,
    progress: Progress,
    cancelled: Callable[[], bool] = never,
    executor: Executor | None = None,
) -> tuple[Plan, list[str]]:
    """The plan of a run, and its input files in order; the run's executor looks at many files, if there is one already.

    Raises InputError if an input cannot be used; RunCancelledError or ClusterError while tasks look at many of them.
    """
    set_input_timeout(request.resources.input_timeout_s)
    options = ReadOptions(
        crs=request.crs,
        vertical_unit=request.vertical_unit,
        bbox=request.bbox,
        class_table=request.settings.class_codes.table,
    )

    def cut(index: TileIndex) -> Sequence[str]:
        """The files of an index that the window may need; the others are neither opened nor fetched."""
        if request.bbox is None and request.aoi is None:
            return index.locations
        reference = open_source(index.locations[0], options).info.reference
        area = None if request.aoi is None else _area(request.aoi, reference)
        if request.bbox is not None:
            box = shapely.box(*request.bbox)
            area = box if area is None else box & area
        return index.within(area, reference)

    paths = find_inputs(request.inputs, only_files=request.only_files, cut=cut)
    if request.aoi is not None:
        reference = open_source(paths[0], options).info.reference
        options = dataclasses.replace(options, aoi=_area(request.aoi, reference))

    def look(paths: Sequence[str], options: ReadOptions) -> tuple[SourceInfo, ...]:
        """The headers of all inputs, of many in tasks."""
        if len(paths) < MANY_FILES:
            return looked_at(paths, options)
        from pipeline.runtime.looking import look_at_all

        watch = Watch(cancelled=cancelled, listener=progress.listener)
        return look_at_all(paths, options, request.resources, watch, executor)

    plan = make_plan(paths, options, request.settings, look)
    if not request.allow_outside_area_of_use:
        check_places(plan)
    plan, paths = without_far_files(plan, paths)
    for warning in plan.warnings:
        progress.warn("plan", warning)
    if not any(info.has_returns for info in plan.sources):
        progress.warn("plan", "the inputs have one return per pulse: vegetation is recognized by its roughness alone")
    return plan, paths


def _area(path: str, reference: SpatialReference) -> Polygon | MultiPolygon:
    """The area of interest, read within the time limit of an input."""
    with one_input(shown(path)):
        return extra("read_area")(path, reference)


def input_file(name: str) -> InputFile:
    """The entry in `run.json` of a file that is no point cloud."""
    with on_this_machine(name) as path:
        return InputFile(path=_whole(name), sha256=sha256_of(path), size_bytes=path.stat().st_size)


def request_record(request: RunRequest) -> dict[str, object]:
    """The part of the request stored in `run.json`, from which single buildings of the run can be modelled again."""
    found: dict[str, object] = {"work": None if request.work is None else _whole(request.work)}
    for option in options_of(ModelFiles, ModelOptions):
        value = getattr(request, option.name)
        found[option.name] = _whole(value) if option.is_path and value is not None else value
    return found


def _whole(path: str) -> str:
    return shown(path) if is_url(path) else str(Path(path).resolve())
