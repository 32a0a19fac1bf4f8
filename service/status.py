"""From the records of a job to the documents that clients and receivers of webhooks see."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any
from urllib.parse import quote

from starlette.responses import Response

from pipeline.options import served
from service.jobs import InputReference, Job, JobEvent, JobRequest, JobStatus, Subscriber
from service.outputs import KINDS, Catalogue
from service.problems import failure_document
from service.wire.base import RELATIONS, Link, link, respond
from service.wire.execute import Execute, SubscriberUris, wanted
from service.wire.jobs import Event, StatusInfo
from service.wire.results import OutputFile, Results


def status_info(job: Job, base: str, *, with_request: bool = True) -> StatusInfo:
    """The statusInfo of a job; lists leave the request out."""
    return StatusInfo(
        jobID=job.job_id,
        id=job.job_id,
        processID=job.request.process_id,
        type="process",
        processingEntityType="ogc-api-processes",
        status=job.status.value,
        title=job.request.title,
        message=job.message or _words(job),
        stage=job.stage or None,
        progress=job.progress,
        created=job.created_at,
        started=job.started_at,
        finished=job.finished_at,
        updated=job.updated_at,
        priority=job.priority or None,
        scheduleID=job.schedule_id,
        attempt=job.attempt or None,
        keep=job.keep,
        summary=None if job.summary is None else dict(job.summary),
        exception=None if job.failure is None else failure_document(job.failure, f"/jobs/{job.job_id}"),
        request=execute_request(job.request, base, job.priority) if with_request else None,
        links=_links(job, base, with_request=with_request),
    )


def job_made(job: Job, base: str, headers: Mapping[str, str] | None = None) -> Response:
    """The answer to a request that made a job."""
    location = {"Location": f"{base}/jobs/{job.job_id}"}
    return respond(status_info(job, base), status_code=201, headers={**location, **(headers or {})})


def _links(job: Job, base: str, *, with_request: bool) -> list[Link]:
    place = f"{base}/jobs/{job.job_id}"
    links = [
        link(place, "self" if with_request else "monitor", "This job"),
        link(f"{place}/log", f"{RELATIONS}log", "Its log"),
        link(f"{place}/events?f=json", "events", "Its events as a list"),
        link(f"{place}/events?f=sse", "events", "Its events as a stream", "text/event-stream"),
    ]
    if with_request:
        links.insert(1, link(place, "monitor", "This job"))
    if job.schedule_id is not None:
        links.append(link(f"{base}/schedules/{job.schedule_id}", "schedule", "The schedule that made it"))
    if job.status is JobStatus.RUNNING and job.request.process_id == "reconstruct":
        links.append(link(f"{place}/buildings", "items", "The buildings so far", "application/geo+json"))
    if job.status is JobStatus.SUCCESSFUL:
        links.append(link(f"{place}/results", f"{RELATIONS}results", "The results"))
        if job.request.has_buildings:
            links.append(link(f"{place}/buildings", "items", "The buildings", "application/geo+json"))
        if job.request.methods and (job.request.outputs is None or "page" in job.request.outputs):
            links.append(link(f"{place}/results/page", "alternate", "The comparison as a page", "text/html"))
    if job.status is JobStatus.FAILED:
        links.append(link(f"{place}/results", f"{RELATIONS}exceptions", "Why it failed", "application/problem+json"))
    return links


def _words(job: Job) -> str:
    """The message of a job that has none in the store."""
    if job.status is JobStatus.RUNNING and job.dismiss_requested:
        return "dismissal was requested; the work is being stopped"
    return {
        JobStatus.ACCEPTED: "waiting for a driver",
        JobStatus.RUNNING: "running",
        JobStatus.SUCCESSFUL: "finished",
        JobStatus.FAILED: "failed",
        JobStatus.DISMISSED: "dismissed",
    }[job.status]


def execute_request(request: JobRequest, base: str, priority: int) -> Execute:
    """The request that would submit the same job again."""

    def reference(source: InputReference) -> dict[str, str]:
        if source.kind == "upload":
            return {"href": f"{base}/uploads/{source.value}"}
        return {"href": f"file://{quote(source.value)}" if source.kind == "path" else source.value}

    inputs: dict[str, Any] = {
        **(request.echo or {}),
        "tiles": [reference(tile) for tile in request.tiles] or None,
        "footprints": None if request.footprints is None else reference(request.footprints),
        "guides": None if request.guides is None else reference(request.guides),
        **{one.input: _sent(getattr(request, one.name)) for one in served(request.process_id) if not one.is_setting},
        "methods": list(request.methods) or None,
        "settings": dict(request.settings) or None,
        "rasterCell": request.raster_cell,
        "publish": list(request.publish) or None,
        "geoidHeight": request.geoid_height,
        "title": request.title,
        "priority": priority or None,
    }
    return Execute(
        inputs={name: value for name, value in inputs.items() if value is not None},
        outputs=None if request.outputs is None else wanted(request.outputs),
        response="raw" if request.response == "raw" else "document",
        subscriber=None if request.subscriber is None else _uris(request.subscriber),
    )


def _sent(value: Any) -> Any:
    """The value of an option as an input; None for a permission that is not given."""
    return list(value) if isinstance(value, tuple) else value or None


def _uris(subscriber: Subscriber) -> SubscriberUris:
    return SubscriberUris(
        successUri=subscriber.success_uri, inProgressUri=subscriber.in_progress_uri, failedUri=subscriber.failed_uri
    )


def results_document(
    catalogue: Catalogue, place: Callable[[str], str], wanted_outputs: Collection[str] = ()
) -> Results:
    """The document that lists the outputs of a job.

    Parameters
    ----------
    catalogue : Catalogue
        The outputs.
    place : callable
        The URL of an output, by its id.
    wanted_outputs : collection of str
        Only these; all if it is empty.
    """
    return Results(
        {
            name: OutputFile(
                href=place(name),
                rel="item",
                type=KINDS[name].media_type,
                title=KINDS[name].title,
                bytes=entry.size_bytes,
                sha256=entry.sha256,
            )
            for name, entry in catalogue.outputs.items()
            if not wanted_outputs or name in wanted_outputs
        }
    )


def event_document(event: JobEvent) -> Event:
    """An event in the stream and the list."""
    return Event(
        id=event.sequence,
        at=event.at,
        kind=event.kind,
        status=None if event.status is None else event.status.value,
        stage=event.stage,
        done=event.done,
        total=event.total,
        progress=event.progress,
        message=event.message,
    )
