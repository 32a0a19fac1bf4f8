"""A batch run is killed in every stage, and goes on: everything is delivered once, as if nothing had been.

Every test adds its row to a table; the last one holds docs/reference/batch_faults.md against it.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from batch_faults import FAULTS, BatchRun, Fault, Row, markdown, strike
from object_store import FaultyProxy
from processes import Programs, program

from pipeline.synthetic.dataset import simulate

pytestmark = pytest.mark.slow

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "batch_faults.md"
CASES = [(fault, stage) for fault in FAULTS for stage in fault.stages]


@pytest.fixture(scope="module")
def tiles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town of a few dozen buildings."""
    return simulate("town", tmp_path_factory.mktemp("scene"), 5, size_m=(150.0, 150.0), density_per_m2=3.0).laz


@pytest.fixture(scope="module")
def table() -> list[Row]:
    """The rows so far."""
    return []


@pytest.fixture(scope="module")
def undisturbed(tiles: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[BatchRun]:
    """A run that nothing happens to."""
    folder = tmp_path_factory.mktemp("undisturbed")
    some = Programs(folder)
    try:
        run = BatchRun(some, folder / "run", tiles)
        driver = run.start()
        assert driver.ended() == 0, driver.tail()
        assert run.status()["state"] == "finished"
        assert len(run.buildings()) >= 24
        yield run
    finally:
        some.end()


@pytest.mark.parametrize(("fault", "stage"), CASES, ids=[f"{fault.name}: {stage}" for fault, stage in CASES])
def test_a_batch_run_outlives(
    fault: Fault,
    stage: str,
    tiles: Path,
    undisturbed: BatchRun,
    table: list[Row],
    tmp_path: Path,
    programs: Programs,
    s3: FaultyProxy,
    bucket: str,
) -> None:
    run = BatchRun(
        programs,
        tmp_path / "run",
        tiles,
        external=fault.external,
        faults={"impatient": 2.0} if fault.in_store else None,
        store=s3 if fault.in_store else None,
        bucket=bucket,
    )
    row = strike(run, fault, stage, undisturbed.digest)
    table.append(row)
    assert row.first.endswith(fault.state), row
    assert (row.content, row.done_twice) == ("same", "no"), row


def test_a_poisonous_building_costs_only_itself_also_after_a_kill(
    tiles: Path, undisturbed: BatchRun, tmp_path: Path, programs: Programs
) -> None:
    poison = sorted(undisturbed.buildings())[5]
    run = BatchRun(programs, tmp_path / "run", tiles, faults={"crash": [poison]})
    run.gates.close("publish")
    driver = run.start()
    run.held(driver, "publish")
    driver.kill()
    run.gates.open()
    again = run.start()
    assert again.ended() == 0, again.tail()
    found = run.buildings()
    assert found.pop(poison) == ("failed", "crashed")
    assert found == {name: told for name, told in undisturbed.buildings().items() if name != poison}
    assert (run.folder / "models" / "quarantine" / f"{poison}.bundle").is_file()


def test_a_file_that_cannot_grow_ends_the_run_with_its_name(tiles: Path, tmp_path: Path, programs: Programs) -> None:
    run = BatchRun(programs, tmp_path / "run", tiles)
    command = f"ulimit -f 64; exec {program('gablework')} batch run {run.file} --quiet"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ended.returncode == 4, ended.stderr
    assert ", in stage ingest. Free space or mend the storage, then run again" in ended.stderr
    assert run.status()["state"] == "failed"


def test_the_page_tells_what_was_seen(table: list[Row]) -> None:
    if len(table) < len(CASES):
        pytest.skip("only some of the rows were made")
    page = PAGE.read_text()
    begin = page.index("| fault |")
    assert page[begin:].strip() == markdown(table).strip(), markdown(table)
