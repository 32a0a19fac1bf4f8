"""Models of curved roofs beside the true ones, drawn by hand."""

import math

import shapely

from benchmarks.curved_roofs import Judged, judged, line
from pipeline.model import RoofType
from pipeline.ruler.evaluation.models import RoofModel


def model(name: str, outline: shapely.Polygon) -> RoofModel:
    return RoofModel(building_id=name, footprint=outline, roof_type=RoofType.UNKNOWN, surfaces=())


TRUE = model("dome-0", shapely.box(0.0, 0.0, 10.0, 10.0))


def test_a_roof_has_the_name_and_the_residuals_of_the_model_that_covers_most_of_it() -> None:
    models = [model("a", shapely.box(0.0, 0.0, 8.0, 10.0)), model("b", shapely.box(8.0, 0.0, 10.0, 10.0))]
    records = {
        "a": {"roof_type": "dome", "status": "ok", "noise_m": 0.024},
        "b": {"roof_type": "flat", "status": "doubtful", "noise_m": None},
    }
    (found,) = judged(models, [TRUE], records)
    assert (found.form, found.roof_type, found.residual_m, found.is_named) == ("dome", "dome", 0.024, True)


def test_a_building_without_a_model_has_no_name_and_no_residuals() -> None:
    (found,) = judged([], [TRUE], {})
    assert not found.is_named
    assert math.isnan(found.residual_m)


def test_shares_are_of_all_roofs_and_residuals_of_those_with_a_model() -> None:
    rows = [
        Judged(form="cone", noise_m=0.02, roof_type="cone", status="ok", residual_m=0.022, faces=30),
        Judged(form="cone", noise_m=0.02),
    ]
    assert line("all", rows)[1:5] == ["2", "0.500", "1.10", "1.10"]
