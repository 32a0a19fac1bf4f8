"""Validity of delivered solids of any program."""

import dataclasses

import model_files as files
import numpy as np
import pytest
from model_files import small

from pipeline.model import Solid
from pipeline.quality.validity import ValidityTolerances
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.validity_scores import DEFINITIONS, code_counts, measures, validity


@pytest.fixture(scope="module")
def village(tmp_path_factory: pytest.TempPathFactory) -> ModelSet:
    return read_models(files.write_run(tmp_path_factory.mktemp("village") / "run", files.village()))


def with_solids(models: ModelSet, name: str, *solids: Solid) -> ModelSet:
    """The models with other solids in one of them."""

    def changed(model: RoofModel) -> RoofModel:
        return dataclasses.replace(model, solids=solids) if model.building_id == name else model

    return dataclasses.replace(models, models=tuple(changed(model) for model in models.models))


def figures(models: ModelSet) -> dict[str, tuple[float, int]]:
    return {
        measure.name.removeprefix("validity."): (measure.value, measure.n) for measure in measures(validity(models))
    }


def test_sound_models_are_valid_and_closed(village: ModelSet) -> None:
    assert figures(village) == {
        "solids_valid": (1.0, 5),
        "models_valid": (1.0, 4),
        "models_closed": (1.0, 4),
        "models_no_solid": (0.0, 4),
        "faulty_solids": (0.0, 5),
    }
    assert code_counts(validity(village)) == {}


def test_a_missing_face_a_moved_vertex_and_surfaces_alone_are_distinguished(village: ModelSet) -> None:
    gable, pent = small.gable_solid(), small.pent().solids[0]
    open_shell = dataclasses.replace(gable, faces=gable.faces[:-1])
    damaged = with_solids(village, "gable", open_shell)
    assert code_counts(validity(damaged)) == {"302": 1}
    assert figures(damaged)["models_closed"] == (0.75, 4)
    assert figures(damaged)["solids_valid"] == (0.8, 5)

    bent = dataclasses.replace(pent, vertices=pent.vertices + np.eye(len(pent.vertices), 3)[:, ::-1] * [0, 0, 0.3])
    damaged = with_solids(damaged, "pent", bent)
    assert code_counts(validity(damaged)) == {"203": 1, "302": 1}
    assert figures(damaged)["models_closed"] == (0.75, 4)
    assert figures(damaged)["models_valid"] == (0.5, 4)
    assert figures(damaged)["faulty_solids"] == (2.0, 5)

    damaged = with_solids(damaged, "courtyard")
    assert code_counts(validity(damaged)) == {"203": 1, "302": 1, "no_solid": 1}
    assert figures(damaged) == {
        "solids_valid": (0.5, 4),
        "models_valid": (0.25, 4),
        "models_closed": (0.5, 4),
        "models_no_solid": (0.25, 4),
        "faulty_solids": (2.0, 4),
    }


def test_one_faulty_solid_makes_its_model_faulty(village: ModelSet) -> None:
    gable = small.gable_solid()
    inside_out = dataclasses.replace(
        gable,
        faces=tuple(dataclasses.replace(face, rings=tuple(ring[::-1] for ring in face.rings)) for face in gable.faces),
    )
    damaged = with_solids(village, "two_parts", gable, inside_out)
    (row,) = [row for row in validity(damaged) if row.building_id == "two_parts"]
    assert row.codes == ((), (405,))
    assert (row.n_valid, row.is_valid, row.is_closed) == (1, False, True)


def test_tolerances_are_those_given(village: ModelSet) -> None:
    pent = small.pent().solids[0]
    bent = dataclasses.replace(pent, vertices=pent.vertices + np.eye(len(pent.vertices), 3)[:, ::-1] * [0, 0, 0.06])
    damaged = with_solids(village, "pent", bent)
    assert code_counts(validity(damaged)) == {"203": 1}
    assert code_counts(validity(damaged, ValidityTolerances(planarity_m=0.05))) == {}


def test_no_models_have_no_shares(village: ModelSet) -> None:
    found = measures(validity(dataclasses.replace(village, models=())))
    assert [measure.n for measure in found] == [0] * len(DEFINITIONS)
    assert all(np.isnan(measure.value) for measure in found if measure.name != "validity.faulty_solids")


def test_intervals_hold_the_share_and_widen_with_fewer_models(village: ModelSet) -> None:
    mixed = with_solids(village, "courtyard")
    few = {measure.name: measure for measure in measures(validity(mixed))}["validity.models_valid"]
    copies = tuple(model for _ in range(50) for model in mixed.models)
    many = {m.name: m for m in measures(validity(dataclasses.replace(mixed, models=copies)))}["validity.models_valid"]
    assert few.value == many.value == 0.75
    assert few.low <= many.low < 0.75 < many.high <= few.high
    assert many.high - many.low < few.high - few.low
