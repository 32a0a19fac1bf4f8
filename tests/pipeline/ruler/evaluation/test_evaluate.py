"""One evaluation as a whole: the same models in another format, and models that are nowhere."""

import dataclasses

import roofs_by_hand as by_hand
from roofs_by_hand import flat, gable, hip, reference

from pipeline.model import RoofType
from pipeline.ruler.evaluation.evaluate import evaluate, has_roof_types, needs_blocks
from pipeline.ruler.evaluation.models import ModelSet, RoofModel

TRUTH = [gable("a"), hip("b", 20.0), flat("c", 40.0)]


def models(buildings: list[RoofModel], **more: object) -> ModelSet:
    found = ModelSet(name="m", kind="obj", path=".", models=tuple(buildings))
    return dataclasses.replace(found, **more)  # type: ignore[arg-type]


def test_blocks_do_not_depend_on_the_format() -> None:
    truth = reference(TRUTH)
    for kind in ("run", "cityjson", "cityjsonseq", "obj"):
        assert needs_blocks(models(TRUTH, kind=kind), truth)
        assert not needs_blocks(models(TRUTH, kind=kind, has_footprints=True), truth)
    assert not needs_blocks(models(TRUTH), dataclasses.replace(truth, kind="points"))


def test_roof_types_that_no_model_has_are_not_judged() -> None:
    truth = reference(TRUTH)
    untyped = models([dataclasses.replace(one, roof_type=RoofType.UNKNOWN) for one in TRUTH])
    assert has_roof_types(models(TRUTH))
    assert has_roof_types(models([]))
    assert not has_roof_types(untyped)
    found = evaluate(untyped, truth)
    assert not any(measure.name.startswith("roof_types.") for measure in found.measures)
    assert not {"outcomes", "outcomes_by_shape", "confusion"} & found.tables.keys()
    assert found.measure("faces.completeness_10m2").value == 1.0
    assert any("roof type" in note for note in found.notes)
    one = models([TRUTH[0], *untyped.models[1:]])
    assert evaluate(one, truth).measure("roof_types.accuracy").value == 1 / 3


def test_models_that_are_nowhere_near_give_a_note() -> None:
    truth = reference(TRUTH)
    assert evaluate(models(TRUTH), truth).notes == ()
    beyond = flat("far", 1e6)
    assert any("None of the models" in note for note in evaluate(models([beyond]), truth).notes)
    assert any("1 of the 4 models" in note for note in evaluate(models([*TRUTH, beyond]), truth).notes)


def test_what_the_models_say_of_the_edge_changes_no_figure() -> None:
    truth = reference(TRUTH)
    damaged = [TRUTH[0], dataclasses.replace(TRUTH[1], surfaces=TRUTH[1].surfaces[:1]), flat("tree", 200.0)]
    claimed = [dataclasses.replace(one, touches_data_edge=True) for one in damaged]
    plain, cheated = (
        {(one.name, one.subset): (one.value, one.n) for one in evaluate(models(made), truth).measures}
        for made in (damaged, claimed)
    )
    assert repr(plain) == repr(cheated)
    assert by_hand.EXTENT.covers(damaged[2].footprint)


def test_footprints_on_both_sides_give_a_note() -> None:
    outlines = [dataclasses.replace(one, surfaces=()) for one in TRUTH]
    given = dataclasses.replace(reference(outlines, extent=None), outlines="given", has_faces=False)
    facts = [evaluate(models(TRUTH, has_footprints=follow), given).notes for follow in (True, False)]
    assert ["say nothing about the method" in " ".join(notes) for notes in facts] == [True, False]
