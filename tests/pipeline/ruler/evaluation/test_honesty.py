"""The ruler held to account: the truth against itself is perfect, and known damage moves each measure as predicted.

Everything goes through the files and the readers that a user has; damage is done to the models after reading.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import roofs_by_hand as by_hand
import shapely

from pipeline.ruler.evaluation.definitions import DEFINITIONS
from pipeline.ruler.evaluation.evaluate import Evaluation, evaluate
from pipeline.ruler.evaluation.measure import Better, Measure
from pipeline.ruler.evaluation.models import ModelSet, RoofModel, RoofSurface
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.simulation.dataset import simulate

NOISE_M = 0.02


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suburb of a dozen houses, scanned densely with little noise: its truth."""
    folder = tmp_path_factory.mktemp("honesty")
    return simulate("suburb", folder, 90_001, size_m=(120.0, 110.0), density_per_m2=10.0, noise_m=NOISE_M).truth


@pytest.fixture(scope="module")
def reference(scene: Path) -> Reference:
    return read_truth_reference(scene)


@pytest.fixture(scope="module")
def truth(scene: Path) -> ModelSet:
    return read_models(scene)


@pytest.fixture(scope="module")
def undamaged(truth: ModelSet, reference: Reference) -> Evaluation:
    return evaluate(truth, reference)


def value(evaluation: Evaluation, name: str) -> float:
    return evaluation.measure(name).value


def whole(reference: Reference) -> list[RoofModel]:
    """The buildings that count: not cut by the end of the data."""
    return [building for building in reference.buildings if not building.touches_data_edge]


def replaced(truth: ModelSet, building_id: str, *models: RoofModel) -> ModelSet:
    """The truth with one building replaced, or dropped."""
    others = [one for one in truth.models if one.building_id != building_id]
    return dataclasses.replace(truth, models=(*others, *models))


def with_surface(truth: ModelSet, building_id: str, plane_id: int, surface: RoofSurface | None) -> ModelSet:
    """The truth with one roof face replaced, or left out."""
    building = next(one for one in truth.models if one.building_id == building_id)
    place = [one.plane_id for one in building.surfaces].index(plane_id)
    return replaced(truth, building_id, by_hand.with_face(building, place, surface))


def a_large_face(reference: Reference) -> tuple[RoofModel, RoofSurface]:
    """The largest face of the first gable that counts."""
    building = next(one for one in whole(reference) if one.roof_type.value == "gable")
    return building, max(building.surfaces, key=lambda surface: surface.area_m2)


def points_on(reference: Reference, building: RoofModel, surface: RoofSurface) -> int:
    """Roof points whose place lies in a face, whatever they hit."""
    number = [one.building_id for one in reference.buildings].index(building.building_id)
    count = 0
    for tile in reference.points():
        chosen = tile.is_roof & (tile.building == number)
        count += int(shapely.intersects_xy(surface.polygon, *tile.xyz[chosen, :2].T).sum())
    return count


def roof_plan_m2(reference: Reference) -> float:
    return sum(surface.polygon.area for building in whole(reference) for surface in building.surfaces)


def large_faces(reference: Reference) -> int:
    return sum(
        surface.area_m2 >= 10.0 and reference.face_points[building.building_id, surface.plane_id] >= 11
        for building in whole(reference)
        for surface in building.surfaces
    )


PERFECT_POINTS = {"residuals.rmse", "residuals.median", "residuals.p95", "residuals.bias", "residuals.building_rmse"}
"""Measured points are not the truth: their noise remains."""


def is_perfect(measure: Measure) -> bool:
    """Whether a figure is as good as it can be; counts of which more is not better have no best."""
    definition = DEFINITIONS[measure.name]
    if math.isnan(measure.value):
        return True
    if definition.better in {Better.LOWER, Better.ZERO}:
        return abs(measure.value) < 1e-6
    return definition.better is not Better.HIGHER or definition.unit == "count" or measure.value > 1.0 - 1e-6


def test_the_truth_against_itself_is_perfect_in_every_measure(undamaged: Evaluation) -> None:
    imperfect = {
        (measure.name, measure.subset): measure.value
        for measure in undamaged.measures
        if measure.name.removesuffix("_top_visible") not in PERFECT_POINTS
        # returns that melt a roof with what is below it lie off the roof: the survey's doing, not the model's
        and not (measure.name.startswith("residuals.within") and measure.value > 0.97)
        and not is_perfect(measure)
    }
    assert imperfect == {}
    measured = {measure.name for measure in undamaged.measures}
    assert {name for name in DEFINITIONS if not name.startswith(("ground.", "wireframes."))} == measured


def test_points_lie_about_the_truth_by_their_noise(undamaged: Evaluation) -> None:
    normal_median = (
        0.6745  # of |x| where x is standard normal; roofs slope, so the vertical distance is a little larger
    )
    assert normal_median * NOISE_M * 0.9 < value(undamaged, "residuals.median") < normal_median * NOISE_M * 1.6
    assert abs(value(undamaged, "residuals.bias_top_visible")) < 0.01


def test_a_face_left_out_is_a_hole(truth: ModelSet, reference: Reference, undamaged: Evaluation) -> None:
    building, face = a_large_face(reference)
    found = evaluate(with_surface(truth, building.building_id, face.plane_id, None), reference)
    total = undamaged.measure("residuals.coverage").n
    share = points_on(reference, building, face) / total
    assert value(found, "residuals.coverage") == pytest.approx(1.0 - share, abs=2 / total)
    assert value(found, "surface.coverage") == pytest.approx(
        1.0 - face.polygon.area / roof_plan_m2(reference), abs=1e-3
    )
    assert value(found, "faces.completeness_10m2") == pytest.approx(1.0 - 1.0 / large_faces(reference))
    assert value(found, "faces.correctness_10m2") == 1.0
    assert value(found, "roof_types.correct") == pytest.approx(1.0 - 1.0 / len(whole(reference)))
    assert value(found, "roof_types.passable") == pytest.approx(1.0 / len(whole(reference)))


@pytest.mark.parametrize("lift_m", [0.15, 0.29, 0.31])
def test_a_lifted_face_is_wrong_from_0_3_m_across_the_plane_on(
    truth: ModelSet, reference: Reference, undamaged: Evaluation, lift_m: float
) -> None:
    building, face = a_large_face(reference)
    dz = lift_m / float(face.normal[2])  # moved across the plane by lift_m
    found = evaluate(with_surface(truth, building.building_id, face.plane_id, by_hand.lifted(face, dz)), reference)
    share = face.polygon.area / roof_plan_m2(reference)
    right = lift_m < 0.3
    assert value(found, "faces.completeness_10m2") == pytest.approx(1.0 - (0 if right else 1 / large_faces(reference)))
    assert value(found, "faces.correctness_10m2") == pytest.approx(1.0 - (0 if right else 1 / large_faces(reference)))
    assert value(found, "surface.within_0_2m") == pytest.approx(1.0 - (share if dz > 0.2 else 0.0), abs=2e-3)
    assert value(found, "surface.rmse") == pytest.approx(dz * math.sqrt(share), rel=0.02)
    assert value(found, "surface.bias") == pytest.approx(dz * share, rel=0.02)
    points = points_on(reference, building, face) / undamaged.measure("residuals.coverage").n
    moved_by = value(found, "residuals.bias") - value(undamaged, "residuals.bias")
    assert moved_by == pytest.approx(-dz * points, rel=0.05, abs=1e-3)


@pytest.mark.parametrize(("turn_deg", "is_found"), [(5.0, True), (9.5, True), (10.5, False)])
def test_a_turned_face_is_found_up_to_10_degrees(
    truth: ModelSet, reference: Reference, turn_deg: float, is_found: bool
) -> None:
    """Turned about the horizontal line through its middle along its contour lines: the normal moves by turn_deg."""
    building, face = a_large_face(reference)
    a, b, _ = face.coefficients
    slope = math.hypot(a, b)
    steeper = math.tan(math.atan(slope) + math.radians(turn_deg))
    middle = face.polygon.centroid
    turned = by_hand.turned(face, turn_deg)
    found = evaluate(with_surface(truth, building.building_id, face.plane_id, turned), reference)
    lost = 0.0 if is_found else 1.0 / large_faces(reference)
    assert value(found, "faces.completeness_10m2") == pytest.approx(1.0 - lost)
    # differences grow linearly from the contour line through the middle: sample the face anew, independently
    grid = np.stack(np.meshgrid(*(np.arange(-20.0, 20.0, 0.1) + 0.05,) * 2), -1).reshape(-1, 2)
    places = grid + np.array([middle.x, middle.y])
    inside = shapely.contains_xy(face.polygon, places)
    across = grid[inside] @ np.array([a, b]) / slope
    expected = math.sqrt(
        float(np.mean((across * (steeper - slope)) ** 2)) * face.polygon.area / roof_plan_m2(reference)
    )
    assert value(found, "surface.rmse") == pytest.approx(expected, rel=0.03)


def test_a_dropped_building_is_missed_everywhere(truth: ModelSet, reference: Reference, undamaged: Evaluation) -> None:
    building = whole(reference)[0]
    found = evaluate(replaced(truth, building.building_id), reference)
    kept = 1.0 - 1.0 / len(whole(reference))
    for name in ("delivery.lod2", "detection.object_completeness", "footprints.iou_mean", "roof_types.correct"):
        assert value(found, name) == pytest.approx(kept), name
    assert value(found, "detection.object_correctness") == 1.0
    lost = sum(points_on(reference, building, surface) for surface in building.surfaces)
    total = undamaged.measure("residuals.coverage").n
    assert value(found, "residuals.coverage") == pytest.approx(1.0 - lost / total, abs=4 / total)
    area = sum(one.footprint.area for one in whole(reference))
    assert value(found, "surface.coverage") == pytest.approx(1.0 - building.footprint.area / area, abs=1e-3)
    assert value(found, "roof_types.false") == pytest.approx(1.0 - kept)


def test_an_invented_building_costs_correctness_and_no_completeness(truth: ModelSet, reference: Reference) -> None:
    """A flat box of 100 m2 in the middle of a street."""
    taken = shapely.union_all([building.footprint.buffer(2.0) for building in reference.buildings])
    low_x, low_y, high_x, high_y = reference.extent.bounds if reference.extent is not None else (0, 0, 0, 0)
    box = next(
        place
        for x in np.arange(low_x + 12, high_x - 22, 2.0)
        for y in np.arange(low_y + 12, high_y - 22, 2.0)
        if not (place := shapely.box(x, y, x + 10.0, y + 10.0)).intersects(taken)
    )
    roof = RoofSurface(polygon=box, coefficients=(0.0, 0.0, 60.0), plane_id=0)
    invented = by_hand.model("invented", whole(reference)[0].roof_type, [roof])
    found = evaluate(dataclasses.replace(truth, models=(*truth.models, invented)), reference)
    count, faces = len(whole(reference)), large_faces(reference)
    assert value(found, "delivery.false_models") == 1
    assert value(found, "detection.object_correctness") == pytest.approx(count / (count + 1))
    assert value(found, "faces.correctness_10m2") == pytest.approx(faces / (faces + 1))
    for name in ("delivery.lod2", "faces.completeness_10m2", "detection.object_completeness", "residuals.coverage"):
        assert value(found, name) == 1.0, name


def test_shrunk_footprints_lose_the_area_of_their_rim(truth: ModelSet, reference: Reference) -> None:
    def shrunk(model: RoofModel) -> RoofModel:
        inner = model.footprint.buffer(-0.5, join_style="mitre")
        surfaces = tuple(
            dataclasses.replace(surface, polygon=part)
            for surface in model.surfaces
            if isinstance(part := surface.polygon.intersection(inner), shapely.Polygon) and not part.is_empty
        )
        return dataclasses.replace(model, footprint=inner, surfaces=surfaces)

    models = dataclasses.replace(truth, models=tuple(shrunk(model) for model in truth.models))
    found = evaluate(models, reference)
    buildings = whole(reference)
    left = [
        building.footprint.buffer(-0.5, join_style="mitre").area / building.footprint.area for building in buildings
    ]
    assert value(found, "footprints.iou_mean") == pytest.approx(np.mean(left))
    assert value(found, "footprints.iou_median") == pytest.approx(np.median(left))
    assert value(found, "footprints.area_bias_median") == pytest.approx(np.median(left) - 1.0)
    assert value(found, "footprints.offset_median") == pytest.approx(-0.5, abs=0.02)
    area = sum(building.footprint.area for building in buildings)
    inner = sum(building.footprint.area * share for building, share in zip(buildings, left, strict=True))
    assert value(found, "surface.coverage") == pytest.approx(inner / area, abs=5e-3)
    assert value(found, "residuals.coverage") == pytest.approx(inner / area, abs=0.02)
    assert value(found, "surface.rmse") == pytest.approx(0.0, abs=1e-6)
    assert value(found, "detection.area_completeness") == pytest.approx(inner / area, abs=0.02)
    assert value(found, "detection.area_correctness") == 1.0
    # the ring holds the cells at the edge; of the next ones only those whose middle the rim reaches are lost
    lost, lost_inside = (1.0 - value(found, f"detection.area_completeness{ring}") for ring in ("", "_without_ring"))
    assert lost_inside < 0.25 * lost
    assert value(found, "faces.completeness_10m2") > 0.97


def test_a_wrong_roof_type_costs_the_type_alone(truth: ModelSet, reference: Reference) -> None:
    building = next(one for one in whole(reference) if one.roof_type.value == "gable")
    model = next(one for one in truth.models if one.building_id == building.building_id)
    renamed = dataclasses.replace(model, roof_type=type(model.roof_type)("hip"))
    found = evaluate(replaced(truth, model.building_id, renamed), reference)
    kept = 1.0 - 1.0 / len(whole(reference))
    assert value(found, "roof_types.accuracy") == pytest.approx(kept)
    assert value(found, "roof_types.correct") == pytest.approx(kept)
    assert value(found, "faces.completeness_10m2") == 1.0
    assert value(found, "surface.within_0_2m") > 1.0 - 1e-6


def test_a_broken_solid_costs_validity_alone(truth: ModelSet, reference: Reference) -> None:
    model = truth.models[0]
    open_solid = dataclasses.replace(model.solids[0], faces=model.solids[0].faces[1:])
    found = evaluate(replaced(truth, model.building_id, dataclasses.replace(model, solids=(open_solid,))), reference)
    assert value(found, "validity.solids_valid") == pytest.approx(1.0 - 1.0 / len(truth.models))
    assert value(found, "faces.completeness_10m2") == 1.0


NOT_PERFECT = ("residuals.", "form.inner_short_edges")
"""Points err by noise, mixed echoes and the shifts of strips. Chimneys and dormers have short sides."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suite", "options"),
    [("hofmann310", {}), ("sweep", {"density_per_m2": 4.0, "noise_m": 0.05}), ("city", {"size_m": (600.0, 600.0)})],
)
def test_the_truth_of_every_suite_is_perfect_against_itself(
    suite: str, options: dict[str, object], tmp_path: Path
) -> None:
    """Compound roofs, dormers, bent hips, rows of houses: where every shape is, and the survey errs."""
    made = simulate(suite, tmp_path, 90_002, **options)  # type: ignore[arg-type]
    folder = next(made.truth.glob("*/truth"), made.truth)
    imperfect = {
        (measure.name, measure.subset): measure.value
        for measure in evaluate(read_models(folder), read_truth_reference(folder)).measures
        if not measure.name.startswith(NOT_PERFECT) and not is_perfect(measure)
    }
    assert imperfect == {}
