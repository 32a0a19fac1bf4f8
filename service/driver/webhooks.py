"""Sends webhooks: claims deliveries that are due, makes and signs their bodies, posts them, writes what came back."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping

from pipeline import __version__
from pipeline.runtime.monitoring import tracing
from service.driver.attempts import FIRST_PAUSE_S, LONGEST_PAUSE_S
from service.errors import LeaseLostError, NoSuchOutputError, StoreError, TargetRefusedError
from service.files import StateFolder
from service.outputs import read_catalogue
from service.settings import ServiceSettings
from service.status import results_document, status_info
from service.store import JobStore
from service.traces import of_job
from service.webhook_targets import SEND_S, SendError, post
from service.webhooks import EventType, Parcel, Result, RetryPolicy, signed_headers
from service.wire.webhooks import Message

LOG = logging.getLogger("gablework.driver")

SENDERS = 4
"""Threads that send: a receiver that hangs holds up one of them."""
LEASE_S = SEND_S + 15.0
"""Seconds for which a delivery is held: an attempt, and the time to write its end."""

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
        Hosts, retries, pauses.
    name : str
        Unique name of the driver.
    send : callable, optional
        Posts a message; tests replace it.
    """

    def __init__(
        self, store: JobStore, folder: StateFolder, settings: ServiceSettings, *, name: str, send: Post = post
    ) -> None:
        self._store = store
        self._folder = folder
        self._settings = settings
        self._name = name
        self._send = send
        self._policy = RetryPolicy(hours=settings.webhook_hours, first_pause_s=settings.webhook_pause_s)
        self._claiming = threading.Lock()
        self._stopping = threading.Event()
        self._look_again = threading.Event()
        self.threads = [
            threading.Thread(target=self._work, name=f"webhooks-{number}", daemon=True) for number in range(SENDERS)
        ]
        """Not started yet."""

    def stop(self) -> None:
        """Claim nothing more; an attempt that is under way ends within its time."""
        self._stopping.set()
        self._look_again.set()

    def _work(self) -> None:
        while True:
            # one thread looks for work; the others wait for it, or send
            with self._claiming:
                parcel = self._next()
            if parcel is None:
                return
            self.deliver(parcel)
            # its receiver is free for the next message
            self._look_again.set()

    def _next(self) -> Parcel | None:
        """Wait for a delivery that is due; None at the end."""
        pause = FIRST_PAUSE_S
        while not self._stopping.is_set():
            self._look_again.clear()
            wait_s = self._settings.poll_s
            try:
                parcel = self._store.webhooks.claim(self._name, lease_s=LEASE_S)
            except StoreError as error:
                LOG.warning("cannot look for webhooks, next try in %g s: %s", pause, error, extra=self._facts)
                wait_s, pause = pause, min(LONGEST_PAUSE_S, 2.0 * pause)
            except Exception:
                LOG.exception("an unexpected fault with webhooks, next try in %g s", pause, extra=self._facts)
                wait_s, pause = pause, min(LONGEST_PAUSE_S, 2.0 * pause)
            else:
                if parcel is not None:
                    return parcel
                pause = FIRST_PAUSE_S
            if not self._stopping.is_set():
                self._look_again.wait(wait_s)
        return None

    def deliver(self, parcel: Parcel) -> None:
        """Send one delivery and write how that ended."""
        began_s = time.monotonic()
        delivery = parcel.delivery
        facts = {**self._facts, "job": delivery.job_id, "delivery": delivery.delivery_id}
        try:
            parent = of_job(parcel.job)
            with tracing.span("webhook", kind="client", parent=parent, delivery_id=delivery.delivery_id) as made:
                result = self._attempt(parcel, began_s)
                tracing.note(made, event=delivery.event.value, attempt=delivery.attempts)
                tracing.note(made, http__response__status_code=result.status)
                if not result.is_success:
                    tracing.failed(made, "not delivered")
        except Exception:
            LOG.exception("delivery %s met an unexpected fault", delivery.delivery_id, extra=facts)
            result = Result(duration_ms=_since_ms(began_s), error="an unexpected fault of the service; its log has it")
        pause = FIRST_PAUSE_S
        while True:
            try:
                state = self._store.webhooks.settle(parcel, result, self._policy)
            except LeaseLostError as error:
                LOG.warning("%s", error, extra=facts)
                return
            except StoreError as error:
                LOG.warning("the end of a delivery cannot be written yet: %s", error, extra=facts)
                if self._stopping.wait(pause):
                    return
                pause = min(LONGEST_PAUSE_S, 2.0 * pause)
            else:
                level = logging.INFO if result.is_success else logging.WARNING
                words = "%s to %s, attempt %d: %s"
                outcome = state.value if result.error is None else f"{state.value}: {result.error}"
                host = delivery.url.split("/")[2].rpartition("@")[2] if "//" in delivery.url else delivery.url
                LOG.log(level, words, delivery.event.value, host, delivery.attempts, outcome, extra=facts)
                return

    def _attempt(self, parcel: Parcel, began_s: float) -> Result:
        delivery = parcel.delivery
        try:
            # an attempt sends the same bytes as the one before
            body = body_of(parcel, self._folder, self._settings) if delivery.body is None else delivery.body
        except NoSuchOutputError as error:
            return Result(duration_ms=_since_ms(began_s), error=str(error), is_final=True)
        raw = body.encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": f"gablework/{__version__}",
            **signed_headers(parcel.secrets, delivery.delivery_id, int(parcel.sent_at.timestamp()), raw),
        }
        here = tracing.current()
        if here is not None:
            headers["traceparent"] = here.traceparent
        try:
            status, retry_after = self._send(delivery.url, headers=headers, body=raw, settings=self._settings)
        except TargetRefusedError as error:
            return Result(duration_ms=_since_ms(began_s), error=str(error), is_final=True, body=body)
        except SendError as error:
            return Result(duration_ms=_since_ms(began_s), error=str(error), body=body)
        return Result(
            duration_ms=_since_ms(began_s),
            status=status,
            error=_fault(status),
            retry_after_s=_seconds(retry_after),
            body=body,
        )

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


def _seconds(retry_after: str | None) -> float:
    """The header Retry-After; a date is not read.

    >>> _seconds("120"), _seconds("Wed, 21 Oct 2026 07:28:00 GMT")
    (120.0, 0.0)
    """
    is_number = retry_after is not None and retry_after.isascii() and retry_after.isdigit()
    return float(retry_after) if is_number and retry_after is not None else 0.0


def _since_ms(began_s: float) -> int:
    return round((time.monotonic() - began_s) * 1000.0)
