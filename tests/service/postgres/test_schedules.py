"""Schedules in the store, on a real PostgreSQL."""

import pytest
from processes import PostgresServer
from schedule_contract import HOUR, NOON
from schedule_store_contract import ScheduleStoreContract, jobs_of, make

from service.store import JobStore

pytestmark = pytest.mark.slow


class TestSchedulesOnPostgres(ScheduleStoreContract):
    """All of the contract, on PostgreSQL."""

    @pytest.fixture
    def url(self, postgres_server: PostgresServer, request: pytest.FixtureRequest) -> str:
        return postgres_server.create_database(with_tables="store" in request.fixturenames)


def test_a_schedule_that_another_decides_is_passed_over_and_not_waited_for(postgres_url: str) -> None:
    with JobStore(postgres_url) as store:
        store.migrate()
        held, free = make(store), make(store)
        with store._database.write() as connection:
            connection.exec_driver_sql(f"SELECT 1 FROM schedules WHERE schedule_id = '{held.schedule_id}' FOR UPDATE")
            entries = store.schedules.tick(now=NOON + HOUR)
            assert [run.schedule_id for run in entries] == [free.schedule_id]
        entries = store.schedules.tick(now=NOON + HOUR)
        assert [run.schedule_id for run in entries] == [held.schedule_id]
        assert [len(jobs_of(store, one)) for one in (held, free)] == [1, 1]
