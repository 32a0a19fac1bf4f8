"""Sends webhooks: claims deliveries that are due, makes and signs their bodies, posts them, writes what came back.

One thread claims and settles, many at once; each message is sent by a thread that mostly waits for its receiver.
`Receivers` decides who gets one, so that slow receivers hold up no others.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping

from pipeline import __version__
from pipeline.backoff import wanted_pause_s
from pipeline.runtime.monitoring import tracing
from service.driver.loops import repeat
from service.errors import NoSuchOutputError, StoreError, TargetRefusedError
from service.files import StateFolder
from service.outputs import read_catalogue
from service.receivers import Receivers
from service.settings import ServiceSettings
from service.status import results_document, status_info
from service.store import JobStore
from service.traces import of_job
from service.webhook_targets import SEND_S, SendError, post
from service.webhooks import DeliveryState, EventType, Parcel, Result, retry_policy, signed_headers
from service.wire.webhooks import Message

LOG = logging.getLogger("gablework.driver")

LEASE_S = SEND_S + 15.0
"""Seconds for which a delivery is held: an attempt, and the time to write its end."""
PACE_S = 0.25
"""Seconds between two rounds that claim and settle. Many messages share a transaction. Most are sent by then, so no
thread that sends holds it up; in between others, such as the requests of clients, find the database free."""
LOOK_S = 5.0
"""Longest pause between two rounds."""
FORGET_S = 15.0
"""Seconds between two rounds that remove what the log has too much."""
_ROUNDS = 20
"""Most transactions of such a round."""

Post = Callable[..., tuple[int, str | None]]
"""`service.webhook_targets.post`."""


class Sender:
    """Sends what is due until it is stopped.

    Parameters
    ----------
    store : JobStore
        The store with the deliveries.
    folder : StateFolder
        The results of jobs.
    settings : ServiceSettings
        Hosts, retries, pauses, limits.
    name : str
        Unique name of the driver.
    send : callable, optional
        Posts a message; tests replace it.
    """

    def __init__(
        self, store: JobStore, folder: StateFolder, settings: ServiceSettings, *, name: str, send: Post = post
    ) -> None:
        self._store = store
        self._settings = settings
        self._name = name
        self._policy = retry_policy(settings.webhook_hours, settings.webhook_pause_s)
        self._receivers = Receivers(settings.webhook_pause_s)
        self._folder = folder
        self._post = send
        self._crew: list[threading.Thread] = []
        self._parcels: queue.SimpleQueue[Parcel] = queue.SimpleQueue()
        self._ended: queue.SimpleQueue[tuple[Parcel, Result]] = queue.SimpleQueue()
        self._unwritten: list[tuple[Parcel, Result]] = []
        self._began_s = 0.0
        self._stopping = threading.Event()
        self._look_again = threading.Event()
        self.threads = [
            threading.Thread(target=self._work, name="webhooks", daemon=True),
            threading.Thread(target=self._keep_log, name="webhooks-log", daemon=True),
        ]
        """Not started yet."""

    def stop(self) -> None:
        """Claim nothing more; attempts that are under way end within their time."""
        self._stopping.set()
        self._look_again.set()

    # --- the thread that claims and settles

    def _work(self) -> None:
        def is_over() -> bool:
            return self._stopping.is_set() and self._receivers.under_way == 0

        repeat(self._round, self._wait, is_over, complaint="cannot look for webhooks", facts=self._facts)

    def _round(self) -> float:
        """Settle what has ended and claim what is due; seconds until the next round."""
        self._began_s = time.monotonic()
        self._look_again.clear()
        self._settle()
        return LOOK_S if self._stopping.is_set() else self._send_what_is_due()

    def _wait(self, seconds: float) -> None:
        self._look_again.wait(seconds)
        self._stopping.wait(max(0.0, self._began_s + PACE_S - time.monotonic()))

    def _settle(self) -> None:
        """Write how attempts ended, all that have ended by now.

        Raises
        ------
        StoreError
            The database does not answer; they are written the next time.
        """
        while not self._ended.empty():
            self._unwritten.append(self._ended.get())
        if not self._unwritten:
            return
        states = self._written(self._unwritten)
        now_s = time.monotonic()
        for (parcel, result), state in zip(self._unwritten, states, strict=True):
            was_reached = result.status is not None or result.is_final or result.is_own_fault
            duration_s = result.duration_ms / 1000.0
            self._receivers.end(parcel.receiver, duration_s, was_reached=was_reached, now_s=now_s)
            self._report(parcel, result, state)
        self._unwritten = []

    def _written(self, ended: list[tuple[Parcel, Result]]) -> list[DeliveryState | None]:
        """Write how attempts ended; one that cannot be written holds up no others, and is sent again.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        try:
            return self._store.webhooks.settle_all(ended, self._policy)
        except StoreError:
            raise
        except Exception:
            if len(ended) > 1:
                return [state for one in ended for state in self._written([one])]
            words = "the end of delivery %s cannot be written"
            LOG.exception(words, ended[0][0].delivery.delivery_id, extra=self._facts)
            return [None]

    def _send_what_is_due(self) -> float:
        """Hand out what is due; seconds until the next look.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        now_s = time.monotonic()
        found = self._store.webhooks.claim_some(
            self._name,
            lambda line: self._receivers.chosen(line, now_s),
            lease_s=LEASE_S,
            avoided=self._receivers.avoided(now_s),
        )
        for parcel in found:
            self._receivers.begin(parcel.receiver, parcel.payer, now_s)
            self._parcels.put(parcel)
        while len(self._crew) < self._receivers.under_way:
            self._crew.append(threading.Thread(target=self._send, name=f"webhooks-{len(self._crew)}", daemon=True))
            self._crew[-1].start()
        return min(self._settings.poll_s, LOOK_S)

    def _report(self, parcel: Parcel, result: Result, state: DeliveryState | None) -> None:
        """Log how an attempt ended."""
        delivery = parcel.delivery
        facts = {**self._facts, "job": delivery.job_id, "delivery": delivery.delivery_id}
        if state is None:
            words = "delivery %s: attempt %d is no longer held"
            LOG.warning(words, delivery.delivery_id, delivery.attempts, extra=facts)
            return
        level = logging.INFO if result.is_success else logging.WARNING
        words = "%s to %s, attempt %d: %s"
        outcome = state.value if result.error is None else f"{state.value}: {result.error}"
        host = delivery.url.split("/")[2].rpartition("@")[2] if "//" in delivery.url else delivery.url
        LOG.log(level, words, delivery.event.value, host, delivery.attempts, outcome, extra=facts)

    # --- the threads that send

    def _send(self) -> None:
        while True:
            parcel = self._parcels.get()
            self._ended.put((parcel, self.attempt(parcel)))
            # its receiver is free for the next message
            self._look_again.set()

    def attempt(self, parcel: Parcel) -> Result:
        """Send a delivery once."""
        began_s = time.monotonic()
        delivery = parcel.delivery
        try:
            parent = of_job(parcel.job)
            with tracing.span("webhook", kind="client", parent=parent, delivery_id=delivery.delivery_id) as made:
                result = self._sent(parcel, began_s)
                tracing.note(made, event=delivery.event.value, attempt=delivery.attempts)
                tracing.note(made, http__response__status_code=result.status)
                if not result.is_success:
                    tracing.failed(made, "not delivered")
        except Exception:
            facts = {**self._facts, "job": delivery.job_id, "delivery": delivery.delivery_id}
            LOG.exception("delivery %s met an unexpected fault", delivery.delivery_id, extra=facts)
            error = "an unexpected fault of the service; its log has it"
            result = Result(duration_ms=_since_ms(began_s), error=error, is_own_fault=True)
        return result

    def _sent(self, parcel: Parcel, began_s: float) -> Result:
        """Send a delivery once."""
        delivery = parcel.delivery
        try:
            # an attempt sends the same bytes as the one before
            body = delivery.body
            if body is None:
                body = body_of(parcel, self._folder, self._settings)
        except NoSuchOutputError as error:
            return Result(duration_ms=_since_ms(began_s), error=str(error), is_final=True)
        raw = body.encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"gablework/{__version__}",
            **signed_headers(parcel.secret, delivery.delivery_id, int(parcel.sent_at.timestamp()), raw),
        }
        here = tracing.current()
        if here is not None:
            headers["traceparent"] = here.traceparent
        try:
            status, retry_after = self._post(delivery.url, headers=headers, body=raw, settings=self._settings)
        except TargetRefusedError as error:
            return Result(duration_ms=_since_ms(began_s), error=str(error), is_final=True, body=body)
        except SendError as error:
            return Result(duration_ms=_since_ms(began_s), error=str(error), body=body)
        return Result(
            duration_ms=_since_ms(began_s),
            status=status,
            error=_fault(status),
            retry_after_s=wanted_pause_s(retry_after),
            body=body,
        )

    # --- the log

    def _keep_log(self) -> None:
        stopping = self._stopping
        words = "old deliveries cannot be removed yet"
        repeat(self._forget, stopping.wait, stopping.is_set, complaint=words, facts=self._facts)

    def _forget(self) -> float:
        """Keep the log within its limits, so that the database does not grow without bound."""
        settings = self._settings
        for _ in range(_ROUNDS):
            if not self._store.webhooks.forget(settings.webhook_log_days, most=settings.webhook_log_max):
                break
            self._stopping.wait(PACE_S)
        return FORGET_S

    @property
    def _facts(self) -> Mapping[str, object]:
        return {"driver": self._name}


def body_of(parcel: Parcel, folder: StateFolder, settings: ServiceSettings) -> str:
    """The body of a message: for a subscriber as the standard says, for an endpoint an event.

    Raises
    ------
    NoSuchOutputError
        The results of the job are gone.
    """
    base = (settings.public_url or parcel.base).rstrip("/")
    job, event = parcel.job, parcel.delivery.event
    if parcel.delivery.endpoint_id is None and event is EventType.SUCCESSFUL:
        catalogue = read_catalogue(folder.outputs(job.job_id, job.attempt))
        results = results_document(catalogue, lambda name: f"{base}/jobs/{job.job_id}/results/{name}")
        return results.model_dump_json(by_alias=True, exclude_defaults=True)
    status = status_info(job, base, with_request=False).model_dump_json(by_alias=True, exclude_defaults=True)
    if parcel.delivery.endpoint_id is None:
        return status
    message = Message(type=event.value, timestamp=parcel.delivery.created_at, data=json.loads(status))
    return message.model_dump_json()


def _fault(status: int) -> str | None:
    """What is wrong with an answer."""
    if 200 <= status < 300:
        return None
    if 300 <= status < 400:
        return f"the receiver answered {status}: redirects are not followed, give the URL to which it leads"
    return f"the receiver answered {status}"


def _since_ms(began_s: float) -> int:
    return round((time.monotonic() - began_s) * 1000.0)
