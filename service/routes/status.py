"""A job as clients see it: statusInfo of OGC API - Processes 1.0, with the fields of the 2.0 draft beside it."""

from __future__ import annotations

import datetime as dt
from typing import Any
from urllib.parse import quote

from service.jobs import InputReference, Job, JobEvent, JobRequest, JobStatus
from service.problems import failure_document

RELATIONS = "http://www.opengis.net/def/rel/ogc/1.0/"
"""Where the standard keeps its link relations."""


def link(href: str, rel: str, title: str, media_type: str = "application/json") -> dict[str, str]:
    """A link object."""
    return {"href": href, "rel": rel, "type": media_type, "title": title}


def timestamp(at: dt.datetime | None) -> str | None:
    """A time as RFC 3339 in UTC."""
    return None if at is None else at.astimezone(dt.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def status_info(job: Job, base: str, *, with_request: bool = True) -> dict[str, Any]:
    """The statusInfo of a job.

    Parameters
    ----------
    job : Job
        As stored.
    base : str
        The service's own URL.
    with_request : bool
        Whether the request is told; lists leave it out.
    """
    place = f"{base}/jobs/{job.job_id}"
    links = [
        link(place, "self" if with_request else "monitor", "This job"),
        link(f"{place}/events?f=json", f"{RELATIONS}log", "What happened, as a list"),
        link(f"{place}/events?f=sse", "events", "What happens, as a stream", "text/event-stream"),
    ]
    if with_request:
        links.insert(1, link(place, "monitor", "This job"))
    if job.schedule_id is not None:
        links.append(link(f"{base}/schedules/{job.schedule_id}", "schedule", "The schedule that it came of"))
    if job.status is JobStatus.SUCCESSFUL:
        links += [
            link(f"{place}/results", f"{RELATIONS}results", "The results"),
            link(f"{place}/buildings", "items", "The buildings", "application/geo+json"),
        ]
        if job.request.methods and (job.request.outputs is None or "page" in job.request.outputs):
            links.append(link(f"{place}/results/page", "alternate", "The comparison as a page", "text/html"))
    if job.status is JobStatus.FAILED:
        links.append(link(f"{place}/results", f"{RELATIONS}exceptions", "Why it failed", "application/problem+json"))
    info: dict[str, Any] = {
        "jobID": job.job_id,
        "id": job.job_id,
        "processID": job.request.process_id,
        "type": "process",
        "processingEntityType": "ogc-api-processes",
        "status": job.status.value,
        "title": job.request.title,
        "message": job.message or _words(job),
        "stage": job.stage or None,
        "progress": job.progress,
        "created": timestamp(job.created_at),
        "started": timestamp(job.started_at),
        "finished": timestamp(job.finished_at),
        "updated": timestamp(job.updated_at),
        "priority": job.priority or None,
        "scheduleID": job.schedule_id,
        "attempt": job.attempt or None,
        "summary": None if job.summary is None else dict(job.summary),
        "exception": None if job.failure is None else failure_document(job.failure, f"/jobs/{job.job_id}"),
        "request": execute_request(job.request, base, job.priority) if with_request else None,
        "links": links,
    }
    return {name: value for name, value in info.items() if value is not None}


def _words(job: Job) -> str:
    """A sentence where the store has none."""
    if job.status is JobStatus.RUNNING and job.dismiss_requested:
        return "dismissal was requested; the work is being stopped"
    return {
        JobStatus.ACCEPTED: "waiting for a driver",
        JobStatus.RUNNING: "running",
        JobStatus.SUCCESSFUL: "finished",
        JobStatus.FAILED: "failed",
        JobStatus.DISMISSED: "dismissed",
    }[job.status]


def execute_request(request: JobRequest, base: str, priority: int) -> dict[str, Any]:
    """The request that would submit the same job again."""

    def reference(source: InputReference) -> dict[str, str]:
        if source.kind == "upload":
            return {"href": f"{base}/uploads/{source.value}"}
        return {"href": f"file://{quote(source.value)}" if source.kind == "path" else source.value}

    inputs: dict[str, Any] = {
        "tiles": [reference(tile) for tile in request.tiles],
        "footprints": None if request.footprints is None else reference(request.footprints),
        "crs": request.crs,
        "verticalUnit": request.vertical_unit,
        "bbox": None if request.bbox is None else list(request.bbox),
        "methods": list(request.methods) or None,
        "settings": dict(request.settings) or None,
        "meshes": request.meshes,
        "licence": request.licence,
        "title": request.title,
        "priority": priority or None,
    }
    found: dict[str, Any] = {"inputs": {name: value for name, value in inputs.items() if value is not None}}
    if request.outputs is not None:
        found["outputs"] = {name: {} for name in request.outputs}
    return found


def event_data(event: JobEvent) -> dict[str, Any]:
    """An event, as it goes into the stream and the list."""
    told = {"status": event.status.value} if event.status is not None else {}
    return {
        "id": event.sequence,
        "at": timestamp(event.at),
        "kind": event.kind,
        **told,
        "stage": event.stage,
        "done": event.done,
        "total": event.total,
        "progress": event.progress,
        "message": event.message,
    }
