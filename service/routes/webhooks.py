"""Webhooks: receivers of the events of all jobs, secrets, and the log of deliveries with replay."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body, Path, Query, Response

from service import webhooks as records
from service.deliveries import Delivery
from service.routes.answers import JOB_ID, document, header, problems
from service.routes.bound import Admin, Base, Reader, Store, Submitter
from service.routes.submission import Submitting
from service.routes.writing import Write
from service.store import DeliveryFilter
from service.webhook_targets import check_receiver
from service.webhooks import DeliveryState, EventType
from service.wire import webhooks as wire
from service.wire.base import Link, link, page_links, respond
from service.wire.queries import Page

router = APIRouter(tags=["webhooks"])

NewEndpoint = tuple[records.Endpoint, str]
"""A receiver and its secret."""

WEBHOOK_ID = "0d4c2b7a9e8f41608b5a3c1d7e6f9a02"
DELIVERY_ID = "9a7b5c3d1e0f42688c6d4e2f0a1b3c5d"
"""Ids of the examples."""

_SECRET = "whsec_" + "MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY="

_EXAMPLE = {
    "webhookID": WEBHOOK_ID,
    "url": "https://hooks.example.org/gablework",
    "events": [*wire.DEFAULT_EVENTS],
    "enabled": True,
    "created": "2026-03-01T09:30:00.000Z",
    "updated": "2026-03-01T09:30:00.000Z",
    "links": [{"href": f"http://127.0.0.1:8000/webhooks/{WEBHOOK_ID}", "rel": "self", "type": "application/json"}],
}
_LIST_EXAMPLE = {
    "webhooks": [_EXAMPLE],
    "eventTypes": [{"type": "job.successful", "title": "a job is done", "isDefault": True}],
    "links": [],
}
_DELIVERY_EXAMPLE = {
    "deliveryID": DELIVERY_ID,
    "jobID": JOB_ID,
    "url": "https://hooks.example.org/gablework",
    "type": "job.successful",
    "title": "a job is done",
    "state": "waiting",
    "reason": "the receiver answered 503",
    "created": "2026-03-01T09:40:00.000Z",
    "nextAttempt": "2026-03-01T09:40:06.100Z",
    "attemptCount": 1,
    "attempts": [{"number": 1, "at": "2026-03-01T09:40:00.200Z", "durationMilliseconds": 31, "status": 503}],
    "links": [
        {"href": f"http://127.0.0.1:8000/webhooks/deliveries/{DELIVERY_ID}", "rel": "self", "type": "application/json"}
    ],
}

WebhookId = Annotated[str, Path(alias="webhookID", description="As in the webhook itself.", examples=[WEBHOOK_ID])]
DeliveryId = Annotated[str, Path(alias="deliveryID", description="As in the list.", examples=[DELIVERY_ID])]


# --- the secret of a key. These paths come before `/webhooks/{webhookID}`, which would match them, too.


@router.get(
    "/webhooks/secret",
    summary="The secret of a key's subscribers",
    responses={200: document(wire.Secret, "The secret.", {"secret": _SECRET})},
)
async def own_secret(store: Store, caller: Submitter, write: Write) -> Response:
    """The secret that signs messages to the subscribers of this key's jobs."""
    return _secret(await write(lambda: store.webhooks.own_secret(caller.key_id)))


@router.post(
    "/webhooks/secret/rotate",
    summary="Replace the secret of a key's subscribers",
    responses={200: document(wire.Secret, "The new secret.", {"secret": _SECRET})},
)
async def replace_own_secret(store: Store, caller: Submitter, write: Write) -> Response:
    """Make a new secret. The one before signs no longer: give the new one to the receivers at once."""
    return _secret(await write(lambda: store.webhooks.replace_own_secret(caller.key_id)))


# --- the log


@router.get(
    "/webhooks/deliveries",
    summary="List deliveries",
    responses={
        200: document(
            wire.DeliveryList, "The deliveries, newest first.", {"deliveries": [_DELIVERY_EXAMPLE], "links": []}
        ),
        **problems(400),
    },
)
def deliveries(base: Base, store: Store, caller: Reader, query: Annotated[wire.DeliveryQuery, Query()]) -> Response:
    """List the messages to the subscribers of this key's jobs; with the scope admin those to all receivers."""
    criteria = DeliveryFilter(
        owner=caller.owner,
        job_id=query.job,
        endpoint_id=query.webhook,
        state=None if query.state is None else DeliveryState(query.state),
        limit=query.limit + 1,
        offset=query.offset,
    )
    found = store.webhooks.deliveries(criteria)
    asked = [("job", query.job), ("webhook", query.webhook), ("state", query.state)]
    links = page_links(f"{base}/webhooks/deliveries", asked, len(found), query.limit, query.offset)
    listed = [delivery_document(one, base, is_whole=False) for one in found[: query.limit]]
    return respond(wire.DeliveryList(deliveries=listed, links=links))


@router.get(
    "/webhooks/deliveries/{deliveryID}",
    summary="A delivery",
    responses={200: document(wire.Delivery, "The delivery.", _DELIVERY_EXAMPLE), **problems(404)},
)
def delivery(delivery_id: DeliveryId, base: Base, store: Store, caller: Reader) -> Response:
    """A message with its body and all attempts: status, duration, error."""
    found = store.webhooks.delivery(delivery_id, owner=caller.owner)
    return respond(delivery_document(found, base), headers={"Cache-Control": "no-store"})


@router.post(
    "/webhooks/deliveries/{deliveryID}/replay",
    summary="Send a delivery again",
    status_code=202,
    responses={202: document(wire.Delivery, "It is sent soon.", _DELIVERY_EXAMPLE), **problems(404, 409)},
)
async def replay(delivery_id: DeliveryId, base: Base, store: Store, caller: Submitter, write: Write) -> Response:
    """Send a message again, with the same id and body, whatever became of it. Its hours of retries count anew."""
    found = await write(lambda: store.webhooks.replay(delivery_id, owner=caller.owner))
    return respond(delivery_document(found, base), status_code=202)


# --- receivers of the events of all jobs


@router.post(
    "/webhooks",
    summary="Make a webhook",
    status_code=201,
    responses={
        201: document(
            wire.NewWebhook,
            "The webhook with its secret, which is shown only now.",
            {**_EXAMPLE, "secret": _SECRET},
            headers=header("Location", "The webhook."),
        ),
        **problems(400, 409, 422, 507),
    },
)
async def make_webhook(
    body: Annotated[
        wire.WebhookRequest,
        Body(openapi_examples={"ends of jobs": {"value": {"url": "https://hooks.example.org/gablework"}}}),
    ],
    base: Base,
    store: Store,
    submitting: Submitting,
    caller: Admin,
) -> Response:
    """Send the events of all jobs to a URL, signed as in Standard Webhooks."""
    events = [EventType(word) for word in body.events]
    most = submitting.settings.max_webhooks_per_key

    def create(delivery: Delivery[NewEndpoint]) -> NewEndpoint:
        return store.webhooks.create(
            body.url,
            events=events,
            description=body.description,
            base=base,
            owner=caller.key_id,
            most=most,
            delivery=delivery,
        )

    def answer(made: NewEndpoint) -> Response:
        endpoint, secret = made
        found = wire.NewWebhook(**_members(endpoint, base), secret=secret)
        place = f"{base}/webhooks/{endpoint.endpoint_id}"
        return respond(found, status_code=201, headers={"Location": place, "Cache-Control": "no-store"})

    async with submitting as submission:
        await check_receiver(body.url, submission.settings)
        return await submission.make(create, answer)


@router.get(
    "/webhooks",
    summary="List webhooks",
    responses={
        200: document(wire.WebhookList, "The webhooks, newest first.", _LIST_EXAMPLE),
        **problems(400),
    },
)
def webhooks(base: Base, store: Store, _caller: Admin, page: Annotated[Page, Query()]) -> Response:
    """List the receivers of the events of all jobs."""
    found = store.webhooks.list(limit=page.limit + 1, offset=page.offset)
    links = page_links(f"{base}/webhooks", (), len(found), page.limit, page.offset)
    listed = [wire.Webhook(**_members(one, base)) for one in found[: page.limit]]
    kinds = [wire.EventKind(type=one.value, title=one.words, isDefault=one.is_end) for one in EventType]
    return respond(wire.WebhookList(webhooks=listed, eventTypes=kinds, links=links))


@router.get(
    "/webhooks/{webhookID}",
    summary="A webhook",
    responses={200: document(wire.Webhook, "The webhook.", _EXAMPLE), **problems(404)},
)
def webhook(webhook_id: WebhookId, base: Base, store: Store, _caller: Admin) -> Response:
    """A webhook, without its secret."""
    return respond(wire.Webhook(**_members(store.webhooks.get(webhook_id), base)))


@router.post(
    "/webhooks/{webhookID}/replay",
    summary="Send what was not sent to a webhook",
    status_code=202,
    responses={202: document(wire.Webhook, "Its messages are sent soon.", _EXAMPLE), **problems(404)},
)
async def replay_webhook(webhook_id: WebhookId, base: Base, store: Store, write: Write, _caller: Admin) -> Response:
    """Send all that waits for a webhook, and the ends of jobs that failed or were dropped.

    This enables it, too, if its receiver had answered 410.
    """
    found = await write(lambda: store.webhooks.replay_all(webhook_id))
    return respond(wire.Webhook(**_members(found, base)), status_code=202)


@router.delete(
    "/webhooks/{webhookID}",
    summary="Remove a webhook",
    status_code=204,
    response_class=Response,
    responses={
        204: {"description": "It is removed. Messages that wait are dropped; the log stays."},
        **problems(404),
    },
)
async def remove_webhook(webhook_id: WebhookId, store: Store, write: Write, _caller: Admin) -> Response:
    """Send nothing more to a webhook."""
    await write(lambda: store.webhooks.remove(webhook_id))
    return Response(status_code=204)


def _members(found: records.Endpoint, base: str) -> dict[str, Any]:
    """A webhook as clients see it."""
    place = f"{base}/webhooks/{found.endpoint_id}"
    return {
        "webhookID": found.endpoint_id,
        "url": found.url,
        "events": [event.value for event in found.events],
        "description": found.description,
        "enabled": found.is_enabled,
        "disabledReason": found.disabled_reason,
        "created": found.created_at,
        "updated": found.updated_at,
        "links": [
            link(place, "self", "This webhook"),
            link(f"{base}/webhooks/deliveries?webhook={found.endpoint_id}", "deliveries", "What was sent"),
        ],
    }


def _secret(secret: str) -> Response:
    return respond(wire.Secret(secret=secret), headers={"Cache-Control": "no-store"})


def delivery_document(found: records.Delivery, base: str, *, is_whole: bool = True) -> wire.Delivery:
    """A delivery as clients see it; lists leave attempts and body out."""
    log = [
        wire.Attempt(
            number=one.number, at=one.at, durationMilliseconds=one.duration_ms, status=one.status, error=one.error
        )
        for one in found.log
    ]
    return wire.Delivery(
        deliveryID=found.delivery_id,
        jobID=found.job_id,
        webhookID=found.endpoint_id,
        url=found.url,
        type=found.event.value,
        title=found.event.words,
        state=found.state.value,
        reason=found.reason,
        created=found.created_at,
        nextAttempt=found.due_at,
        finished=found.finished_at,
        attemptCount=found.attempts,
        attempts=log if is_whole else None,
        body=found.body if is_whole else None,
        links=_links(found, base),
    )


def _links(found: records.Delivery, base: str) -> list[Link]:
    links = [
        link(f"{base}/webhooks/deliveries/{found.delivery_id}", "self", "This delivery"),
        link(f"{base}/jobs/{found.job_id}", "monitor", "The job"),
    ]
    if found.endpoint_id is not None:
        links.append(link(f"{base}/webhooks/{found.endpoint_id}", "webhook", "The webhook"))
    return links
