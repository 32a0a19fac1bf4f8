"""Fixtures of the tests of two epochs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from epochs_by_hand import by_name, compared, write_epoch

from pipeline.model import BuildingResult
from pipeline.ruler.epochs.epoch_settings import DiffSettings

Compare = Callable[..., dict[str, dict[str, Any]]]


@pytest.fixture
def compare(tmp_path: Path) -> Compare:
    """Write two runs of buildings and compare them; gives the rows by name."""

    def run(
        old: Sequence[BuildingResult],
        new: Sequence[BuildingResult],
        settings: DiffSettings | None = None,
        *,
        of_old: dict[str, Any] | None = None,
        of_new: dict[str, Any] | None = None,
    ) -> dict[str, dict[str, Any]]:
        before = write_epoch(tmp_path / "old", old, **(of_old or {}))
        after = write_epoch(tmp_path / "new", new, **(of_new or {}))
        return by_name(compared(before, after, tmp_path / "out", settings))

    return run
