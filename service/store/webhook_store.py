"""The webhooks of a store. Every method is one transaction, committed when it returns."""

from __future__ import annotations

import builtins
import random
from collections.abc import Callable, Sequence

from pipeline.backoff import Backoff
from service import deliveries as deliveries_of_requests
from service.errors import LeaseLostError
from service.receivers import Avoided, Due
from service.store import backlog
from service.store import webhook_deliveries as deliveries
from service.store import webhook_endpoints as webhooks
from service.store.backlog import Refilled
from service.store.database import LOCK_SECRETS, LOCK_SUBMISSIONS, Database
from service.store.delivering import creating
from service.store.webhook_deliveries import DeliveryFilter
from service.webhooks import Delivery, DeliveryState, Endpoint, EventType, Parcel, Result


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
        owner: str | None = None,
        most: int | None = None,
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
        owner : str or None
            The key that makes it; None if keys are not used.
        most : int or None
            Maximum number of endpoints of the key; None for any number.
        delivery : Delivery, optional
            What else is written for the request that makes it.

        Raises
        ------
        TooManyWebhooksError
            The key has so many already.
        """
        new = webhooks.NewEndpoint(url=url, events=events, description=description, base=base, owner=owner)
        with creating(self._database, delivery) as (connection, made):
            # no other process adds one between counting and adding
            self._database.lock(connection, LOCK_SUBMISSIONS)
            endpoint_id, secret = webhooks.insert(connection, new, most=most, now=self._database.now(connection))
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

    def replay_all(self, endpoint_id: str) -> Endpoint:
        """Send all that was not sent to an endpoint, as it has room; end its pause, and enable it.

        These are the events that wait, and the ends of jobs in its log that failed or were dropped.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.write() as connection:
            webhooks.replay(connection, endpoint_id, self._database.now(connection))
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

    # --- secrets of keys

    def own_secret(self, owner: str | None) -> str:
        """The secret that signs messages to a key's subscribers (None if keys are not used); made if there is none."""
        with self._database.read() as connection:
            found = webhooks.known_secret(connection, owner)
        if found is not None:
            return found
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return webhooks.own_secret(connection, owner, self._database.now(connection))

    def replace_own_secret(self, owner: str | None) -> str:
        """Give a key a new secret for its subscribers; the one before signs no longer."""
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return webhooks.replace_own_secret(connection, owner, self._database.now(connection))

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
        """Claim the delivery that is due for the longest time, of receivers to which nothing is being sent.

        Parameters
        ----------
        driver : str
            Name of the driver, unique per process.
        lease_s : float
            Seconds for which no other driver sends it.
        """
        found = self.claim_some(driver, lambda line: line[:1], lease_s=lease_s)
        return found[0] if found else None

    def claim_some(
        self,
        driver: str,
        choose: Callable[[Sequence[Due]], Sequence[Due]],
        *,
        lease_s: float,
        avoided: Avoided = Avoided(),  # noqa: B008 - it is frozen
    ) -> builtins.list[Parcel]:
        """Claim deliveries that are due; no other driver sends them until the lease ends.

        Parameters
        ----------
        driver : str
            Name of the driver, unique per process.
        choose : callable
            Picks from the line at most one delivery per receiver.
        lease_s : float
            Seconds for which they are held.
        avoided : Avoided
            What is not in the line.
        """
        # the long look takes no lock; what others claimed since then is left out
        with self._database.read() as connection:
            chosen = choose(deliveries.line(connection, avoided, self._database.now(connection)))
        if not chosen:
            return []
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            return deliveries.take(connection, chosen, driver, now=self._database.now(connection), lease_s=lease_s)

    def settle(self, parcel: Parcel, result: Result, policy: Backoff) -> DeliveryState:
        """Write how an attempt ended; the state of the delivery afterwards.

        Raises
        ------
        LeaseLostError
            Another driver sends it by now, or it was removed.
        """
        (state,) = self.settle_all([(parcel, result)], policy)
        if state is None:
            delivery = parcel.delivery
            raise LeaseLostError(f"delivery {delivery.delivery_id}: attempt {delivery.attempts} is no longer held")
        return state

    def settle_all(
        self, ended: Sequence[tuple[Parcel, Result]], policy: Backoff
    ) -> builtins.list[DeliveryState | None]:
        """Write how attempts ended, in one transaction; the states of the deliveries.

        None if another driver sends a delivery by now, or it was removed.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            # it only spreads retries
            return deliveries.settle(connection, ended, now=now, policy=policy, chance=random.random)

    def refill(self, *, max_waiting: int, with_late: bool = True) -> Refilled:
        """Put events in line for endpoints that have room again; pause those that do not keep up.

        Parameters
        ----------
        max_waiting : int
            Most messages that may wait for an endpoint that does not keep up.
        with_late : bool
            Look at those without room, too, which may have to be paused.
        """
        with self._database.read() as connection:
            found = backlog.behind(connection, self._database.now(connection), with_late=with_late)
        if not found:
            return Refilled()
        with self._database.write() as connection:
            self._database.lock(connection, LOCK_SECRETS)
            now = self._database.now(connection)
            return backlog.refill(connection, found, now, max_waiting=max_waiting)

    def forget(self, days: float, *, most: int | None = None) -> int:
        """Remove old deliveries and events that no one needs, a limited number at once; how many.

        Parameters
        ----------
        days : float
            Days after which a finished delivery goes, and the end of a job that a paused endpoint did not get.
        most : int, optional
            Most finished deliveries, and most of them that failed; the oldest go first.
        """
        with self._database.write() as connection:
            return backlog.forget(connection, self._database.now(connection), days, most)
