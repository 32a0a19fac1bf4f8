"""Schedules in the store, on SQLite."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
pytest.register_assert_rewrite("store_contract", "schedule_contract")

from migrated import with_tables  # noqa: E402
from schedule_contract import ScheduleContract  # noqa: E402


class TestSchedulesOnSqlite(ScheduleContract):
    """All of the contract, on a file."""

    @pytest.fixture
    def url(self, tmp_path: Path, request: pytest.FixtureRequest) -> str:
        url = f"sqlite:///{tmp_path / 'some % folder' / 'service.db'}"
        return with_tables(url) if "store" in request.fixturenames else url
