"""Landing page and conformance; the web page for browsers."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import HTMLResponse

from service.page_words import words_element
from service.routes import collections
from service.routes.answers import document, problems
from service.routes.bound import Base, Settings_, visitor
from service.routes.html import Format, PageRoute, in_either_form, wants_html
from service.settings import ServiceSettings
from service.wire.base import RELATIONS, link, respond
from service.wire.landing import Conformance, LandingPage

VIEWER = Path(__file__).resolve().parents[1] / "viewer" / "dist"
"""The built web page."""

SPECIFICATION = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/"

CONFORMANCE = tuple(
    f"{SPECIFICATION}{name}"
    for name in ("core", "json", "html", "oas30", "ogc-process-description", "job-list", "callback", "dismiss")
)
"""The implemented parts of OGC API - Processes."""

CLASSES = (*CONFORMANCE, *collections.CONFORMANCE)
"""All implemented parts of standards."""

OPENAPI_TYPE = "application/vnd.oai.openapi+json;version=3.0"

router = APIRouter(tags=["service"], dependencies=[Depends(visitor)], route_class=PageRoute)

_JSON_OR_PAGE = document(
    LandingPage,
    "Links to everything else; for browsers the web page.",
    {"title": "gablework", "links": [{"href": "/processes", "rel": "processes"}]},
)
_JSON_OR_PAGE["content"]["text/html"] = {"schema": {"type": "string"}}


@router.get(
    "/",
    summary="Landing page",
    responses={200: _JSON_OR_PAGE, **problems(400, 406)},
)
def landing(request: Request, base: Base, settings: Settings_, wanted: Format = None) -> Response:
    """Links to everything: JSON for machines, the web page for browsers."""
    return web_page(settings) if wants_html(request, wanted) else _for_machines(base)


def _for_machines(base: str) -> Response:
    page = LandingPage(
        title="gablework",
        description="Valid LoD2 building models from raw airborne LiDAR tiles.",
        links=[
            link(f"{base}/", "self", "This page"),
            link(f"{base}/?f=html", "alternate", "The web page", "text/html"),
            link(f"{base}/openapi.json", "service-desc", "The API", OPENAPI_TYPE),
            link(f"{base}/docs", "service-doc", "The API for people", "text/html"),
            link(f"{base}/conformance", f"{RELATIONS}conformance", "The implemented parts of OGC standards"),
            link(f"{base}/processes", f"{RELATIONS}processes", "The processes"),
            link(f"{base}/collections", "data", "The buildings of runs as collections of features"),
            link(f"{base}/jobs", f"{RELATIONS}job-list", "The jobs"),
            link(f"{base}/schedules", "schedules", "The schedules"),
            link(f"{base}/webhooks/deliveries", "deliveries", "The log of webhooks"),
        ],
    )
    return respond(page, headers={"Vary": "Accept"})


def web_page(settings: ServiceSettings) -> Response:
    """The web page, or one that says how to build it."""
    page = VIEWER / "index.html"
    headers = {"Vary": "Accept", "Cache-Control": "no-cache"}
    if not page.is_file():
        return HTMLResponse(UNBUILT, headers=headers)
    entries = words_element()
    if settings.map_tiles is not None:
        # the page reads there what lies beneath its map
        given = {"map-tiles": settings.map_tiles, "map-credit": settings.map_credit}
        given["map-max-zoom"] = str(settings.map_max_zoom)
        entries += "".join(f'<meta name="{name}" content="{escape(str(value))}">' for name, value in given.items())
    text = page.read_text(encoding="utf-8").replace("</head>", f"{entries}</head>", 1)
    return HTMLResponse(text, headers=headers)


UNBUILT = """<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><title>gablework</title></head>
<body>
<h1>gablework</h1>
<p>The service runs. Its web page is not built: run <code>npm ci &amp;&amp; npm run build</code> in
<code>service/viewer</code>, then load this page again.</p>
<p><a href="?f=json">Landing page</a>, <a href="openapi.json">OpenAPI</a>, <a href="processes">processes</a>,
<a href="jobs">jobs</a>, <a href="schedules">schedules</a>.</p>
</body>
</html>
"""


@router.get(
    "/conformance",
    summary="Conformance classes",
    dependencies=[in_either_form],
    responses={200: document(Conformance, "The classes.", {"conformsTo": list(CLASSES)})},
)
def conformance() -> Response:
    """List the implemented parts of OGC API - Processes and OGC API - Features."""
    return respond(Conformance(conformsTo=list(CLASSES)))


@router.get("/docs", include_in_schema=False)
def docs(request: Request) -> HTMLResponse:
    """Show the API to people, without a script and from this service alone."""
    return HTMLResponse(_docs(request.app.openapi()))


def _docs(api: Mapping[str, Any]) -> str:
    """The operations of an OpenAPI document as a page."""
    chapters: dict[str, list[str]] = {tag["name"]: [] for tag in api["tags"]}
    for path, operations in api["paths"].items():
        for method, operation in operations.items():
            answers = ", ".join(operation["responses"])
            chapters[operation["tags"][0]].append(
                f"<h3><code>{method.upper()} {escape(path)}</code> {escape(operation['summary'])}</h3>"
                f"<p>{escape(operation.get('description', ''))}</p>{_parameters(operation)}<p>Answers: {answers}</p>"
            )
    titles = {tag["name"]: tag["description"] for tag in api["tags"]}
    body = "".join(
        f"<h2>{escape(name)}</h2><p>{escape(titles[name])}</p>{''.join(texts)}" for name, texts in chapters.items()
    )
    info = api["info"]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><title>gablework API</title></head>'
        f"<body><h1>{escape(info['title'])} {escape(info['version'])}</h1><p>{escape(info['description'])}</p>"
        f'<p>For machines: <a href="openapi.json">openapi.json</a>.</p>{body}</body></html>'
    )


def _parameters(operation: Mapping[str, Any]) -> str:
    """The parameters of an operation as a list."""
    listed = [
        f"<li><code>{escape(given['name'])}</code> ({given['in']}) {escape(given.get('description', ''))}</li>"
        for given in operation.get("parameters", ())
    ]
    return f"<ul>{''.join(listed)}</ul>" if listed else ""
