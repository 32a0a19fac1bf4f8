"""Exceptions as problem documents (RFC 9457): the one table from a type to a status, a type URI and a title.

Types of OGC API - Processes keep their own URIs; ours are `urn:gablework:problem:…`; statuses of HTTP itself
(405, 406, 415, ...) are `about:blank`.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from sqlalchemy import exc as sql
from starlette.exceptions import HTTPException
from starlette.routing import BaseRoute

from pipeline.errors import InputError, SettingsError
from service import errors
from service.jobs import Fault, JobFailure
from service.methods import allowed_methods
from service.wire.base import respond
from service.wire.faults import sentences
from service.wire.problems import Problem
from service.wording import as_inputs

OGC = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
"""Prefix of the standard's types."""

OWN = "urn:gablework:problem:"
"""Prefix of our types."""

MEDIA_TYPE = "application/problem+json"
"""Media type of problem documents."""

LONGEST_DETAIL = 20_000
"""Maximum number of characters of a text in a problem document: twenty faults with long lists of what is allowed."""

RETRY_AFTER_S = 30
"""Seconds after which a client may try again, if nothing better is known."""

_log = logging.getLogger("gablework.service")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of problem."""

    status: int
    """HTTP status."""
    type_uri: str
    """Its type."""
    title: str
    """The same for every problem of this kind."""
    retry: bool = False
    """Whether the answer has `Retry-After`."""

    @property
    def word(self) -> str:
        """Last part of the type."""
        return self.type_uri.removeprefix(OWN).removeprefix(OGC)


_AWAY = Kind(status=503, type_uri=f"{OWN}database-away", title="The database does not answer", retry=True)

KINDS: Mapping[type[Exception], Kind] = {
    errors.NoSuchJobError: Kind(status=404, type_uri=f"{OGC}no-such-job", title="No such job"),
    errors.NoSuchProcessError: Kind(status=404, type_uri=f"{OGC}no-such-process", title="No such process"),
    errors.NoSuchUploadError: Kind(status=404, type_uri=f"{OWN}no-such-upload", title="No such upload"),
    errors.NoSuchBuildingError: Kind(status=404, type_uri=f"{OWN}no-such-building", title="No such building"),
    errors.NoSuchCollectionError: Kind(status=404, type_uri=f"{OWN}no-such-collection", title="No such collection"),
    errors.NoSuchFeatureError: Kind(status=404, type_uri=f"{OWN}no-such-feature", title="No such feature"),
    errors.NoSuchOutputError: Kind(status=404, type_uri=f"{OWN}no-such-output", title="No such output"),
    errors.NoSuchScheduleError: Kind(status=404, type_uri=f"{OWN}no-such-schedule", title="No such schedule"),
    errors.JobNotOverError: Kind(status=409, type_uri=f"{OWN}job-not-over", title="The job is not over yet"),
    errors.NoSuchWebhookError: Kind(status=404, type_uri=f"{OWN}no-such-webhook", title="No such webhook"),
    errors.NoSuchDeliveryError: Kind(status=404, type_uri=f"{OWN}no-such-delivery", title="No such delivery"),
    errors.NotReplayableError: Kind(
        status=409, type_uri=f"{OWN}not-replayable", title="The delivery cannot be sent again now"
    ),
    errors.TargetRefusedError: Kind(
        status=403, type_uri=f"{OWN}target-refused", title="Webhooks are not sent to this URL"
    ),
    errors.ScheduleBusyError: Kind(
        status=409, type_uri=f"{OWN}schedule-busy", title="A job of the schedule is under way"
    ),
    errors.TooManySchedulesError: Kind(status=409, type_uri=f"{OWN}too-many-schedules", title="Too many schedules"),
    errors.TooManyWebhooksError: Kind(status=409, type_uri=f"{OWN}too-many-webhooks", title="Too many webhooks"),
    errors.KeyInUseError: Kind(status=409, type_uri=f"{OWN}key-in-use", title="The request is under way", retry=True),
    errors.KeyReusedError: Kind(status=422, type_uri=f"{OWN}key-reused", title="The key belongs to another request"),
    errors.RemovedSinceError: Kind(
        status=409, type_uri=f"{OWN}removed-since", title="What the request made was removed since"
    ),
    errors.ChangedMeanwhileError: Kind(
        status=412, type_uri=f"{OWN}changed-meanwhile", title="It was changed in the meantime"
    ),
    errors.ResultNotReadyError: Kind(status=404, type_uri=f"{OGC}result-not-ready", title="The results are not ready"),
    errors.SelectionBusyError: Kind(
        status=503, type_uri=f"{OWN}selection-busy", title="The selection is being made", retry=True
    ),
    errors.RequestError: Kind(status=400, type_uri=f"{OWN}invalid-request", title="The request does not fit"),
    errors.OutsideAreaError: Kind(
        status=422, type_uri=f"{OWN}outside-area-of-use", title="A tile would lie far from where its CRS is used"
    ),
    errors.InputRefusedError: Kind(status=403, type_uri=f"{OWN}input-refused", title="The input is not allowed here"),
    errors.TooLargeError: Kind(status=413, type_uri=f"{OWN}too-large", title="More than this service takes"),
    errors.NoSpaceError: Kind(status=507, type_uri=f"{OWN}no-space", title="The disk is full", retry=True),
    errors.QuotaError: Kind(status=507, type_uri=f"{OWN}quota-exceeded", title="The uploads of the key are too large"),
    errors.UploadInUseError: Kind(status=409, type_uri=f"{OWN}upload-in-use", title="The upload is still needed"),
    errors.StoreBusyError: Kind(status=503, type_uri=f"{OWN}database-busy", title="The database is busy", retry=True),
    errors.StoreNewerError: Kind(
        status=503, type_uri=f"{OWN}database-newer", title="The service is being updated", retry=True
    ),
    errors.StoreFullError: Kind(status=507, type_uri=f"{OWN}no-space", title="The disk is full", retry=True),
    errors.UploadBusyError: Kind(
        status=423, type_uri=f"{OWN}upload-busy", title="Another request sends it", retry=True
    ),
    errors.OffsetError: Kind(status=409, type_uri=f"{OWN}wrong-offset", title="The bytes do not continue the upload"),
    errors.ChecksumError: Kind(status=460, type_uri=f"{OWN}wrong-checksum", title="The bytes arrived damaged"),
    errors.TooManyUploadsError: Kind(
        status=429, type_uri=f"{OWN}too-many-uploads", title="Too many uploads", retry=True
    ),
    errors.StoreError: _AWAY,
    errors.QueueFullError: Kind(status=429, type_uri=f"{OWN}queue-full", title="Too many jobs wait", retry=True),
    errors.TooManyRequestsError: Kind(
        status=429, type_uri=f"{OWN}too-many-requests", title="Too many requests", retry=True
    ),
    errors.UnauthorizedError: Kind(status=401, type_uri=f"{OWN}unauthorized", title="A key is needed"),
    errors.ForbiddenError: Kind(status=403, type_uri=f"{OWN}forbidden", title="The key does not allow this"),
    InputError: Kind(status=422, type_uri=f"{OWN}unusable-input", title="The input cannot be used"),
    SettingsError: Kind(status=400, type_uri=f"{OWN}invalid-settings", title="Settings are out of range"),
    sql.OperationalError: _AWAY,
    sql.InterfaceError: _AWAY,
    sql.TimeoutError: _AWAY,
}
"""The kind of problem of each exception; a subclass has that of its nearest base."""

_STORE: Mapping[str, str] = {
    "database-away": "The database does not answer; nothing was lost, try again.",
    "database-busy": "Others hold the locks of the database; nothing was written, try again.",
    "database-newer": "A newer version has migrated the database, and this process is of an older one; nothing was "
    "read or written. Its operator must end it.",
    "no-space": "The disk of the database is full; nothing was written. Its operator must make room, then try again.",
}
"""Sentences for clients, by the word of the kind: a database's own message can hold its address."""

INTERNAL = Kind(status=500, type_uri=f"{OWN}internal", title="A fault of the service")
"""Anything else."""

FOREIGN = Kind(status=403, type_uri=f"{OWN}foreign-origin", title="The request comes from another site")
"""A request from a page of another site, or with a foreign host name, to a service without keys."""

ENCODED = Kind(status=415, type_uri="about:blank", title=HTTPStatus(415).phrase)
"""A body that is compressed on the way."""

AMBIGUOUS = Kind(status=400, type_uri="about:blank", title=HTTPStatus(400).phrase)
"""A body whose length is given in two ways."""

FAILURES: Mapping[Fault, Kind] = {
    Fault.INPUT: Kind(status=422, type_uri=f"{OWN}job-failed-input", title="An input could not be used"),
    Fault.SETTINGS: Kind(status=422, type_uri=f"{OWN}job-failed-settings", title="The settings could not be used"),
    Fault.REFUSED: Kind(status=422, type_uri=f"{OWN}job-failed-refused", title="An input is not allowed or too large"),
    Fault.CLUSTER: Kind(status=503, type_uri=f"{OWN}job-failed-cluster", title="The cluster was away or lost"),
    Fault.LOST: Kind(status=503, type_uri=f"{OWN}job-failed-lost", title="Drivers were lost over the job"),
    Fault.STALLED: Kind(status=500, type_uri=f"{OWN}job-failed-stalled", title="The job stood still again and again"),
    Fault.NO_SPACE: Kind(status=507, type_uri=f"{OWN}job-failed-no-space", title="The disk had no room for the job"),
    Fault.INTERNAL: Kind(status=500, type_uri=f"{OWN}job-failed-internal", title="A fault of the service"),
}
"""The answer to a request for the results of a failed job, by cause."""


class JobFailedError(errors.ServiceError):
    """The requested results are those of a job that failed."""

    def __init__(self, failure: JobFailure) -> None:
        self.failure = failure
        super().__init__(failure.detail)


def kind_of(error: Exception) -> Kind:
    """The kind of problem of an exception.

    >>> kind_of(errors.NoSuchJobError("x")).word
    'no-such-job'
    >>> kind_of(ZeroDivisionError()).status
    500
    """
    if isinstance(error, JobFailedError):
        return FAILURES[error.failure.fault]
    return next((KINDS[base] for base in type(error).__mro__ if base in KINDS), INTERNAL)


def document(
    kind: Kind, detail: str, instance: str, faults: Sequence[str] = (), members: Mapping[str, Any] | None = None
) -> Problem:
    """A problem document; `errors` only if several things can be wrong together."""
    return Problem(
        type=kind.type_uri,
        title=kind.title,
        status=kind.status,
        detail=_encodable(detail),
        instance=_encodable(instance),
        errors=[_encodable(fault) for fault in faults] or None,
        **(members or {}),
    )


def _encodable(text: str) -> str:
    """The text without lone surrogates, which JSON can hold and UTF-8 cannot; not all of one without end."""
    text = text if len(text) <= LONGEST_DETAIL else f"{text[: LONGEST_DETAIL - 3]}..."
    return text.encode("utf-8", "replace").decode("utf-8")


def failure_document(failure: JobFailure, instance: str) -> Problem:
    """Why a job failed, as a problem document: the `exception` of its status."""
    return document(FAILURES[failure.fault], failure.detail, instance)


def answer(
    kind: Kind,
    detail: str,
    instance: str,
    faults: Sequence[str] = (),
    headers: Mapping[str, str] | None = None,
    members: Mapping[str, Any] | None = None,
) -> Response:
    """A response with a problem document; `members` are those of the kind alone."""
    problem = document(kind, detail, instance, faults, members)
    return respond(problem, status_code=kind.status, headers=headers, media_type=MEDIA_TYPE)


def answer_error(error: Exception, instance: str) -> Response:
    """The response for an exception of ours, of the pipeline or of the database."""
    kind = kind_of(error)
    headers = {}
    if kind.status == HTTPStatus.UNAUTHORIZED:
        headers["WWW-Authenticate"] = 'Bearer realm="gablework"'
    if kind.retry:
        after = getattr(error, "retry_after_s", RETRY_AFTER_S)
        headers["Retry-After"] = str(max(1, math.ceil(after)))
    faults = errors.few(
        fault if isinstance(fault, errors.Further) else as_inputs(fault) for fault in getattr(error, "faults", ())
    )
    if kind is _AWAY or isinstance(error, errors.StoreError):
        _log.error("%s", error)
        return answer(kind, _STORE[kind.word], instance, (), headers)
    if kind is INTERNAL:
        return answer(kind, "The service has logged the fault; please report it.", instance)
    detail = as_inputs("; ".join(errors.few(error.faults)) if isinstance(error, SettingsError) else str(error))
    return answer(kind, detail or kind.title, instance, faults, headers, getattr(error, "members", None))


def install(app: FastAPI, routes: Sequence[BaseRoute]) -> None:
    """Make every error of an application a problem document, the framework's own included.

    `routes` are all routes of the application, for the header Allow.
    """

    async def on_error(request: Request, error: Exception) -> Response:
        return answer_error(error, request.url.path)

    async def on_http_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        kind = Kind(status=error.status_code, type_uri="about:blank", title=HTTPStatus(error.status_code).phrase)
        detail = str(error.detail)
        if error.status_code == HTTPStatus.NOT_FOUND and detail == kind.title:
            detail = f"There is nothing at {request.url.path}; /openapi.json lists all paths"
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            # the framework names the methods of the first route with this path, and there is one per method
            headers["Allow"] = ", ".join(allowed_methods(routes, request.scope))
            detail = f"{request.method} is not possible here: use {headers['Allow']}"
            if request.method == "OPTIONS":
                return Response(status_code=HTTPStatus.NO_CONTENT, headers=headers)
        return answer(kind, detail, request.url.path, (), headers)

    async def on_validation_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        return answer_error(errors.RequestError(sentences(error.errors())), request.url.path)

    app.add_exception_handler(HTTPException, on_http_error)
    app.add_exception_handler(RequestValidationError, on_validation_error)
    for kind in (*KINDS, errors.ServiceError, Exception):
        app.add_exception_handler(kind, on_error)
