"""What the OpenAPI document says about answers: schemas of the documents, and which problems a path can give."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from service.problems import MEDIA_TYPE

JOB_ID = "3f2a9c0d5e6b47189a0b1c2d3e4f5a6b"
"""The job of the examples."""


def reference(name: str) -> dict[str, str]:
    """A schema of the document."""
    return {"$ref": f"#/components/schemas/{name}"}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Problem documents as answers of a path, by status."""
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {MEDIA_TYPE: {"schema": reference("Problem")}},
        }
        for status in statuses
    }


def document(
    schema: str, description: str, example: Any = None, media_type: str = "application/json", **more: Any
) -> dict[str, Any]:
    """An answer with a document."""
    content: dict[str, Any] = {"schema": reference(schema)}
    if example is not None:
        content["example"] = example
    return {"description": description, "content": {media_type: content}, **more}


_TEXT = {"type": "string"}
_TIME = {"type": "string", "format": "date-time"}
_LINKS = {"type": "array", "items": reference("Link")}


def _object(required: tuple[str, ...], **properties: Any) -> dict[str, Any]:
    return {"type": "object", "required": list(required), "properties": properties}


_SCHEDULE_FIELDS: Mapping[str, dict[str, Any]] = {
    "title": {**_TEXT, "nullable": True, "maxLength": 500, "description": "Also of its jobs that have none."},
    "cron": {
        **_TEXT,
        "maxLength": 200,
        "description": "Minute, hour, day of the month, month, day of the week, as in Debian's cron; or @hourly, "
        "@daily, @weekly, @monthly, @yearly.",
        "example": "30 2 * * *",
    },
    "timeZone": {**_TEXT, "description": "A name of the IANA database. Default UTC.", "example": "Europe/Amsterdam"},
    "missed": {
        "type": "string",
        "enum": ["run-latest", "skip"],
        "description": "What becomes of slots that no driver saw in time: the latest is run once, or none is. All "
        "others are told as missed. Default run-latest.",
    },
    "graceSeconds": {
        "type": "number",
        "minimum": 0,
        "maximum": 2_592_000,
        "description": "How late a slot may be seen and still count as seen in time. Default 300.",
    },
    "overlap": {
        "type": "string",
        "enum": ["skip", "wait"],
        "description": "What becomes of a slot that comes while a job of the schedule is under way: it is told as "
        "skipped, or waits until that job is over, or until a later slot takes its place. Default skip.",
    },
    "processID": {"type": "string", "enum": ["reconstruct", "compare"], "description": "Default reconstruct."},
    "execute": {**reference("Execute")},
    "paused": {"type": "boolean", "description": "Whether the clock is left alone. Default false."},
}
"""What a client may say of a schedule."""

SCHEMAS: Mapping[str, dict[str, Any]] = {
    "Link": _object(("href", "rel"), href=_TEXT, rel=_TEXT, type=_TEXT, title=_TEXT),
    "Problem": _object(
        ("type", "title", "status", "detail", "instance"),
        type={**_TEXT, "description": "URI of the kind of problem."},
        title={**_TEXT, "description": "The same for every problem of this kind."},
        status={"type": "integer"},
        detail={**_TEXT, "description": "What happened, with the value and the fix."},
        instance={**_TEXT, "description": "The path that was asked."},
        errors={"type": "array", "items": _TEXT, "description": "Every fault, where there can be several."},
        jobID={**_TEXT, "description": "Of `schedule-busy`: the job that is under way."},
    ),
    "LandingPage": _object(("title", "links"), title=_TEXT, description=_TEXT, links=_LINKS),
    "Conformance": _object(("conformsTo",), conformsTo={"type": "array", "items": {"type": "string", "format": "uri"}}),
    "ProcessSummary": _object(
        ("id", "version"),
        id=_TEXT,
        version=_TEXT,
        title=_TEXT,
        description=_TEXT,
        keywords={"type": "array", "items": _TEXT},
        jobControlOptions={
            "type": "array",
            "items": {"type": "string", "enum": ["sync-execute", "async-execute", "dismiss"]},
        },
        outputTransmission={"type": "array", "items": {"type": "string", "enum": ["value", "reference"]}},
        links=_LINKS,
    ),
    "ProcessList": _object(
        ("processes", "links"), processes={"type": "array", "items": reference("ProcessSummary")}, links=_LINKS
    ),
    "Process": {
        "allOf": [
            reference("ProcessSummary"),
            _object(
                ("inputs", "outputs"),
                inputs={"type": "object", "additionalProperties": reference("InputDescription")},
                outputs={"type": "object", "additionalProperties": reference("OutputDescription")},
            ),
        ]
    },
    "InputDescription": _object(
        ("schema",),
        title=_TEXT,
        description=_TEXT,
        schema={"type": "object"},
        minOccurs={"type": "integer"},
        maxOccurs={"oneOf": [{"type": "integer"}, {"type": "string", "enum": ["unbounded"]}]},
        valuePassing={"type": "array", "items": {"type": "string", "enum": ["byValue", "byReference"]}},
    ),
    "OutputDescription": _object(("schema",), title=_TEXT, description=_TEXT, schema={"type": "object"}),
    "Execute": _object(
        (),
        inputs={
            "type": "object",
            "description": "By the names that the process's description lists; each a value, a reference "
            "`{href}`, a value with a media type `{value, encoding, mediaType}`, or a list of these.",
        },
        outputs={
            "type": "object",
            "description": "The outputs that are wanted; without it all.",
            "additionalProperties": {"type": "object"},
        },
        response={"type": "string", "enum": ["raw", "document"]},
    ),
    "StatusInfo": _object(
        ("jobID", "id", "type", "processID", "status", "progress", "created", "updated", "links"),
        jobID=_TEXT,
        id=_TEXT,
        type={"type": "string", "enum": ["process"]},
        processingEntityType={"type": "string", "enum": ["ogc-api-processes"]},
        processID=_TEXT,
        status={"type": "string", "enum": ["accepted", "running", "successful", "failed", "dismissed"]},
        title=_TEXT,
        message=_TEXT,
        stage=_TEXT,
        progress={"type": "integer", "minimum": 0, "maximum": 100},
        created=_TIME,
        started=_TIME,
        finished=_TIME,
        updated=_TIME,
        priority={"type": "integer"},
        scheduleID={**_TEXT, "description": "The schedule that it came of; it may be gone."},
        attempt={"type": "integer"},
        summary={"type": "object"},
        exception=reference("Problem"),
        request=reference("Execute"),
        links=_LINKS,
    ),
    "JobList": _object(("jobs", "links"), jobs={"type": "array", "items": reference("StatusInfo")}, links=_LINKS),
    "Event": _object(
        ("id", "at", "kind", "progress"),
        id={"type": "integer"},
        at=_TIME,
        kind={"type": "string", "enum": ["status", "stage", "progress", "warning", "waiting"]},
        status={"type": "string", "enum": ["accepted", "running", "successful", "failed", "dismissed"]},
        stage=_TEXT,
        done={"type": "integer"},
        total={"type": "integer"},
        progress={"type": "integer", "minimum": 0, "maximum": 100},
        message=_TEXT,
    ),
    "EventList": _object(("events", "links"), events={"type": "array", "items": reference("Event")}, links=_LINKS),
    "ServerSentEvent": {
        **_object(
            (),
            event={**_TEXT, "description": "The event's kind."},
            data={**_TEXT, "description": "The event, as JSON."},
            id={**_TEXT, "description": "The event's id, for Last-Event-ID."},
            retry={"type": "integer", "minimum": 0, "description": "Milliseconds until a client comes again."},
        ),
        "description": "One event of the stream.",
    },
    "JobForm": _object(
        ("tile",),
        tile={
            "type": "array",
            "items": {"type": "string", "format": "binary"},
            "minItems": 1,
            "description": "A point cloud; once or more. A field without a file name holds an href.",
        },
        footprints={"type": "string", "format": "binary", "description": "Building outlines; likewise."},
        crs=_TEXT,
        verticalUnit=_TEXT,
        bbox={**_TEXT, "description": "x_min,y_min,x_max,y_max in the tiles' CRS."},
        method=_TEXT,
        preset={**_TEXT, "description": "Where the method's settings start."},
        lods={**_TEXT, "description": "Levels of detail with commas between them: 1.2, 1.3, 2.2."},
        methods={
            "type": "array",
            "items": _TEXT,
            "description": "Makes the job a comparison of these, each METHOD or METHOD:PRESET, in the place of "
            "method and preset: the field several times, or with commas.",
        },
        classes=_TEXT,
        settings={**_TEXT, "description": "JSON."},
        meshes=_TEXT,
        licence=_TEXT,
        title=_TEXT,
        priority={"type": "integer"},
        outputs={**_TEXT, "description": "Ids of the outputs that are wanted, with commas between them."},
    ),
    "Preflight": _object(
        ("kind", "format", "usable", "problems", "warnings"),
        kind={"type": "string", "enum": ["points", "footprints"]},
        format={"type": "string", "enum": ["las", "laz", "copc", "ply", "ascii", "geopackage", "geojson"]},
        usable={"type": "boolean", "description": "Whether a job can use it without being told more."},
        problems={"type": "array", "items": _TEXT, "description": "What a job can heal, such as degrees by `crs`."},
        warnings={"type": "array", "items": _TEXT},
        crs={
            "type": "object",
            "nullable": True,
            "properties": {"name": _TEXT, "epsg": {"type": "integer", "nullable": True}},
            "description": "Null where the file tells none.",
        },
        pointCount={"type": "integer", "description": "Of text that was not read through the number of lines."},
        horizontalUnitM={"type": "number", "nullable": True},
        verticalUnitM={"type": "number", "nullable": True},
        bounds={
            "type": "array",
            "nullable": True,
            "items": {"type": "number"},
            "description": "x_min, y_min, z_min, x_max, y_max, z_max in the units of the CRS.",
        },
        densityPerM2={"type": "number", "nullable": True},
        hasReturns={"type": "boolean", "nullable": True},
        hasClasses={"type": "boolean", "nullable": True},
        acquiredFrom={"type": "string", "nullable": True},
        acquiredTo={"type": "string", "nullable": True},
        featureCount={"type": "integer", "nullable": True},
        layers={"type": "array", "nullable": True, "items": _TEXT},
    ),
    "Upload": _object(
        ("uploadID", "filename", "bytes", "sha256", "created", "expires", "preflight", "links"),
        uploadID=_TEXT,
        filename={**_TEXT, "description": "As it was cleaned."},
        bytes={"type": "integer", "minimum": 1},
        sha256={**_TEXT, "pattern": "^[0-9a-f]{64}$"},
        created=_TIME,
        expires=_TIME,
        preflight=reference("Preflight"),
        links=_LINKS,
    ),
    "UploadList": _object(("uploads", "links"), uploads={"type": "array", "items": reference("Upload")}, links=_LINKS),
    "ScheduleRequest": {**_object(("cron", "execute"), **_SCHEDULE_FIELDS), "additionalProperties": False},
    "SchedulePatch": {**_object((), **_SCHEDULE_FIELDS), "additionalProperties": False, "minProperties": 1},
    "ScheduleRun": _object(
        ("number", "trigger", "outcome", "slots", "at", "message", "links"),
        number={"type": "integer", "minimum": 1, "description": "Counts up within the schedule."},
        trigger={"type": "string", "enum": ["clock", "hand"]},
        outcome={"type": "string", "enum": ["submitted", "waiting", "skipped", "missed", "failed"]},
        slot={**_TIME, "description": "When it was due, of several that were missed together the last one."},
        firstSlot={**_TIME, "description": "The first of several that were missed together."},
        slots={"type": "integer", "minimum": 1, "description": "How many they are."},
        moreSlots={"type": "boolean", "description": "Whether they are more than that: they were not all counted."},
        jobID={**_TEXT, "description": "The job that was made, or the one that was under way."},
        at={**_TIME, "description": "When this was decided."},
        message=_TEXT,
        links=_LINKS,
    ),
    "ScheduleRunList": _object(
        ("runs", "links"), runs={"type": "array", "items": reference("ScheduleRun")}, links=_LINKS
    ),
    "Schedule": _object(
        ("scheduleID", "version", "state", "cron", "timeZone", "processID", "nextTimes", "counts", "links"),
        scheduleID=_TEXT,
        version={"type": "integer", "minimum": 1, "description": "Counts the client's changes; the ETag."},
        state={"type": "string", "enum": ["active", "paused"]},
        created=_TIME,
        updated=_TIME,
        nextTimes={
            "type": "array",
            "items": _TIME,
            "description": "Times to come, with the offset that the zone has then; none while it is paused.",
        },
        waiting={**_TIME, "description": "The slot that waits for a job to end."},
        lastRun=reference("ScheduleRun"),
        counts={
            "type": "object",
            "additionalProperties": {"type": "integer", "minimum": 0},
            "description": "Slots and runs by hand since the schedule was made: submitted, skipped, missed, failed.",
        },
        links=_LINKS,
        **{name: schema for name, schema in _SCHEDULE_FIELDS.items() if name != "paused"},
    ),
    "ScheduleList": _object(
        ("schedules", "links"), schedules={"type": "array", "items": reference("Schedule")}, links=_LINKS
    ),
    "Health": _object(
        ("status",),
        status={"type": "string", "enum": ["ok", "unavailable"]},
        checks={"type": "object", "additionalProperties": _TEXT},
    ),
}
"""Schemas that several paths share, by name."""

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

EXECUTE_EXAMPLE = {
    "inputs": {
        "tiles": [{"href": "/uploads/0123456789abcdef0123456789abcdef"}],
        "crs": "EPSG:28992",
        "settings": {"candidates": {"min_area_m2": 15.0}},
    },
    "outputs": {"buildings": {}, "cityjson": {}},
}

JOB_MADE = document(
    "StatusInfo",
    "The job waits for a driver.",
    STATUS_EXAMPLE | {"status": "accepted", "progress": 0, "message": "waits for a driver"},
    headers={"Location": {"description": "The job.", "schema": {"type": "string"}}},
)
"""What both ways to submit a job answer."""

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
    "message": "in time",
    "links": [{"href": f"http://127.0.0.1:8000/jobs/{JOB_ID}", "rel": "monitor", "type": "application/json"}],
}

SCHEDULE_EXAMPLE = {
    "scheduleID": SCHEDULE_ID,
    "version": 1,
    "title": "every night",
    "state": "active",
    "cron": "30 2 * * *",
    "timeZone": "Europe/Amsterdam",
    "missed": "run-latest",
    "graceSeconds": 300.0,
    "overlap": "skip",
    "processID": "reconstruct",
    "execute": EXECUTE_EXAMPLE,
    "created": "2026-02-01T09:30:00.000Z",
    "updated": "2026-02-01T09:30:00.000Z",
    "nextTimes": ["2026-03-02T02:30:00+01:00", "2026-03-03T02:30:00+01:00"],
    "lastRun": SCHEDULE_RUN_EXAMPLE,
    "counts": {"submitted": 16, "skipped": 1, "missed": 0, "failed": 0},
    "links": [{"href": f"http://127.0.0.1:8000/schedules/{SCHEDULE_ID}", "rel": "self", "type": "application/json"}],
}
