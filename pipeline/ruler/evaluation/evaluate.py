"""One evaluation: models and a reference in, every measure out. The table of contents of the ruler."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import pyarrow as pa
import shapely

from pipeline.model import RoofType
from pipeline.ruler.evaluation import delivery, footprints, form_scores, roof_types, surface
from pipeline.ruler.evaluation import face_scores as faces
from pipeline.ruler.evaluation import score_tables as tables
from pipeline.ruler.evaluation import validity_scores as validity
from pipeline.ruler.evaluation.block_scores import joined_reference
from pipeline.ruler.evaluation.board_scores import board_measures, score_board
from pipeline.ruler.evaluation.building_matching import match_footprints
from pipeline.ruler.evaluation.detection_scores import detect, detection_measures
from pipeline.ruler.evaluation.divisions import WholeModels, undivided, whole_models
from pipeline.ruler.evaluation.ground_scores import FoundGround, ground_blocks, ground_measures
from pipeline.ruler.evaluation.measure import Measure
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.ruler.evaluation.reading.drawn_outlines import OutlineSet
from pipeline.ruler.evaluation.reading.wireframe_files import WireframeSet
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.residual_scores import building_residuals, residual_measures
from pipeline.ruler.evaluation.subsets import subsets
from pipeline.ruler.evaluation.wireframe_scores import WireframeScore, score_wireframes, wireframe_measures

_SAME_OUTLINES = (
    "The models follow given footprints, and so does the reference: where these are the same, outlines and detection "
    "agree by themselves and say nothing about the method."
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The result of an evaluation."""

    models: ModelSet
    reference: Reference | None
    """The reference, with blocks joined if needed; None: the models alone."""
    measures: tuple[Measure, ...]
    """Every figure, in the order of the chapters."""
    tables: Mapping[str, pa.Table]
    """The rows behind the figures by name; see `pipeline.ruler.evaluation.score_tables`."""
    notes: tuple[str, ...]
    """Assumptions and omissions of the measures."""
    wireframes: WireframeSet | None = None
    """The true wireframes; None without any."""
    outlines: OutlineSet | None = None
    """The drawn outlines; None without any."""
    statistics: Mapping[str, Any] | None = None
    """The figures of the run's records, from `run_statistics`; None for models of other programs."""

    def measure(self, name: str, subset: str = "all") -> Measure:
        """One figure; KeyError if it was not possible here."""
        for measure in self.measures:
            if measure.name == name and measure.subset == subset:
                return measure
        raise KeyError(f"no measure {name!r} of subset {subset!r}")


def needs_blocks(models: ModelSet, reference: Reference) -> bool:
    """Whether single houses of a row cannot be expected: models without footprints against simulated truth."""
    return reference.kind == "truth" and not models.has_footprints


def has_roof_types(models: ModelSet) -> bool:
    """Whether any model has a roof type, so types can be judged; True without models, for then none is found."""
    unknown = {RoofType.UNKNOWN, RoofType.NONE}
    return not models.models or any(model.roof_type not in unknown for model in models.models)


def evaluate(
    models: ModelSet,
    reference: Reference | None = None,
    *,
    blocks: bool | None = None,
    ground: FoundGround | None = None,
    wireframes: WireframeSet | None = None,
    outlines: OutlineSet | None = None,
    on_step: Callable[[str], None] = lambda _: None,
) -> Evaluation:
    """Measure models; without a reference only delivery, the form of outlines and validity.

    `blocks` joins true buildings that touch; by default as in `needs_blocks`. Without the found ground its measures
    are left out. Roof edges and corners are measured against the wireframes, and outlines beside the drawn ones, else
    beside those of simulated truth, with or without a reference. `on_step` is called with the name of each step as it
    begins. The points of the reference are read once for the residuals, and once each for detection against points and
    for the ground.
    """
    on_step("solids")
    solids = validity.validity(models)
    valid = validity.measures(solids)
    found: dict[str, pa.Table] = {"validity_codes": tables.validity_table(solids)}
    measures: list[Measure] = []
    notes: list[str] = []
    wholes = undivided(models.models)
    if outlines is not None:
        notes += [*outlines.notes, *([_SAME_OUTLINES] if models.has_footprints else [])]
    elif reference is not None and reference.outlines == "truth":
        outlines = OutlineSet(name=reference.name, outlines=tuple(one.footprint for one in reference.buildings))
    if reference is not None:
        if needs_blocks(models, reference) if blocks is None else blocks:
            wholes = whole_models(models.models, reference)
            reference = joined_reference(reference)
        notes += [*_notes(models, reference), *_division_notes(wholes)]
    if reference is not None and (reference.buildings or reference.extent is not None):
        measures += _buildings(models, wholes, reference, solids, found, on_step)
    else:
        measures += delivery.record_measures(models)
        found["models"] = tables.model_table(models, solids, None)
    on_step("form")
    form = form_scores.score_form(models.models, () if outlines is None else outlines.outlines)
    measures += form_scores.measures(form)
    found |= tables.form_tables(form, models.models)
    if reference is not None and ground is not None and reference.has_ground:
        on_step("ground")
        judged = ground_blocks(reference, ground)
        measures += ground_measures(judged, subsets(reference)[0])
        found["ground"] = tables.ground_table(judged)
    if wireframes is not None:
        on_step("wireframes")
        score = score_wireframes(models.models, wireframes.wireframes)
        of = {model.building_id: model for model in models.models}
        board = score_board(wireframes.wireframes, [[of[name] for name in names] for names in score.model_ids])
        measures += wireframe_measures(score) + board_measures(board)
        found["wireframes"] = tables.wireframe_table(score, board)
        notes += [*wireframes.notes, *_wireframe_notes(models, score)]
    return Evaluation(
        models=models,
        reference=reference,
        measures=(*measures, *valid),
        tables=found,
        notes=tuple(notes),
        wireframes=wireframes,
        outlines=outlines,
    )


def _buildings(
    models: ModelSet,
    wholes: WholeModels,
    reference: Reference,
    solids: tuple[validity.ModelValidity, ...],
    found: dict[str, pa.Table],
    on_step: Callable[[str], None],
) -> list[Measure]:
    """All measures of buildings; adds the tables to `found`."""
    groups = [group for group in subsets(reference) if group.elsewhere or group.size]
    on_step("footprints")
    matching = match_footprints(wholes.models, reference)
    delivered = delivery.of_delivered_models(
        delivery.score_delivery(wholes.models, reference, matching), wholes.whole_of
    )
    outlines = footprints.score_footprints(wholes.models, reference, matching)
    on_step("roof faces")
    face_score = faces.score_faces(models.models, reference)
    types = (
        roof_types.score_roof_types(wholes.models, reference, matching, face_score) if has_roof_types(models) else {}
    )
    on_step("roof surfaces")
    surfaces = surface.score_surface(models.models, reference)
    on_step("points")
    residuals = building_residuals(models.models, reference) if reference.tiles else None
    on_step("detection")
    detected = detect(models.models, reference)
    on_step("intervals")
    found["buildings"] = tables.building_table(reference, wholes, outlines, types, residuals, surfaces)
    found["models"] = tables.model_table(models, solids, delivered)
    if residuals is not None:
        found["residual_histogram"] = tables.residual_histogram(residuals)
    if reference.has_faces:
        found["true_faces"] = tables.true_face_table(face_score, reference)
        found["model_faces"] = tables.model_face_table(face_score, models.models, reference)
        found["topology"] = tables.topology_table(face_score)
        found |= tables.outcome_table(types, groups) if types else {}
    measures = delivery.record_measures(models)
    for group in groups:
        measures += delivery.measures(delivered, group)
        measures += residual_measures(residuals, group)
        measures += surface.measures(surfaces, group)
        measures += faces.measures(face_score, group)
        measures += roof_types.measures(types, group)
        measures += footprints.measures(outlines, group)
        measures += detection_measures(detected, group)
    return measures


def _notes(models: ModelSet, reference: Reference) -> tuple[str, ...]:
    found = []
    codes = [crs for crs in (models.crs, reference.crs) if crs is not None and crs.startswith("EPSG:")]
    # A name and a code may mean the same. The first part of a compound code is the horizontal one.
    if len({code.split("+")[0] for code in codes}) > 1:
        found.append(
            f"The models are in {codes[0]}, the reference in {codes[1]}: coordinates were compared as they are."
        )
    if reference.has_faces and not has_roof_types(models):
        found.append("No model has a roof type: types, and the outcomes that need them, are not judged.")
    if models.has_footprints and reference.outlines == "given":
        found.append(_SAME_OUTLINES)
    known = [building.footprint for building in reference.buildings]
    if reference.extent is not None:
        known.append(reference.extent)
    if known and models.models:
        place = shapely.box(*shapely.total_bounds(known))
        away = int((~shapely.intersects(place, [model.footprint for model in models.models])).sum())
        if away == len(models.models):
            found.append(
                "None of the models stands where the reference is: another place, or another reference system."
            )
        elif away:
            found.append(
                f"{away:,} of the {len(models.models):,} models stand beyond the reference and are not judged."
            )
    return tuple(found)


def _division_notes(wholes: WholeModels) -> list[str]:
    if not wholes.divided:
        return []
    blocks = "1 block is" if wholes.divided == 1 else f"{wholes.divided:,} blocks are"
    return [f"{blocks} divided rightly into single houses: the models of such a block count as one."]


def _wireframe_notes(models: ModelSet, score: WireframeScore) -> list[str]:
    count = len(models.models)
    if count and score.elsewhere == count:
        return ["None of the models stands on a wireframe: another place, another reference system, or not in metres."]
    if score.elsewhere:
        return [f"{score.elsewhere:,} of the {count:,} models stand on no wireframe; their edges are not judged."]
    return []
