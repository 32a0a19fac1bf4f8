"""Schedules in the store, on SQLite."""

from __future__ import annotations

from pathlib import Path

import pytest
from migrated import with_tables
from schedule_store_contract import ScheduleStoreContract


class TestSchedulesOnSqlite(ScheduleStoreContract):
    """All of the contract, on a file."""

    @pytest.fixture
    def url(self, tmp_path: Path, request: pytest.FixtureRequest) -> str:
        url = f"sqlite:///{tmp_path / 'some % folder' / 'service.db'}"
        return with_tables(url) if "store" in request.fixturenames else url
