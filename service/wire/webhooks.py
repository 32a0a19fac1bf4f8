"""Webhooks as clients send and get them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field

from service.wire.base import Answer, Link, Request, Time, at_most, optional_members
from service.wire.faults import FaultsError
from service.wire.queries import Page

ReceiverUrl = Annotated[str, Field(min_length=1, max_length=4096)]
"""Where messages go; whether it is allowed depends on the service's settings."""

EventType = Literal["job.accepted", "job.running", "job.progress", "job.successful", "job.failed", "job.dismissed"]
"""What is reported."""

DEFAULT_EVENTS: tuple[EventType, ...] = ("job.successful", "job.failed", "job.dismissed")
"""The ends of jobs, which most receivers want."""

State = Literal["waiting", "delivered", "failed", "gone", "dropped"]


def _each_once(events: list[EventType]) -> list[EventType]:
    return list(dict.fromkeys(events))


Events = Annotated[
    list[EventType],
    Field(min_length=1, max_length=20, description="Only these are sent. `job.progress` comes at most every 10 s."),
    AfterValidator(_each_once),
    at_most(20),
]


def _changes(schema: dict[str, Any]) -> None:
    """Describe a change: at least one member, and no defaults."""
    optional_members(schema)
    for found in schema["properties"].values():
        found.pop("default", None)
    schema["minProperties"] = 1


class WebhookPatch(Request):
    """A change of a webhook: members that are not given stay."""

    model_config = ConfigDict(json_schema_extra=_changes)

    HINTS: ClassVar[Mapping[str, str]] = {"url": "give the URL that receives the messages"}

    url: ReceiverUrl = Field(default_factory=str, description="Receives the messages; those that wait go there, too.")
    events: Events = Field(default_factory=lambda: [*DEFAULT_EVENTS])
    description: Annotated[str, Field(max_length=500)] | None = Field(
        None, description="Your own words; null for none.", json_schema_extra={"nullable": True}
    )
    enabled: bool = Field(
        True,
        description="Whether anything is sent. If not, messages that wait are dropped. True also ends a pause.",
    )

    @classmethod
    def prepared(cls, given: Any) -> Any:
        """The change, if there is one."""
        if given == {}:
            raise FaultsError([f"nothing is given: give the members to change, of {', '.join(cls.model_fields)}"])
        return given


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
    oldSecretUntil: Time | None = Field(None, description="Time until which the replaced secret still signs.")
    pausedSince: Time | None = Field(
        None, description="Time since which nothing is sent because the receiver did not keep up; a replay ends it."
    )
    notSent: int | None = Field(None, ge=1, description="Messages that wait for room or, while it is paused, a replay.")
    links: list[Link]


class NewWebhook(Webhook):
    """A webhook that was just made, with its secret: it is shown only now."""

    secret: str = Field(description="Signs the messages, as in Standard Webhooks.")


class WebhookList(Answer):
    """A page of webhooks."""

    webhooks: list[Webhook]
    links: list[Link]


class Secret(Answer):
    """A secret that signs messages."""

    secret: str = Field(description="As in Standard Webhooks: `whsec_` and base64.")
    changed: Time = Field(description="When it was made.")
    oldSecretUntil: Time | None = Field(None, description="Time until which the replaced secret still signs.")


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
