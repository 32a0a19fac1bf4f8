"""What a run does otherwise once it has many tiles: it joins by blocks, sorts rows by groups, makes larger tasks."""

from collections import Counter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.digest import merged, rows_of, run_digest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.runtime.scratch import outcomes
from pipeline.runtime.stages import content_digest, join, stored_sites
from pipeline.settings import RunSettings

TILED: dict[str, Any] = {"tile_size_m": 30.0, "classes": "ignore"}


@pytest.fixture(scope="module")
def quarter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suburb of several blocks of tiles."""
    return simulate("suburb", tmp_path_factory.mktemp("quarter"), 5, size_m=(150.0, 110.0), density_per_m2=2.0).laz


@pytest.fixture(scope="module")
def of_one_block(quarter: Path, tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    """A run of some dozen tiles: one block, one group of tiles, small batches."""
    request = RunRequest(
        inputs=(str(quarter),),
        out=str(tmp_path_factory.mktemp("runs") / "one"),
        settings=RunSettings.from_mapping(TILED),
        resources=Resources(workers=0),
    )
    return run(request)


@pytest.mark.parametrize("across", [1, 3])
def test_a_run_joined_by_blocks_has_the_same_content(
    across: int, of_one_block: RunSummary, quarter: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(join, "_AT_ONCE", 4)
    monkeypatch.setattr(join, "_TILES_ACROSS", across)
    found = reconstruct(quarter, settings=TILED)
    assert found.digest == of_one_block.digest
    assert found.counts == of_one_block.counts
    assert found.rejected == of_one_block.rejected


def test_the_digest_of_many_tiles_is_that_of_their_tables(
    of_one_block: RunSummary, quarter: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_digest(of_one_block.run_dir) == of_one_block.digest
    monkeypatch.setattr(content_digest, "_TILES_AT_ONCE", 3)
    assert reconstruct(quarter, settings=TILED).digest == of_one_block.digest


def test_larger_tasks_give_the_same_content(
    of_one_block: RunSummary, quarter: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks = Counter[str]()
    packed = outcomes._packed

    def counted(brief: object, result: object) -> bytes:
        tasks[type(result).__name__] += 1
        return packed(brief, result)

    monkeypatch.setattr(outcomes, "_packed", counted)
    monkeypatch.setattr(stored_sites, "_POINTS_PER_GROUP", 100)
    assert reconstruct(quarter, settings=TILED).digest == of_one_block.digest
    small = tasks.pop("Batch")
    monkeypatch.setattr(stored_sites, "_GROUPS", 0)
    assert reconstruct(quarter, settings=TILED).digest == of_one_block.digest
    assert tasks["Batch"] < small


# --- rows in order


@pytest.fixture(scope="module")
def planes(of_one_block: RunSummary) -> pa.Table:
    """The planes of the run, of several buildings with several planes each."""
    return read_table(of_one_block.run_dir, "planes")


def test_an_object_of_two_tiles_is_refused(planes: pa.Table) -> None:
    rows = rows_of(planes, "planes")
    with pytest.raises(RunError, match="planes has more than one row of building_id"):
        merged("planes", [rows, rows.between(b"", None)])
