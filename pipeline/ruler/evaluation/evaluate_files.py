"""Evaluations of files: which reader for which argument."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from pipeline.errors import SettingsError
from pipeline.io import storage_at
from pipeline.io.source import ReadOptions
from pipeline.report.statistics import run_statistics
from pipeline.ruler.evaluation.evaluate import Evaluation, evaluate
from pipeline.ruler.evaluation.ground_scores import FoundGround, GroundOfFiles, GroundOfRun
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reading.drawn_outlines import read_outlines
from pipeline.ruler.evaluation.reading.wireframe_files import read_wireframes
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_points import read_points_reference
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.runtime.manifest import NAME as MANIFEST
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.settings import RunSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """The models to measure, and the reference."""

    models: str
    """A run directory, or models of other programs."""
    truth: str | None = None
    """The folder of simulated truth."""
    points: tuple[str, ...] = ()
    footprints: str | None = None
    """Outlines of buildings as people drew them: of the points, if there are any, and for the form of outlines."""
    footprints_layer: str | None = None
    """Their layer, where the file has several."""
    ground: tuple[str, ...] = ()
    """Point files whose class 2 is the ground to be judged; by default that of the ground stage of the run."""
    crs: str | None = None
    """CRS of the point files, if their header has none or a wrong one."""
    vertical_unit: str | None = None
    """Unit of their elevations."""
    wireframes: str | None = None
    """True roof edges: JSON, OBJ or a folder of OBJ files."""
    as_surveyed: bool = False
    """Move true buildings to where the survey saw them."""
    blocks: bool | None = None
    """Join true buildings that touch; None: as the models need."""

    def __post_init__(self) -> None:
        """Check that the fields belong together; raises SettingsError with all faults."""
        faults = []
        if self.truth is not None and self.points:
            faults.append("both a truth and points are given as the reference: use one of --truth and --points")
        if self.footprints_layer is not None and self.footprints is None:
            faults.append(f"the layer {self.footprints_layer} is given without footprints: give --footprints")
        if self.as_surveyed and self.truth is None:
            faults.append("as-surveyed is given without a truth: only simulated strips have known shifts")
        if self.ground and self.truth is None and not self.points:
            faults.append(f"ground is {', '.join(self.ground)} without a reference: give --points or --truth")
        if faults:
            raise SettingsError(faults)


def read_reference(request: EvaluationRequest) -> Reference | None:
    """The reference of a request; None without one. Its models are not read. InputError if it cannot be read."""
    if request.truth is not None:
        return read_truth_reference(request.truth, as_surveyed=request.as_surveyed)
    if request.points:
        options = ReadOptions(crs=request.crs, vertical_unit=request.vertical_unit)
        return read_points_reference(
            request.points, footprints=request.footprints, layer=request.footprints_layer, read_options=options
        )
    return None


def evaluate_files(
    request: EvaluationRequest,
    on_step: Callable[[str], None] = lambda _: None,
    reference: Reference | None = None,
) -> Evaluation:
    """Read and measure; `reference` is that of the same request, if it serves several models.

    Raises InputError if models, reference, wireframes or outlines cannot be read, and RunError if a run directory is
    damaged.
    """
    drawn = None if request.wireframes is None else read_wireframes(request.wireframes)
    on_step("models")
    models = read_models(request.models)
    if reference is None and (request.truth is not None or request.points):
        on_step("reference")
        reference = read_reference(request)
    options = ReadOptions(crs=request.crs, vertical_unit=request.vertical_unit)
    ground = None if reference is None else _ground(request.ground, models, reference, options)
    outlines = None
    if request.footprints is not None:
        outlines = read_outlines(request.footprints, request.footprints_layer, models)
    found = evaluate(
        models,
        reference,
        blocks=request.blocks,
        ground=ground,
        wireframes=drawn,
        outlines=outlines,
        on_step=on_step,
    )
    return dataclasses.replace(found, statistics=run_statistics(models.path)) if models.kind == "run" else found


def _ground(files: Sequence[str], models: ModelSet, reference: Reference, options: ReadOptions) -> FoundGround | None:
    """The found ground, by given files, else by the stage of the run; None for models of other programs."""
    if not reference.has_ground:
        return None
    if files:
        return GroundOfFiles(files, options)
    if models.kind != "run":
        return None
    if not storage_at(models.path).has(MANIFEST):  # simulated truth, or tables alone: no ground stage
        return None
    settings = read_manifest(models.path).settings
    sections = {name: table for name, table in settings.items() if name != "general"}
    return GroundOfRun(reference, RunSettings.from_mapping({**settings.get("general", {}), **sections}).scene)
