"""Liveness, readiness and metrics."""

from __future__ import annotations

import os
import tempfile

from fastapi import APIRouter, Request
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.errors import StoreError
from service.files import StateFolder
from service.metrics import Metrics
from service.routes.answers import document
from service.routes.bound import Folder, Reader, Store
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


_READY = {"status": "ok", "checks": {"database": "ok", "state": "ok", "driver": "running"}}


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
    """Check whether the database answers and the state folder can be written.

    The driver is listed but does not count: without a driver jobs are still accepted, and wait.
    """
    checks = {"database": _database(store), "state": _state(folder)}
    is_ready = all(found == "ok" for found in checks.values())
    driver = getattr(request.app.state, "driver", None)
    checks["driver"] = "elsewhere" if driver is None else driver()
    return respond(
        Health(status="ok" if is_ready else "unavailable", checks=checks),
        status_code=200 if is_ready else 503,
        headers={"Cache-Control": "no-store"},
    )


def _database(store: JobStore) -> str:
    try:
        store.check()
    except StoreError:
        return "does not answer, or is not migrated"
    return "ok"


def _state(folder: StateFolder) -> str:
    try:
        handle, name = tempfile.mkstemp(prefix=".ready-", dir=folder.root)
        os.close(handle)
        os.unlink(name)  # noqa: PTH108 - mkstemp gives a text
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
def metrics(request: Request, caller: Reader) -> Response:
    """Requests, durations and jobs by status, in the text format of Prometheus."""
    del caller
    metrics_: Metrics = request.app.state.metrics
    return Response(metrics_.render(), headers={"Content-Type": CONTENT_TYPE_LATEST})
