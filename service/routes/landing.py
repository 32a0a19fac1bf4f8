"""Landing page and conformance; the web page for browsers."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse

from service.routes.bound import Base, visitor
from service.routes.documented import document, problems
from service.routes.negotiation import preferred
from service.routes.status import RELATIONS, link

VIEWER = Path(__file__).resolve().parents[1] / "viewer" / "dist"
"""Where the build of the web page lies."""

SPECIFICATION = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/"

CONFORMANCE = tuple(
    f"{SPECIFICATION}{name}" for name in ("core", "json", "oas30", "ogc-process-description", "job-list", "dismiss")
)
"""What of the standard is met."""

OPENAPI_TYPE = "application/vnd.oai.openapi+json;version=3.0"

router = APIRouter(tags=["service"], dependencies=[Depends(visitor)])

Format = Annotated[Literal["json", "html"] | None, Query(alias="f", description="Stands above the header Accept.")]


REPRESENTATIONS: Mapping[str, str] = {"application/json": "json", "text/html": "html"}
"""Media types of the landing page, and how the parameter f calls them; the first one counts among equals."""


@router.get(
    "/",
    summary="Landing page",
    response_class=JSONResponse,
    responses={
        200: {
            "description": "Links to everything else; for browsers the web page.",
            "content": {
                "application/json": {
                    "schema": {"$ref": "#/components/schemas/LandingPage"},
                    "example": {"title": "gablework", "links": [{"href": "/processes", "rel": "processes"}]},
                },
                "text/html": {"schema": {"type": "string"}},
            },
        },
        **problems(400, 406),
    },
)
def landing(request: Request, base: Base, wanted: Format = None) -> Response:
    """Tell where everything is: JSON for machines, the web page for browsers."""
    chosen = wanted or preferred(request.headers.get("accept"), list(REPRESENTATIONS))
    return web_page() if REPRESENTATIONS.get(chosen, chosen) == "html" else _for_machines(base)


def landing_page(base: str) -> dict[str, Any]:
    """The landing page for machines."""
    return {
        "title": "gablework",
        "description": "Valid LoD2 building models from raw airborne LiDAR tiles.",
        "links": [
            link(f"{base}/", "self", "This page"),
            link(f"{base}/?f=html", "alternate", "The web page", "text/html"),
            link(f"{base}/openapi.json", "service-desc", "The API", OPENAPI_TYPE),
            link(f"{base}/docs", "service-doc", "The API for people", "text/html"),
            link(f"{base}/conformance", f"{RELATIONS}conformance", "What of OGC API - Processes is met"),
            link(f"{base}/processes", f"{RELATIONS}processes", "The processes"),
            link(f"{base}/jobs", f"{RELATIONS}job-list", "The jobs"),
            link(f"{base}/schedules", "schedules", "The schedules"),
        ],
    }


def _for_machines(base: str) -> Response:
    return JSONResponse(landing_page(base), headers={"Vary": "Accept"})


def web_page() -> Response:
    """The web page, or one that tells how to build it."""
    page = VIEWER / "index.html"
    headers = {"Vary": "Accept", "Cache-Control": "no-cache"}
    if page.is_file():
        return FileResponse(page, media_type="text/html", headers=headers)
    return HTMLResponse(UNBUILT, headers=headers)


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
    responses={
        200: document("Conformance", "The classes.", {"conformsTo": list(CONFORMANCE)}),
    },
)
def conformance() -> JSONResponse:
    """Tell which parts of OGC API - Processes are met."""
    return JSONResponse({"conformsTo": list(CONFORMANCE)})


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
        f"<h2>{escape(name)}</h2><p>{escape(titles[name])}</p>{''.join(told)}" for name, told in chapters.items()
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
    told = [
        f"<li><code>{escape(given['name'])}</code> ({given['in']}) {escape(given.get('description', ''))}</li>"
        for given in operation.get("parameters", ())
    ]
    return f"<ul>{''.join(told)}</ul>" if told else ""
