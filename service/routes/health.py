"""Liveness, readiness and metrics."""

from __future__ import annotations

import tempfile
from typing import Literal

from fastapi import APIRouter, Request
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.errors import StoreError, StoreNewerError
from service.files import StateFolder
from service.metrics import Metrics
from service.routes.answers import document
from service.routes.bound import Admin, Folder, Store
from service.store import JobStore
from service.wire.base import respond
from service.wire.landing import Health

router = APIRouter(tags=["service"])


@router.get(
    "/healthz",
    summary="Whether the process is alive",
    responses={200: document(Health, "The process is alive.", {"status": "ok"})},
)
async def healthz() -> Response:
    """Say that the process answers; nothing else is checked."""
    return respond(Health(status="ok"))


_READY = {
    "status": "ok",
    "checks": {"database": "ok", "state": "ok", "disk": "ok", "driver": "running", "slots": "ok"},
}
_PROBE_BYTES = 4096
"""Bytes that are written to see whether the disk is full: one block, since a file without bytes needs none."""


@router.get(
    "/readyz",
    summary="Whether the service can work",
    responses={
        200: document(Health, "The service can work.", _READY),
        503: document(
            Health,
            "The service cannot work now.",
            {"status": "unavailable", "checks": {"database": "does not answer"}},
        ),
    },
)
def readyz(request: Request, store: Store, folder: Folder) -> Response:
    """Check whether the database answers, the state folder can be written, and the reserve of its disk is free.

    The driver is listed but does not count: without a driver jobs are still accepted, and wait. Slots are listed, too:
    how many running jobs make no progress, until the driver ends their processes. With less than the
    reserve free, the status is `degraded`, with 200: uploads and jobs are refused with 507, but results can be fetched
    and removed, which is how room is made.
    """
    checks = {"database": _database(store), "state": _state(folder)}
    is_ready = all(found == "ok" for found in checks.values())
    checks["disk"] = disk = _disk(folder)
    driver = getattr(request.app.state, "driver", None)
    checks["driver"] = "elsewhere" if driver is None else driver()
    checks["slots"] = _slots(store)
    status: Literal["ok", "degraded", "unavailable"] = "ok" if disk == "ok" else "degraded"
    return respond(
        Health(status=status if is_ready else "unavailable", checks=checks),
        status_code=200 if is_ready else 503,
        headers={"Cache-Control": "no-store"},
    )


def _disk(folder: StateFolder) -> str:
    try:
        free_bytes = folder.disk.free_bytes
    except OSError as error:
        return error.strerror or "cannot be read"
    if free_bytes >= folder.reserve_bytes:
        return "ok"
    return f"{free_bytes} bytes are free, the reserve is {folder.reserve_bytes}: uploads and jobs are refused"


def _database(store: JobStore) -> str:
    try:
        store.check()
    except StoreNewerError:
        return "is of a newer version, to which this process must be updated"
    except StoreError:
        return "does not answer, or is not migrated"
    return "ok"


def _slots(store: JobStore) -> str:
    try:
        stalled = len(store.stalled())
    except StoreError:
        return "not known: the database does not answer"
    return "ok" if stalled == 0 else f"{stalled} running {'job makes' if stalled == 1 else 'jobs make'} no progress"


def _state(folder: StateFolder) -> str:
    try:
        with tempfile.NamedTemporaryFile(prefix=".ready-", dir=folder.root, buffering=0) as probe:
            probe.write(bytes(_PROBE_BYTES))
    except OSError as error:
        return error.strerror or "cannot be written"
    return "ok"


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=Response,
    responses={
        200: {
            "description": "The metrics.",
            "content": {
                "text/plain": {"schema": {"type": "string"}, "example": 'gablework_jobs{status="running"} 1.0'}
            },
        }
    },
)
def metrics(request: Request, caller: Admin) -> Response:
    """Requests, durations and jobs by status, in the text format of Prometheus."""
    del caller
    metrics_: Metrics = request.app.state.metrics
    return Response(metrics_.render(), headers={"Content-Type": CONTENT_TYPE_LATEST})
