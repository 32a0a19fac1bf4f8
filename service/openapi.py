"""The OpenAPI document of the framework, with the problems that every path can answer, as version 3.0.

The OGC standards and their clients need OpenAPI 3.0, while the framework writes 3.1. The two differ in a few words of
JSON Schema, which are translated here.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic.json_schema import models_json_schema

from pipeline import __version__
from service.routes.answers import REQUIRED, problems
from service.wire.buildings import CityJson, FeaturePage
from service.wire.features import CollectionPage, JsonSchema
from service.wire.jobs import JobForm, ServerSentEvent
from service.wire.problems import Problem

VERSION = "3.0.3"
"""Version of OpenAPI."""

TAGS = (
    {"name": "service", "description": "Landing page, conformance, health and metrics."},
    {"name": "processes", "description": "The processes and how to start them."},
    {"name": "uploads", "description": "Files that jobs read."},
    {"name": "jobs", "description": "Status, events and dismissal of jobs."},
    {"name": "schedules", "description": "Jobs that run again and again: when, and what happened each time."},
    {"name": "webhooks", "description": "News that the service sends: receivers, signatures, the log of deliveries."},
    {"name": "results", "description": "Files and single buildings."},
    {"name": "features", "description": "Buildings, roof planes and rejected objects of runs as collections."},
)
"""Chapters of the document."""

DESCRIPTION = (
    "Valid LoD2 building models from raw airborne LiDAR tiles, by OGC API - Processes; the models of "
    "runs as features by OGC API - Features. Send tiles to `/uploads` or "
    "`/jobs`, follow the job, fetch its results. Every error is a problem document (RFC 9457)."
)

REFERENCED = (Problem, FeaturePage, CollectionPage, JsonSchema, CityJson, JobForm, ServerSentEvent)
"""Models that paths reference under other media types than JSON; the framework finds the others."""

_METHODS = ("get", "put", "post", "delete", "patch", "head", "options")


_made: dict[tuple[object, ...], dict[str, Any]] = {}
"""Documents by what they describe: making one takes a fifth of a second, and tests make hundreds of applications."""


_making = threading.Lock()
"""Held while one is made: the framework changes shared definitions meanwhile."""


def document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of an application; made once per process for the same routers."""
    if app.openapi_schema is not None:
        return app.openapi_schema
    with _making:
        return _document(app)


def _document(app: FastAPI) -> dict[str, Any]:
    routers = (getattr(route, "original_router", None) for route in app.routes)
    described = (
        *((id(router), len(router.routes)) for router in routers if router is not None),
        *(getattr(route, "path", None) for route in app.routes),
    )
    app.openapi_schema = app.openapi_schema or _made.get(described)
    if app.openapi_schema is None:
        found = get_openapi(
            title="gablework",
            version=__version__,
            description=DESCRIPTION,
            routes=app.routes,
            tags=[dict(tag) for tag in TAGS],
        )
        components = found.setdefault("components", {}).setdefault("schemas", {})
        for name in ("HTTPValidationError", "ValidationError"):
            components.pop(name, None)
        _, schemas = models_json_schema(
            [(model, "validation") for model in REFERENCED], ref_template="#/components/schemas/{model}"
        )
        components.update(schemas["$defs"])
        for path, operation in operations(found):
            _complete(path, operation)
        app.openapi_schema = {**as_version_3_0(found), "openapi": VERSION}
        for _, operation in operations(app.openapi_schema):
            for parameter in operation.get("parameters", ()):
                # an optional parameter may be absent; a query cannot hold null
                parameter["schema"].pop("nullable", None)
                if parameter["schema"].pop(REQUIRED, False):
                    parameter["required"] = True
        _made[described] = app.openapi_schema
    return app.openapi_schema


def operations(found: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """All operations of a document, with their paths."""
    for path, item in found["paths"].items():
        yield from ((path, item[method]) for method in _METHODS if method in item)


_UNCOUNTED = ("/healthz", "/readyz")
"""Paths without a rate limit, for monitoring."""


def _complete(path: str, operation: dict[str, Any]) -> None:
    """Add the problems that every path can answer."""
    responses = operation["responses"]
    if "HTTPValidationError" in str(responses.get("422")):
        del responses["422"]
    general = [503] if path in _UNCOUNTED else [429, 503]
    if operation.get("parameters") or "requestBody" in operation:
        general.append(400)
    if "requestBody" in operation:
        general += [413, 415]
    if "security" in operation:
        general += [401, 403]
        # on loopback the service may have no keys
        operation["security"] = [{}, *operation["security"]]
    elif "requestBody" in operation:
        general.append(403)
    for status, answer in problems(*general).items():
        responses.setdefault(str(status), answer)
    operation["responses"] = dict(sorted(responses.items(), key=lambda item: str(item[0])))


def as_version_3_0(value: Any) -> Any:
    """JSON Schema of OpenAPI 3.1 in the words of 3.0: nullable, one example, bounds as flags, no constants.

    >>> as_version_3_0({"anyOf": [{"type": "string"}, {"type": "null"}], "title": "F"})
    {'title': 'F', 'type': 'string', 'nullable': True}
    >>> as_version_3_0({"type": "number", "exclusiveMinimum": 0})
    {'type': 'number', 'exclusiveMinimum': True, 'minimum': 0}
    """
    if isinstance(value, list):
        return [as_version_3_0(item) for item in value]
    if not isinstance(value, dict):
        return value
    found = {name: item if name == "example" else as_version_3_0(item) for name, item in value.items()}
    for word in ("anyOf", "oneOf"):
        options = found.get(word)
        if isinstance(options, list) and {"type": "null"} in options:
            left = [option for option in options if option != {"type": "null"}]
            del found[word]
            found = {**found, **left[0]} if len(left) == 1 and "$ref" not in left[0] else {**found, word: left}
            found["nullable"] = True
    if isinstance(found.get("examples"), list):
        examples = found.pop("examples")
        found.setdefault("example", examples[0])
    for word, bound in (("exclusiveMinimum", "minimum"), ("exclusiveMaximum", "maximum")):
        limit = found.get(word)
        if isinstance(limit, int | float) and not isinstance(limit, bool):
            found |= {bound: limit, word: True}
    if "const" in found and "type" in found:
        found["enum"] = [found.pop("const")]
    if found.get("type") == "array":
        found.setdefault("items", {})
    if found.pop("contentMediaType", None) == "application/octet-stream" and found.get("type") == "string":
        found["format"] = "binary"
    return found
