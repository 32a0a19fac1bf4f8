"""Webhooks as clients send and get them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field

from service import webhooks as records
from service.wire.base import Answer, Link, Request, Time, at_most
from service.wire.queries import Page

ReceiverUrl = Annotated[str, Field(min_length=1, max_length=4096)]
"""Where messages go; whether it is allowed depends on the service's settings."""

if TYPE_CHECKING:
    EventType = str
    State = str
else:
    EventType = Literal[tuple(event.value for event in records.EventType)]
    """What is reported."""
    State = Literal[tuple(state.value for state in records.DeliveryState)]

DEFAULT_EVENTS = tuple(event.value for event in records.EventType if event.is_end)
"""The ends of jobs, which most receivers want."""


def _each_once(events: list[EventType]) -> list[EventType]:
    return list(dict.fromkeys(events))


Events = Annotated[
    list[EventType],
    Field(min_length=1, max_length=20, description="Only these are sent. `job.progress` comes at most every 10 s."),
    AfterValidator(_each_once),
    at_most(20),
]


class WebhookRequest(Request):
    """A new webhook."""

    HINTS: ClassVar[Mapping[str, str]] = {"url": "give the URL that receives the messages"}

    url: ReceiverUrl = Field(description="Receives the messages.")
    events: Events = Field(default_factory=lambda: [*DEFAULT_EVENTS])
    description: Annotated[str, Field(max_length=500)] | None = Field(None, description="Your own words.")


class Webhook(Answer):
    """A receiver of the events of all jobs."""

    webhookID: str
    url: str
    events: list[EventType]
    description: str | None = None
    enabled: bool
    disabledReason: str | None = Field(None, description="Why nothing is sent.")
    created: Time
    updated: Time
    links: list[Link]


class NewWebhook(Webhook):
    """A webhook that was just made, with its secret: it is shown only now."""

    secret: str = Field(description="Signs the messages, as in Standard Webhooks.")


class EventKind(Answer):
    """An event that webhooks may get."""

    type: EventType
    title: str = Field(description="In words.")
    isDefault: bool = Field(description="Whether a webhook gets it that names no events.")


class WebhookList(Answer):
    """A page of webhooks."""

    webhooks: list[Webhook]
    eventTypes: list[EventKind] = Field(description="All events that webhooks may get.")
    links: list[Link]


class Secret(Answer):
    """A secret that signs messages."""

    secret: str = Field(description="As in Standard Webhooks: `whsec_` and base64.")


class Attempt(Answer):
    """An attempt to send a message."""

    number: int = Field(ge=1)
    at: Time
    durationMilliseconds: int | None = Field(None, ge=0, description="Left out while it is under way.")
    status: int | None = Field(None, description="HTTP status of the answer.")
    error: str | None = Field(None, description="What went wrong.")


class Delivery(Answer):
    """A message to a receiver."""

    deliveryID: str = Field(description="Also the header `webhook-id`, in all attempts.")
    jobID: str = Field(description="The job, which may be removed by now.")
    webhookID: str | None = Field(None, description="The webhook; left out if the receiver is a job's subscriber.")
    url: str
    type: EventType
    title: str = Field(description="The event in words.")
    state: State
    reason: str | None = Field(None, description="Why it is in this state.")
    created: Time = Field(description="Time of the event.")
    nextAttempt: Time | None = Field(None, description="Time of the next attempt, while it waits.")
    finished: Time | None = None
    attemptCount: int = Field(ge=0)
    attempts: list[Attempt] | None = Field(None, description="All attempts; left out in lists.")
    body: str | None = Field(None, description="The body as it was sent; left out in lists.")
    links: list[Link]


class DeliveryList(Answer):
    """A page of deliveries."""

    deliveries: list[Delivery]
    links: list[Link]


class DeliveryQuery(Page):
    """Which deliveries."""

    job: str | None = Field(None, description="Only news of this job.")
    webhook: str | None = Field(None, description="Only messages to this webhook.")
    state: State | None = Field(None, description="Only deliveries in this state.")


class Message(Answer):
    """The body of a message to a webhook; `data` is the job's statusInfo."""

    type: EventType
    timestamp: Time = Field(description="Time of the event.")
    data: Any
