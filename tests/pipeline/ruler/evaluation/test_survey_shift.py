"""True buildings moved to where the survey saw them."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from pipeline.errors import InputError, SettingsError
from pipeline.ruler.evaluation.evaluate import evaluate
from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.evaluation.survey_shift import mean_shifts
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.strips import ScannerSettings
from pipeline.ruler.simulation.suites import SUITES


@pytest.fixture(scope="module")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The truth of houses that one strip saw, half a metre off."""
    survey = ScannerSettings(
        pulse_density_per_m2=6.0,
        range_noise_m=0.02,
        altitude_m=900.0,
        strip_spacing_m=300.0,
        strip_shift_m=0.4,
        strip_lift_m=0.3,
    )
    folder = tmp_path_factory.mktemp("shifted")
    return simulate(dataclasses.replace(SUITES["suburb"], scanner=survey), folder, 3, size_m=(110.0, 100.0)).truth


def shift_of(truth: Path) -> np.ndarray:
    (shift,) = json.loads((truth / "scene.json").read_text())["strip_shifts_m"]
    return np.array(shift)


def test_every_building_of_one_strip_moves_by_its_shift(shifted: Path) -> None:
    there, seen = read_truth_reference(shifted), read_truth_reference(shifted, as_surveyed=True)
    east, north, up = shift_of(shifted)
    assert math.hypot(east, north, up) > 0.1
    for before, after in zip(there.buildings, seen.buildings, strict=True):
        # a building at the end of the data may have no point on its roof: then its shift is unknown
        if not before.touches_data_edge:
            moved = shapely.affinity.translate(before.footprint, east, north)
            assert shapely.symmetric_difference(moved, after.footprint).area < 1e-6
            for old, new in zip(before.surfaces, after.surfaces, strict=True):
                place = old.polygon.centroid
                x, y = np.array([place.x]), np.array([place.y])
                assert new.elevation(x + east, y + north) == pytest.approx(old.elevation(x, y) + up)
    assert f"{abs(up):.2f} m in elevation" in seen.notes[-1]


def test_the_points_lie_on_the_truth_where_they_saw_it_and_beside_it_elsewhere(shifted: Path) -> None:
    models = read_models(shifted)
    there = evaluate(models, read_truth_reference(shifted))
    seen = read_truth_reference(shifted, as_surveyed=True)
    moved = evaluate(models.__class__(**{**vars(models), "models": seen.buildings}), seen)
    up = shift_of(shifted)[2]
    assert there.measure("residuals.median").value == pytest.approx(abs(up), abs=0.6 * abs(up))
    assert there.measure("residuals.median").value > 2 * moved.measure("residuals.median").value
    assert moved.measure("residuals.median").value < 0.02
    assert moved.measure("faces.completeness_10m2").value == 1.0


def test_a_building_that_two_strips_saw_moves_by_the_mean_of_its_points() -> None:
    shifts = np.array([(0.2, 0.0, 0.1), (-0.4, 0.3, -0.2)])
    hits = [(np.array([0, 0, 0, 1]), np.array([0, 0, 1, 1])), (np.array([0]), np.array([1]))]
    moved = mean_shifts(3, hits, shifts)
    assert moved[0] == pytest.approx(shifts.mean(axis=0))
    assert moved[1] == pytest.approx(shifts[1])
    assert moved[2].tolist() == [0.0, 0.0, 0.0]


def test_a_scene_without_shifts_is_refused(shifted: Path, tmp_path: Path) -> None:
    scene = json.loads((shifted / "scene.json").read_text())
    del scene["strip_shifts_m"]
    for path in shifted.iterdir():
        if path.name != "scene.json":
            (tmp_path / path.name).symlink_to(path)
    scene["tiles"] = [
        {**tile, "laz": str(shifted / tile["laz"]), "labels": str(shifted / tile["labels"])} for tile in scene["tiles"]
    ]
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    with pytest.raises(InputError, match="strip_shifts_m is missing"):
        read_truth_reference(tmp_path, as_surveyed=True)


def test_options_that_do_not_go_together_are_reported_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        EvaluationRequest(models="run", footprints_layer="sheds", ground=("g.laz",), as_surveyed=True)
    text = str(caught.value)
    assert "the layer sheds is given without footprints" in text
    assert "as-surveyed is given without a truth" in text
    assert "ground is g.laz without a reference" in text
    with pytest.raises(SettingsError, match="use one of --truth and --points"):
        EvaluationRequest(models="run", truth="t", points=("p.laz",))
