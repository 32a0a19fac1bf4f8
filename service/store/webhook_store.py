"""The webhooks of a store. Every method is one transaction, committed when it returns."""

from __future__ import annotations

import builtins
import datetime as dt
import random
from collections.abc import Mapping, Sequence
from typing import Any

from service import deliveries as deliveries_of_requests
from service.store import webhook_deliveries as deliveries
from service.store import webhook_endpoints as webhooks
from service.store.database import LOCK_SECRETS, Database
from service.store.delivering import creating
from service.store.webhook_deliveries import DeliveryFilter
from service.webhooks import Delivery, DeliveryState, Endpoint, EventType, Parcel, Result, RetryPolicy, SigningSecret


class WebhookStore:
    """Endpoints, secrets and deliveries; `JobStore.webhooks`.

    Deliveries are made by the changes of jobs (`outbox`), in the same transaction.

    Parameters
    ----------
    database : Database
        The store's own.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    # --- endpoints

    def create(
        self,
        url: str,
        *,
        events: Sequence[EventType],
        description: str | None = None,
        base: str,
        delivery: deliveries_of_requests.Delivery[tuple[Endpoint, str]] | None = None,
    ) -> tuple[Endpoint, str]:
        """Make an endpoint; it and its secret.

        Parameters
        ----------
        url : str
            Where messages go; already checked.
        events : sequence of EventType
            Only these are sent.
        description : str or None
            The operator's words.
        base : str
            The service's own URL, for links.
        delivery : Delivery, optional
            What else is written for the request that makes it.
        """
        with creating(self._database, delivery) as (connection, made):
            now = self._database.now(connection)
            endpoint_id = webhooks.insert(
                connection, url=url, events=[*events], description=description, base=base, now=now
            )
            secret = webhooks.endpoint_secret(connection, endpoint_id).secret
            return made((webhooks.get(connection, endpoint_id), secret))

    def get(self, endpoint_id: str) -> Endpoint:
        """One endpoint.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.read() as connection:
            return webhooks.get(connection, endpoint_id)

    def list(self, *, limit: int = 100, offset: int = 0) -> builtins.list[Endpoint]:
        """Endpoints, newest first."""
        with self._database.read() as connection:
            return webhooks.listed(connection, limit, offset)

    def change(self, endpoint_id: str, changes: Mapping[str, Any]) -> Endpoint:
        """Change what is given: `url`, `events`, `description`, `is_enabled`.

        Deliveries that wait go to the new URL. If it is disabled, they are dropped.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.write() as connection:
            webhooks.change(connection, endpoint_id, changes, self._database.now(connection))
            return webhooks.get(connection, endpoint_id)

    def remove(self, endpoint_id: str) -> None:
        """Delete an endpoint, and drop what waits; the log stays.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.write() as connection:
            webhooks.remove(connection, endpoint_id, self._database.now(connection))

    def rotate_secret(self, endpoint_id: str) -> SigningSecret:
        """Give an endpoint a new secret; the old one still signs for a day.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return webhooks.rotate_endpoint_secret(connection, endpoint_id, self._database.now(connection))

    # --- secrets of keys

    def own_secret(self, owner: str | None) -> SigningSecret:
        """The secret that signs messages to a key's subscribers (None if keys are not used); made if there is none."""
        with self._database.read() as connection:
            found = webhooks.known_secret(connection, owner)
        if found is not None:
            return found
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return webhooks.own_secret(connection, owner, self._database.now(connection))

    def rotate_own_secret(self, owner: str | None) -> SigningSecret:
        """Give a key a new secret for its subscribers; the old one still signs for a day."""
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return webhooks.rotate_own_secret(connection, owner, self._database.now(connection))

    # --- deliveries, for clients

    def deliveries(self, criteria: DeliveryFilter) -> builtins.list[Delivery]:
        """The deliveries that fit, newest first, without their attempts."""
        with self._database.read() as connection:
            return deliveries.listed(connection, criteria)

    def delivery(self, delivery_id: str, *, owner: str | None = None) -> Delivery:
        """One delivery with its attempts; with an owner only one to a subscriber of its jobs.

        Raises
        ------
        NoSuchDeliveryError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            return deliveries.get(connection, delivery_id, owner)

    def replay(self, delivery_id: str, *, owner: str | None = None) -> Delivery:
        """Send a delivery again, whatever became of it; its hours count anew.

        Raises
        ------
        NoSuchDeliveryError
            It does not exist, or belongs to another key.
        NotReplayableError
            It is being sent, or its endpoint is gone or disabled.
        """
        with self._database.write() as connection:
            deliveries.replay(connection, delivery_id, owner, self._database.now(connection))
            return deliveries.get(connection, delivery_id, owner)

    def counts(self) -> dict[DeliveryState, int]:
        """Deliveries by state; every state is there."""
        with self._database.read() as connection:
            return deliveries.counts(connection)

    # --- deliveries, for drivers

    def claim(self, driver: str, *, lease_s: float) -> Parcel | None:
        """Claim a delivery that is due; no other driver sends it until the lease ends.

        Parameters
        ----------
        driver : str
            Name of the driver, unique per process.
        lease_s : float
            Seconds for which it is held.
        """
        # most checks find nothing: they take no lock
        with self._database.read() as connection:
            if not deliveries.something_is_due(connection, self._database.now(connection)):
                return None
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return deliveries.take_first(connection, driver, now=self._database.now(connection), lease_s=lease_s)

    def settle(self, parcel: Parcel, result: Result, policy: RetryPolicy) -> DeliveryState:
        """Write how an attempt ended; the state of the delivery afterwards.

        Raises
        ------
        LeaseLostError
            Another driver sends it by now, or it was removed.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            chance = random.random()  # noqa: S311 - it only spreads retries
            return deliveries.settle(connection, parcel, result, now=now, policy=policy, chance=chance)

    def forget(self, days: float) -> int:
        """Remove deliveries that ended so many days ago, a limited number at once; how many."""
        with self._database.write() as connection:
            return deliveries.forget(connection, self._database.now(connection) - dt.timedelta(days=days))
