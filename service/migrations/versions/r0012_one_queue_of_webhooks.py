"""One queue of webhooks: each event has a delivery per receiver from the start, and a delivery has its own body.

Revision ID: 0012
Revises: 0011
"""

from __future__ import annotations

import datetime as dt
import json
import uuid

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_TIME = sa.DateTime(timezone=True)
_SECRETS = (("old_secret", sa.String(64)), ("old_until", _TIME))
_PLACES = (("sent_until", _TIME), ("paused_at", _TIME))
_BODIES = ("base", "body")


def upgrade() -> None:
    """Put in line what waited for room or for a replay, give each delivery its event and its body."""
    connection = op.get_bind()
    now = dt.datetime.now(dt.UTC)
    if connection.dialect.name == "sqlite":
        now = now.replace(tzinfo=None)
    # deliveries that are older than the table of events
    op.execute(
        "INSERT INTO webhook_events (event_id, job_id, owner, event, at, snapshot) "
        "SELECT delivery_id, job_id, owner, event, created_at, snapshot FROM webhook_deliveries WHERE event_id IS NULL"
    )
    op.execute("UPDATE webhook_deliveries SET event_id = delivery_id WHERE event_id IS NULL")
    op.execute(
        "UPDATE webhook_deliveries SET body = (SELECT e.body FROM webhook_events e "
        "WHERE e.event_id = webhook_deliveries.event_id AND e.base = webhook_deliveries.base) "
        "WHERE body IS NULL AND attempts > 0 AND endpoint_id IS NOT NULL"
    )
    metadata = sa.MetaData()
    names = ("webhooks", "webhook_events", "webhook_deliveries")
    hooks, events, deliveries = (sa.Table(name, metadata, autoload_with=connection) for name in names)
    waits = {"state": "waiting", "due_at": now, "tried_since": now}
    again = sa.update(deliveries).where(deliveries.c.replay_at.is_not(None))
    connection.execute(again.values(**waits, finished_at=None, reason="replayed", lease_owner=None, lease_until=None))
    for hook in connection.execute(sa.select(hooks).where(hooks.c.is_enabled)).all():
        listed = json.loads(hook.events) if isinstance(hook.events, str) else hook.events
        given = sa.exists().where(
            deliveries.c.event_id == events.c.event_id, deliveries.c.endpoint_id == hook.endpoint_id
        )
        wanted = [event for event in listed if event != "job.progress"]
        missing = sa.select(events).where(events.c.at > hook.sent_until, events.c.event.in_(wanted), ~given)
        to = {"endpoint_id": hook.endpoint_id, "url": hook.url, "base": hook.base, "attempts": 0}
        rows = [
            {**to, **waits, "delivery_id": uuid.uuid4().hex, "created_at": event.at, "snapshot": None}
            | {name: getattr(event, name) for name in ("event_id", "job_id", "owner", "event")}
            for event in connection.execute(missing).all()
        ]
        if rows:
            connection.execute(sa.insert(deliveries), rows)
    op.drop_index("webhook_deliveries_by_replay", "webhook_deliveries")
    for name in ("snapshot", "replay_at"):
        op.drop_column("webhook_deliveries", name)
    for name in _BODIES:
        op.drop_column("webhook_events", name)
    for name in ("is_behind", *(name for name, _ in (*_PLACES, *_SECRETS))):
        op.drop_column("webhooks", name)
    for name, _ in _SECRETS:
        op.drop_column("webhook_secrets", name)
