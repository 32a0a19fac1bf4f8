"""The store on a real PostgreSQL."""

import pytest
from copy_contract import CopyContract
from delivery_contract import DeliveryContract
from processes import PostgresServer
from store_contract import StoreContract, claim, running, submit

from service.errors import StoreBusyError, StoreError
from service.store import JobStore, RequestDeadline

pytestmark = pytest.mark.slow


class TestCopiesOnPostgres(CopyContract):
    """All of the contract of copies, on PostgreSQL."""

    @pytest.fixture
    def url(self, postgres_server: PostgresServer, request: pytest.FixtureRequest) -> str:
        return postgres_server.create_database(with_tables="store" in request.fixturenames)


class TestDeliveriesOnPostgres(DeliveryContract):
    """All of the contract of deliveries, on PostgreSQL."""

    @pytest.fixture
    def url(self, postgres_server: PostgresServer, request: pytest.FixtureRequest) -> str:
        return postgres_server.create_database(with_tables="store" in request.fixturenames)


class TestOnPostgres(StoreContract):
    """All of the contract, on PostgreSQL."""

    @pytest.fixture
    def url(self, postgres_server: PostgresServer, request: pytest.FixtureRequest) -> str:
        return postgres_server.create_database(with_tables="store" in request.fixturenames)


def test_a_server_that_is_away_is_reported_without_the_password_and_is_found_again(
    postgres_server: PostgresServer, postgres_url: str
) -> None:
    with JobStore(postgres_url) as store:
        store.migrate()
        held = running(store)
        postgres_server.stop()
        try:
            with pytest.raises(StoreError, match="does not answer") as raised:
                store.renew(held, lease_s=60.0)
            assert postgres_server.password not in str(raised.value)
        finally:
            postgres_server.start()
        # connections of the pool are stale now, and nothing of that shows
        store.check()
        assert store.renew(held, lease_s=60.0) is False
        store.succeed(held, message="done", summary={})


def test_a_wrong_password_is_reported(postgres_server: PostgresServer, postgres_url: str) -> None:
    url = postgres_url.replace(postgres_server.password, "wrong")
    with JobStore(url) as store, pytest.raises(StoreError, match="password authentication failed"):
        store.migrate()


def test_the_plain_name_of_the_dialect_uses_the_driver_that_is_installed(postgres_url: str) -> None:
    with JobStore(postgres_url.replace("postgresql+pg8000://", "postgresql://")) as store:
        store.migrate()
        store.check()


def test_a_job_that_another_claims_is_passed_over_and_not_waited_for(postgres_url: str) -> None:
    with JobStore(postgres_url) as store:
        store.migrate()
        first, second = submit(store, priority=1), submit(store)
        with store._database.write() as connection:
            connection.exec_driver_sql(f"SELECT 1 FROM jobs WHERE job_id = '{first.job_id}' FOR UPDATE")
            assert claim(store).job_id == second.job_id
        assert claim(store).job_id == first.job_id


@pytest.mark.parametrize("mode", ["EXCLUSIVE", "ACCESS EXCLUSIVE"])
def test_a_locked_table_is_not_waited_for_and_nothing_is_written_later(postgres_url: str, mode: str) -> None:
    with JobStore(postgres_url) as other, JobStore(postgres_url, wait_s=1.0) as store:
        store.migrate()
        with other._database.write() as connection:
            connection.exec_driver_sql(f"LOCK TABLE jobs IN {mode} MODE")
            # the lock is held all the time: an error can only come from the time limit
            with pytest.raises(StoreBusyError):
                submit(store)
            if mode == "ACCESS EXCLUSIVE":
                with pytest.raises(StoreBusyError):
                    store.counts()
        assert sum(store.counts().values()) == 0
        submit(store)


def test_a_writer_that_others_hold_up_at_a_row_gives_way(postgres_url: str) -> None:
    with JobStore(postgres_url) as store, JobStore(postgres_url) as other:
        store.migrate()
        held = running(store)
        with other._database.write() as connection:
            connection.exec_driver_sql(f"SELECT 1 FROM jobs WHERE job_id = '{held.job_id}' FOR UPDATE")
            with RequestDeadline(1.0), pytest.raises(StoreBusyError):
                store.succeed(held, message="done", summary={})
        store.succeed(held, message="done", summary={})
