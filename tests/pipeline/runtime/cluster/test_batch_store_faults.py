"""An object store fails while a batch run reads from it or publishes to it: nothing is lost, nothing comes twice."""

from pathlib import Path

import pytest
from batch_faults import BatchRun, Fault, Undisturbed, cases, check
from object_store import FaultyProxy
from processes import Programs

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("fault", cases(in_store=True))
def test_a_batch_run_outlives(
    fault: Fault,
    town_tile: Path,
    undisturbed_batch: Undisturbed,
    tmp_path: Path,
    programs: Programs,
    s3: FaultyProxy,
    bucket: str,
) -> None:
    run = BatchRun(programs, tmp_path / "run", town_tile, faults={"impatient": 2.0}, store=s3, bucket=bucket)
    check(run, fault, undisturbed_batch)
