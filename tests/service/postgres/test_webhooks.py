"""Webhooks in the store, on a real PostgreSQL."""

import pytest
from processes import PostgresServer
from store_contract import claim, happened, submit
from webhook_store_contract import SUBSCRIBER, WebhookStoreContract, log

from service.store import JobStore

pytestmark = pytest.mark.slow


class TestWebhooksOnPostgres(WebhookStoreContract):
    """All of the contract, on PostgreSQL."""

    @pytest.fixture
    def url(self, postgres_server: PostgresServer, request: pytest.FixtureRequest) -> str:
        return postgres_server.create_database(with_tables="store" in request.fixturenames)


def test_the_end_of_a_job_does_not_wait_for_a_delivery_that_another_holds(postgres_url: str) -> None:
    with JobStore(postgres_url) as store:
        store.migrate()
        submit(store, subscriber=SUBSCRIBER)
        held = claim(store)
        store.record(held, [happened("progress", stage="split", progress=1)])
        with store._database.write() as connection:
            connection.exec_driver_sql("SELECT 1 FROM webhook_deliveries FOR UPDATE")
            store.succeed(held, message="", summary={})
        assert log(store)[0].event.value == "job.successful"
