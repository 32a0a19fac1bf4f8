"""A batch run is killed in every stage, and goes on: everything is delivered once, as if nothing had been.

Every row is held against docs/reference/batch_faults.md; what strikes the store is in `test_batch_store_faults.py`.
"""

import subprocess
from pathlib import Path

import pytest
from batch_faults import FAULTS, BatchRun, Fault, Undisturbed, cases, check, modelled_twice, rows_of_page
from processes import Programs, program

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("fault", cases(in_store=False))
def test_a_batch_run_outlives(
    fault: Fault, town_tile: Path, undisturbed_batch: Undisturbed, tmp_path: Path, programs: Programs
) -> None:
    run = BatchRun(programs, tmp_path / "run", town_tile, external=fault.external)
    check(run, fault, undisturbed_batch)


@pytest.mark.parametrize(
    ("runs", "twice"),
    [
        ([(0, 0), (0, 0), (0, 7), (7, 24), (24, 24)], False),
        ([(0, 0), (0, 7), (0, 24), (24, 24)], True),
        ([(0, 7), (7, 24), (20, 24)], True),
    ],
    ids=["none", "after a strike in reconstruct", "in the last run"],
)
def test_a_building_that_any_run_models_again_is_noticed(runs: list[tuple[int, int]], twice: bool) -> None:
    assert modelled_twice(runs) is twice


def test_the_page_has_exactly_these_rows() -> None:
    assert [row[:2] for row in rows_of_page()] == [[fault.name, ", ".join(fault.stages)] for fault in FAULTS]


def test_a_poisonous_building_costs_only_itself_also_after_a_kill(
    town_tile: Path, undisturbed_batch: Undisturbed, tmp_path: Path, programs: Programs
) -> None:
    poison = sorted(undisturbed_batch.buildings)[5]
    run = BatchRun(programs, tmp_path / "run", town_tile, faults={"crash": [poison]})
    run.gates.close("publish")
    driver = run.start()
    run.held(driver, "publish")
    driver.kill()
    run.gates.open()
    again = run.start()
    assert again.ended() == 0, again.tail()
    found = run.buildings()
    assert found.pop(poison) == ("failed", "crashed")
    assert found == {name: outcome for name, outcome in undisturbed_batch.buildings.items() if name != poison}
    assert (run.folder / "models" / "quarantine" / f"{poison}.bundle").is_file()


def test_a_file_that_cannot_grow_ends_the_run_with_its_name(
    town_tile: Path, tmp_path: Path, programs: Programs
) -> None:
    run = BatchRun(programs, tmp_path / "run", town_tile)
    command = f"ulimit -f 64; exec {program('gablework')} batch run {run.file} --quiet"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ended.returncode == 4, ended.stderr
    assert ", in stage ingest. Free space or mend the storage, then run again" in ended.stderr
    assert run.status()["state"] == "failed"
