"""The log of a job: what its driver and its run said, in pages, as JSON or as plain lines."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response

from service.jobs import LogLevel, LogLine
from service.routes.answers import document, header, problems
from service.routes.bound import Base, Reader, Store
from service.routes.jobs import JobId
from service.routes.negotiation import preferred
from service.wire.base import Link, link, respond
from service.wire.jobs import JobLog, JobLogLine
from service.wire.queries import LogQuery

router = APIRouter(tags=["jobs"])

REPRESENTATIONS: Mapping[str, str] = {"application/json": "json", "text/plain": "text"}
"""Media types of the log with their names in the parameter f; the first one wins among equals."""

_EXAMPLE = {
    "lines": [
        {
            "number": 17,
            "at": "2026-03-01T09:30:20.000Z",
            "level": "warning",
            "attempt": 1,
            "stage": "reconstruct",
            "message": "failed: timed_out: more than 600 s",
            "facts": {"building": "3givd2mvtyerfjxv2yytjbmi", "tile": "x5660_y59350", "reason": "timed_out"},
        }
    ],
    "links": [],
}
_PAGE = document(
    JobLog,
    "A page of the log, oldest line first.",
    _EXAMPLE,
    headers=header("Link", "The links of the page, if it has plain lines."),
)
_PAGE["content"]["text/plain"] = {"schema": {"type": "string"}}


@router.get("/jobs/{jobID}/log", summary="Log of a job", responses={200: _PAGE, **problems(404, 406)})
def log(
    request: Request, job_id: JobId, base: Base, store: Store, caller: Reader, query: Annotated[LogQuery, Query()]
) -> Response:
    """What the driver and the run said about a job, also while it runs: by default the newest lines.

    The link `prev` leads to the lines before them, `next` to those after them, which may come later. The log goes with
    its job; the newest 2000 lines are kept.
    """
    found = store.get(job_id, owner=caller.owner)
    level = LogLevel(query.level)
    lines = store.log(found.job_id, after=query.after, before=query.before, level=level, limit=query.limit)
    chosen = query.f or REPRESENTATIONS[preferred(request.headers.get("accept"), list(REPRESENTATIONS))]
    links = _links(f"{base}/jobs/{job_id}/log", query, lines)
    headers = {"Cache-Control": "no-store", "Vary": "Accept"}
    if chosen == "json":
        return respond(JobLog(lines=[_document(line) for line in lines], links=links), headers=headers)
    headers["Link"] = ", ".join(f'<{entry.href}>; rel="{entry.rel}"' for entry in links)
    return Response("".join(f"{plain(line)}\n" for line in lines), media_type="text/plain", headers=headers)


def _links(place: str, query: LogQuery, lines: list[LogLine]) -> list[Link]:
    """The links to this page and its neighbours."""

    def at(rel: str, title: str, *, after: int = 0, before: int | None = None) -> Link:
        given = {"f": query.f, "level": query.level, "limit": query.limit, "after": after or None, "before": before}
        return link(f"{place}?{urlencode({n: v for n, v in given.items() if v is not None})}", rel, title)

    links = [at("self", "These lines", after=query.after, before=query.before)]
    if lines and lines[0].number > 1:
        links.append(at("prev", "The lines before them", before=lines[0].number))
    newest = lines[-1].number if lines else query.after
    if newest:
        links.append(at("next", "The lines after them", after=newest))
    return links


def _document(line: LogLine) -> JobLogLine:
    return JobLogLine(
        number=line.number,
        at=line.at,
        level=line.level.value,
        attempt=line.attempt,
        stage=line.stage,
        message=line.message,
        facts=dict(line.facts),
    )


def plain(line: LogLine) -> str:
    """A line for people.

    >>> at = dt.datetime(2026, 3, 1, 9, 30, tzinfo=dt.UTC)
    >>> facts = {"done": 12, "seconds": 1.5}
    >>> plain(LogLine(number=1, at=at, level=LogLevel.INFO, attempt=1, stage="split", message="done", facts=facts))
    '2026-03-01T09:30:00.000Z INFO attempt 1, split: done [done 12, seconds 1.5]'
    """
    at = line.at.astimezone(dt.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    where = ", ".join(filter(None, [f"attempt {line.attempt}" if line.attempt else "", line.stage]))
    facts = ", ".join(f"{name} {value}" for name, value in line.facts.items())
    text = f"{where}: {line.message}" if where else line.message
    # one line each, whatever a message holds
    return " ".join(f"{at} {line.level.upper()} {text}{f' [{facts}]' if facts else ''}".split())
