"""Tables of a run: every candidate is counted once, and nothing is claimed of what is unknown."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import small_buildings as small

from pipeline.errors import RunError
from pipeline.report.statistics import run_statistics
from pipeline.report.table import statistics_tables


def test_statuses_reasons_and_types_are_counted(street_run: Path) -> None:
    found = run_statistics(str(street_run))
    assert (found["candidates"], found["rejected"]) == (4, 1)
    assert found["statuses"] == {"ok": 2, "doubtful": 0, "fallback": 1, "failed": 1}
    assert found["shares"] == {"ok": 0.5, "doubtful": 0.0, "fallback": 0.25, "failed": 0.25}
    assert found["reasons"] == {"failed": {"too_few_points": 1}, "fallback": {"invalid_solid": 1}}
    assert found["rejected_reasons"] == {"vegetation": 1}
    assert found["roof_types"] == {"flat": 1, "gable": 2, "none": 1}
    assert found["lods"] == {"2.2": 2, "1.2": 1}
    assert found["validity_codes"] == {"104": 1, "203": 1}


def test_sums_and_quantiles_are_of_what_is_known(street_run: Path) -> None:
    found = run_statistics(str(street_run))
    assert found["sums"]["volume_m3"] == 360.0 + 2700.0 + 720.0
    assert found["sums"]["n_planes"] == 7
    assert found["quantiles"]["rmse_m"] == {"n": 3, "p10": 0.031, "p50": 0.031, "p90": 0.031, "max": 0.031}
    assert found["quantiles"]["coverage"]["n"] == 4
    assert found["quantiles"]["coverage"]["p10"] < 0.5


def test_the_figures_are_plain_json(street_run: Path) -> None:
    found = run_statistics(str(street_run))
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_a_run_that_found_nothing_has_empty_figures(make_run: Callable[..., Path]) -> None:
    found = run_statistics(str(make_run([])))
    assert found["candidates"] == 0
    assert set(found["shares"].values()) == {None}
    assert found["quantiles"]["rmse_m"] == {"n": 0, "p10": None, "p50": None, "p90": None, "max": None}
    assert found["sums"]["volume_m3"] == 0.0
    assert statistics_tables(found)


def test_the_tables_show_the_counts(street_run: Path) -> None:
    tables = statistics_tables(run_statistics(str(street_run)))
    assert all(len(row) == len(table.header) for table in tables for row in table.rows)
    lines = [" ".join(" ".join(row).split()) for table in tables for row in table.rows]
    for wanted in ("ok 2 50.0 %", "fallback 1 25.0 %", "invalid_solid 1 25.0 %", "gable 2", "vegetation 1", "all 4"):
        assert wanted in lines


def test_units_of_the_crs_do_not_change_the_figures(make_run: Callable[..., Path]) -> None:
    built = [small.gable(), small.courtyard()]
    assert run_statistics(str(make_run(built, "feet", 0.3048))) == run_statistics(str(make_run(built, "metres")))


def test_a_folder_without_a_run_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is not a folder"):
        run_statistics(str(tmp_path))
