"""The table of decisions: one row per check and form, beside the content of a run."""

import dataclasses
import math
from pathlib import Path

import pyarrow.parquet as pq
import small_buildings as small
from small_buildings import Contexts

from pipeline.export.decisions import DECISIONS, decision_rows, decisions_path, decisions_table
from pipeline.export.tile import write_tile
from pipeline.extras.overrides.tile_update import updated_tile
from pipeline.model import BuildingResult, Decision, DecisionKind, Outcome
from pipeline.runtime.digest import run_digest

CHECK = Decision(kind=DecisionKind.CHECK, name="point_spacing_m", outcome=Outcome.MET, value=0.123456, limit=0.1)
FORM = Decision(
    kind=DecisionKind.FORM, name="traced", outcome=Outcome.INVALID, detail="x" * 900, n_faces=3, validity_codes=(306,)
)


def decided(result: BuildingResult, *decisions: Decision) -> BuildingResult:
    """The building with these decisions."""
    return dataclasses.replace(result, decisions=decisions)


def test_a_row_has_the_figures_that_are_known_and_a_detail_that_can_be_read() -> None:
    check, form = decision_rows(decided(small.gable(), CHECK, FORM))
    assert list(check) == list(form) == DECISIONS.names
    assert (check["value"], check["limit"], check["n_faces"], check["bic_margin"]) == (0.1235, 0.1, None, None)
    assert (form["step"], form["value"], form["n_faces"], form["validity_codes"]) == (1, None, 3, [306])
    assert len(form["detail"]) == 300
    assert math.isnan(FORM.value)


def test_rows_are_sorted_by_building_and_step() -> None:
    rows = [
        row
        for name in ("b", "a")
        for row in decision_rows(dataclasses.replace(decided(small.gable(), CHECK, FORM), building_id=name))
    ]
    table = decisions_table(reversed(rows))
    assert table.column("building_id").to_pylist() == ["a", "a", "b", "b"]
    assert table.column("step").to_pylist() == [0, 1, 0, 1]
    assert table.schema == DECISIONS


def test_decisions_are_written_and_the_digest_does_not_depend_on_them(tmp_path: Path, contexts: Contexts) -> None:
    plain, recorded = tmp_path / "plain", tmp_path / "recorded"
    write_tile(plain, "t1", [small.gable(), small.pent()], [], contexts["compound"])
    write_tile(recorded, "t1", [decided(small.gable(), CHECK, FORM), small.pent()], [], contexts["compound"])
    assert pq.read_table(recorded / decisions_path("t1")).column("name").to_pylist() == ["point_spacing_m", "traced"]
    assert pq.read_table(plain / decisions_path("t1")).num_rows == 0
    assert run_digest(str(plain)) == run_digest(str(recorded))


def test_a_tile_with_a_building_replaced_has_the_decisions_of_both(tmp_path: Path, contexts: Contexts) -> None:
    before = [decided(small.gable(), CHECK), decided(small.pent(), CHECK, FORM)]
    after = [decided(small.gable(), FORM, CHECK), before[1]]
    context = contexts["compound"]
    write_tile(tmp_path / "before", "t1", before, [], context)
    write_tile(tmp_path / "after", "t1", after, [], context)
    update = updated_tile(tmp_path / "before", "t1", ["gable"], after[:1], [], context, "building")
    path = decisions_path("t1")
    assert update.files[path] == (tmp_path / "after" / path).read_bytes()
