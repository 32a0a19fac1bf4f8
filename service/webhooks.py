"""Webhooks: endpoints, deliveries, signatures, and when a delivery is tried again.

No SQL, no HTTP; time is an argument.

```
             2xx
 waiting ----------> delivered
  |  ^  |  410
  |  |  +----------> gone       nothing more goes to this URL
  +--+  |  too old, or refused
 retry  +----------> failed
        |  overtaken, webhook disabled or removed
        +----------> dropped
```

Each event is a row that is written with a delivery per receiver in the transaction that changes the job, so no change
goes unreported. A replay makes a delivery wait again.
Signatures follow Standard Webhooks (standardwebhooks.com).
"""

from __future__ import annotations

import base64
import dataclasses
import datetime as dt
import hashlib
import hmac
import secrets
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Self

from pydantic import TypeAdapter

from pipeline.backoff import Backoff
from service.jobs import Job, JobStatus

SECRET_PREFIX = "whsec_"  # noqa: S105 - the prefix that the standard gives to secrets
_SECRET_BYTES = 32
"""As long as the digest that it keys; the standard asks for 24 to 64."""

PROGRESS_S = 10.0
"""Minimum seconds between two reports of progress to one receiver; people who look at it need no more."""

LONGEST_PAUSE_S = 4.0 * 3600.0
"""Longest pause between two attempts: a receiver that comes back after a night gets its news within the morning."""

MAX_WAITING = 2000
"""Most deliveries that wait for one endpoint, or for the subscribers of one key: further ends of jobs fail at once."""

GONE = 410
"""The status by which a receiver ends its deliveries."""


class EventType(StrEnum):
    """What a webhook reports: the table of all events, from which requests, answers and the web page derive."""

    words: str
    """The event in words, for people."""
    uri_field: str | None
    """The field of a subscriber with the URI that gets it; None if none does."""
    is_end: bool
    """Whether nothing follows."""

    def __new__(cls, value: str, words: str = "", uri_field: str | None = None, is_end: bool = False) -> Self:
        """One row."""
        event = str.__new__(cls, value)
        event._value_ = value
        event.words, event.uri_field, event.is_end = words, uri_field, is_end
        return event

    ACCEPTED = ("job.accepted", "a job waits", None, False)
    """A job waits for a driver: it is new, or an attempt was lost. Its own client knows that."""
    RUNNING = ("job.running", "a job has begun", "in_progress_uri", False)
    PROGRESS = ("job.progress", "progress", "in_progress_uri", False)
    """The job has progressed; at most once in `PROGRESS_S` seconds."""
    SUCCESSFUL = ("job.successful", "a job is done", "success_uri", True)
    FAILED = ("job.failed", "a job failed", "failed_uri", True)
    DISMISSED = ("job.dismissed", "a job was cancelled", "failed_uri", True)


EVENT_OF: Mapping[JobStatus, EventType] = {status: EventType(f"job.{status.value}") for status in JobStatus}
"""The event of a new status."""


class DeliveryState(StrEnum):
    """State of a delivery."""

    WAITING = "waiting"
    """It will be sent, or sent again."""
    DELIVERED = "delivered"
    """The receiver answered with 2xx."""
    FAILED = "failed"
    """It was refused, or tried for too long."""
    GONE = "gone"
    """The receiver answered 410."""
    DROPPED = "dropped"
    """It is not needed any longer; the reason says why."""


# --- secrets and signatures


def new_secret() -> str:
    """A random secret for signatures."""
    return SECRET_PREFIX + base64.b64encode(secrets.token_bytes(_SECRET_BYTES)).decode()


def signature(secret: str, message_id: str, timestamp_s: int, body: bytes) -> str:
    """The signature of a message: `v1,` and the base64 of HMAC-SHA256 over id, timestamp and body.

    Raises
    ------
    ValueError
        The secret is not base64.

    >>> signature("whsec_" + "QUJD" * 8, "m", 1, b"{}")[:8]
    'v1,8ECeu'
    """
    key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    digest = hmac.new(key, f"{message_id}.{timestamp_s}.".encode() + body, hashlib.sha256).digest()
    return f"v1,{base64.b64encode(digest).decode()}"


def signed_headers(secret: str, message_id: str, timestamp_s: int, body: bytes) -> dict[str, str]:
    """The headers of a message."""
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(timestamp_s),
        "webhook-signature": signature(secret, message_id, timestamp_s, body),
    }


# --- records


@dataclasses.dataclass(frozen=True, kw_only=True)
class Endpoint:
    """A receiver of the events of all jobs, as an operator made it."""

    endpoint_id: str
    """32 hexadecimal digits."""
    url: str
    events: tuple[EventType, ...]
    """Only these are sent."""
    description: str | None
    is_enabled: bool
    disabled_reason: str | None
    """Why nothing is sent; None if it is enabled."""
    base: str
    """The service's own URL when it was made, for links."""
    created_at: dt.datetime
    """With a time zone, like all times here."""
    updated_at: dt.datetime
    owner: str | None = None
    """The key that made it; None if keys are not used."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attempt:
    """One attempt to send a delivery."""

    number: int
    """From 1."""
    at: dt.datetime
    driver: str
    """The driver that sent it."""
    duration_ms: int | None = None
    """None while it is under way."""
    status: int | None = None
    """HTTP status of the answer; None without one."""
    error: str | None = None
    """What went wrong; None if the receiver took it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Delivery:
    """One message to one receiver."""

    delivery_id: str
    """32 hexadecimal digits; the header `webhook-id`, the same in all attempts."""
    endpoint_id: str | None
    """The endpoint; None if the receiver is the subscriber of a job."""
    job_id: str
    owner: str | None
    """The key of the job."""
    url: str
    event: EventType
    state: DeliveryState
    reason: str | None
    """Why it is in this state, if that needs words."""
    attempts: int
    """Number of attempts."""
    created_at: dt.datetime
    """Time of the event."""
    tried_since: dt.datetime
    """Time from which the hours of retries count: that of the event, or of the last replay."""
    due_at: dt.datetime | None
    """Time of the next attempt; None if it does not wait."""
    finished_at: dt.datetime | None
    body: str | None = None
    """The body as it was sent; None before the first attempt."""
    log: tuple[Attempt, ...] = ()
    """All attempts, the first one first; only if one delivery was asked for."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parcel:
    """A delivery that a driver sends now."""

    delivery: Delivery
    driver: str
    """The driver that holds it."""
    job: Job
    """The job at the time of the event."""
    base: str
    """The service's own URL, for links."""
    secret: str
    """Signs it."""
    sent_at: dt.datetime
    """The time of this attempt."""
    payer: str = ""
    """The key that made the endpoint or the job: it holds a share of the senders. Empty if keys are not used."""

    @property
    def receiver(self) -> str:
        """The endpoint, or the URL of a subscriber: it gets one message at a time."""
        return self.delivery.endpoint_id or self.delivery.url


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """How an attempt ended."""

    duration_ms: int
    status: int | None = None
    """HTTP status of the answer; None without one."""
    error: str | None = None
    """What went wrong; None if the receiver took it."""
    retry_after_s: float = 0.0
    """Seconds that the receiver asks for."""
    is_final: bool = False
    """Whether another attempt cannot help."""
    is_own_fault: bool = False
    """Whether the service failed, not the receiver."""
    body: str | None = None
    """The body that was sent, or would have been."""

    @property
    def is_success(self) -> bool:
        """Whether the receiver took it."""
        return self.error is None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What becomes of a delivery after an attempt."""

    state: DeliveryState
    due_at: dt.datetime | None = None
    """Time of the next attempt."""
    reason: str | None = None


def retry_policy(hours: float, first_pause_s: float) -> Backoff:
    """When a delivery is tried again, for so many hours from its event or from a replay: about ten times in a day."""
    return Backoff(
        first_s=first_pause_s, longest_s=LONGEST_PAUSE_S, factor=3.0, jitter=(0.5, 1.5), limit_s=hours * 3600.0
    )


def verdict(delivery: Delivery, result: Result, now: dt.datetime, policy: Backoff, chance: float) -> Verdict:
    """What becomes of a delivery whose attempt has just ended."""
    if result.is_success:
        return Verdict(state=DeliveryState.DELIVERED)
    if result.status == GONE:
        return Verdict(state=DeliveryState.GONE, reason="the receiver answered 410: nothing more is sent to this URL")
    if result.is_final:
        return Verdict(state=DeliveryState.FAILED, reason=result.error)
    elapsed_s = (now - delivery.tried_since).total_seconds()
    wanted_s = min(result.retry_after_s, LONGEST_PAUSE_S)
    pause_s = policy.pause_s(delivery.attempts, elapsed_s=elapsed_s, draw=chance, wanted_s=wanted_s)
    if pause_s is None:
        reason = f"tried for {policy.limit_s / 3600.0:g} hours; the last time: {result.error}"
        return Verdict(state=DeliveryState.FAILED, reason=reason)
    return Verdict(state=DeliveryState.WAITING, due_at=now + dt.timedelta(seconds=pause_s), reason=result.error)


# --- the job as it was


_JOB = TypeAdapter(Job)


def snapshot_of(job: Job) -> dict[str, Any]:
    """All that a message says of a job, as plain JSON values; without its inputs, settings and lease."""
    small = dataclasses.replace(job.request, tiles=(), footprints=None, guides=None, settings={}, subscriber=None)
    found: dict[str, Any] = _JOB.dump_python(
        dataclasses.replace(job, request=small, lease_owner=None, lease_until=None), mode="json"
    )
    return found


def job_of(snapshot: Mapping[str, Any]) -> Job:
    """The inverse of `snapshot_of`."""
    return _JOB.validate_python(snapshot)
