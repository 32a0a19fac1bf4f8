"""The answers of routes, declared for the OpenAPI document."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from pydantic import BaseModel

from service.problems import MEDIA_TYPE
from service.wire.execute import EXAMPLE as EXECUTE_EXAMPLE
from service.wire.jobs import StatusInfo
from service.wire.problems import Problem

REQUIRED = "x-required"
"""Marks the schema of a parameter that must be there although the route itself refuses its absence."""

JOB_ID = "3f2a9c0d5e6b47189a0b1c2d3e4f5a6b"
"""The job of the examples."""


def reference(model: type[BaseModel]) -> dict[str, str]:
    """A reference to the schema of a model, for media types other than JSON."""
    return {"$ref": f"#/components/schemas/{model.__name__}"}


def header(name: str, description: str) -> dict[str, Any]:
    """A header of an answer."""
    return {name: {"description": description, "schema": {"type": "string"}}}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Problem documents as answers of a path, by status."""
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {MEDIA_TYPE: {"schema": reference(Problem)}},
        }
        for status in statuses
    }


def document(model: type[BaseModel], description: str, example: Any, **more: Any) -> dict[str, Any]:
    """An answer with a document."""
    return {
        "model": model,
        "description": description,
        "content": {"application/json": {"example": example}},
        **more,
    }


FEATURE_EXAMPLE: dict[str, Any] = {
    "type": "Feature",
    "id": "3givd2mvtyerfjxv2yytjbmi",
    "geometry": {
        "type": "Polygon",
        "coordinates": [[[9.9967, 53.5603], [9.9968, 53.5602], [9.9969, 53.5603], [9.9967, 53.5603]]],
    },
    "properties": {
        "building_id": "3givd2mvtyerfjxv2yytjbmi",
        "status": "ok",
        "reason": None,
        "roof_type": "gable",
        "height_m": 7.618,
        "volume_m3": 965.377,
        "tile": "x5660_y59350",
    },
}
"""A building."""

STATUS_EXAMPLE = {
    "jobID": JOB_ID,
    "id": JOB_ID,
    "type": "process",
    "processingEntityType": "ogc-api-processes",
    "processID": "reconstruct",
    "status": "running",
    "message": "12 of 180 candidates",
    "stage": "reconstruct",
    "progress": 41,
    "created": "2026-03-01T09:30:00.000Z",
    "started": "2026-03-01T09:30:01.000Z",
    "updated": "2026-03-01T09:30:20.000Z",
    "links": [{"href": f"http://127.0.0.1:8000/jobs/{JOB_ID}", "rel": "self", "type": "application/json"}],
}

JOB_MADE = document(
    StatusInfo,
    "The job waits for a driver.",
    STATUS_EXAMPLE | {"status": "accepted", "progress": 0, "message": "waiting for a driver"},
    headers=header("Location", "The job."),
)
"""The answer to a job's submission."""

SCHEDULE_ID = "6b5a4f3e2d1c0b9a87416b5e0d9c2a3f"
"""The schedule of the examples."""

SCHEDULE_REQUEST_EXAMPLE = {
    "title": "every night",
    "cron": "30 2 * * *",
    "timeZone": "Europe/Amsterdam",
    "execute": EXECUTE_EXAMPLE,
}

SCHEDULE_RUN_EXAMPLE = {
    "number": 17,
    "trigger": "clock",
    "outcome": "submitted",
    "slot": "2026-03-01T01:30:00.000Z",
    "slots": 1,
    "jobID": JOB_ID,
    "at": "2026-03-01T01:30:00.412Z",
    "message": "on time",
    "links": [{"href": f"http://127.0.0.1:8000/jobs/{JOB_ID}", "rel": "monitor", "type": "application/json"}],
}

SCHEDULE_EXAMPLE = {
    **SCHEDULE_REQUEST_EXAMPLE,
    "scheduleID": SCHEDULE_ID,
    "version": 1,
    "state": "active",
    "missed": "run-latest",
    "graceSeconds": 300.0,
    "overlap": "skip",
    "processID": "reconstruct",
    "created": "2026-02-01T09:30:00.000Z",
    "updated": "2026-02-01T09:30:00.000Z",
    "nextTimes": ["2026-03-02T02:30:00+01:00", "2026-03-03T02:30:00+01:00"],
    "lastRun": SCHEDULE_RUN_EXAMPLE,
    "counts": {"submitted": 16, "skipped": 1, "missed": 0, "failed": 0},
    "links": [{"href": f"http://127.0.0.1:8000/schedules/{SCHEDULE_ID}", "rel": "self", "type": "application/json"}],
}
