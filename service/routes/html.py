"""Documents as HTML pages, for people who open the API in a browser (conformance class html)."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine, Mapping, Sequence
from html import escape
from http import HTTPStatus
from typing import Annotated, Any, Literal

from fastapi import Depends, Query, Request, Response
from fastapi.responses import HTMLResponse
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException

from service.routes.negotiation import preferred

REPRESENTATIONS: Mapping[str, str] = {"application/json": "json", "text/html": "html"}
"""Media types of documents with their names in the parameter f; the first one wins among equals."""

Format = Annotated[Literal["json", "html"] | None, Query(alias="f", description="Overrides the header Accept.")]


def wants_html(request: Request, wanted: str | None) -> bool:
    """Whether a client wants a page; raises HTTPException 406 if it accepts neither page nor JSON."""
    return (wanted or REPRESENTATIONS[preferred(request.headers.get("accept"), list(REPRESENTATIONS))]) == "html"


async def _in_either_form(request: Request, wanted: Format = None) -> None:
    try:
        request.state.as_page = wants_html(request, wanted)
    except HTTPException:
        # clients that ask for another type have always got JSON here
        request.state.as_page = False


in_either_form = Depends(_in_either_form)
"""Dependency of a route of `PageRoute` whose document may also be a page."""


class PageRoute(APIRoute):
    """A route that answers with its document as a page if the client wants that."""

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        if in_either_form in (options.get("dependencies") or ()):
            answer = options["responses"][HTTPStatus.OK]
            content = answer["content"] | {"text/html": {"schema": {"type": "string"}}}
            options["responses"] = options["responses"] | {HTTPStatus.OK: answer | {"content": content}}
        super().__init__(path, endpoint, **options)

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler, with the page after it."""
        handle = super().get_route_handler()

        async def handle_as_wanted(request: Request) -> Response:
            response = await handle(request)
            if not hasattr(request.state, "as_page"):
                return response
            response.headers["Vary"] = "Accept"
            if not request.state.as_page or response.status_code != HTTPStatus.OK:
                return response
            kept = {name: response.headers[name] for name in ("cache-control", "vary") if name in response.headers}
            return HTMLResponse(page(self.summary or "", json.loads(bytes(response.body))), headers=kept)

        return handle_as_wanted


def page(title: str, document: Any) -> str:
    r"""A JSON document as a page without scripts: all its members, and its links as links.

    >>> page("A job", {"progress": 3, "links": [{"href": "/jobs", "rel": "up"}]})[-92:]
    '<dt>links</dt><dd><ul><li><a href="/jobs" rel="up">up</a></li></ul></dd></dl></body></html>\n'
    """
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)} · gablework</title></head>"
        f"<body><h1>{escape(title)}</h1>{_shown(document)}</body></html>\n"
    )


def _shown(value: Any) -> str:
    """A JSON value as HTML."""
    if isinstance(value, Mapping):
        if "href" in value:
            return _link(value)
        rows = "".join(f"<dt>{escape(str(name))}</dt><dd>{_shown(member)}</dd>" for name, member in value.items())
        return f"<dl>{rows}</dl>"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"<ul>{''.join(f'<li>{_shown(item)}</li>' for item in value)}</ul>"
    if isinstance(value, str) and value.startswith(("http://", "https://")):
        return f'<a href="{escape(value)}">{escape(value)}</a>'
    return escape(value if isinstance(value, str) else json.dumps(value))


def _link(value: Mapping[str, Any]) -> str:
    """A link, with what else is known about it."""
    href, rel = str(value["href"]), str(value.get("rel", ""))
    name = str(value.get("title") or rel or href)
    more = {key: member for key, member in value.items() if key not in {"href", "rel", "title"}}
    notes = ", ".join(f"{escape(key)} {_shown(member)}" for key, member in more.items())
    if not href.startswith(("http://", "https://", "/")):
        # a path of the server or another scheme
        return f"{escape(name)}: {escape(href)}"
    rest = f" ({notes})" if notes else ""
    return f'<a href="{escape(href)}" rel="{escape(rel)}">{escape(name)}</a>{rest}'
