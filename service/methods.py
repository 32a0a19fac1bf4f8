"""Methods and query parameters that the service's paths know: HEAD, OPTIONS, the header Allow, unknown parameters."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from typing import Any

import anyio
from fastapi import FastAPI, HTTPException, Request, Response
from starlette.routing import BaseRoute, Match, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import MOST_FAULTS, Further, RequestError
from service.wire.faults import shortened


class HeadAsGet:
    """Answers HEAD with the head of the answer to GET, unless a route answers HEAD itself."""

    def __init__(self, app: ASGIApp, routes: Iterable[BaseRoute] = ()) -> None:
        self.app = app
        self._own = [route for route in routes if isinstance(route, Route) and "HEAD" in (route.methods or ())]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; a HEAD request as GET, which ends before its body."""
        if scope["type"] != "http" or scope["method"] != "HEAD" or self._has_own(scope):
            await self.app(scope, receive, send)
            return
        with anyio.CancelScope() as until_body:

            async def send_head(message: Message) -> None:
                if message["type"] == "http.response.start":
                    await send(message)
                elif message["type"] == "http.response.body":
                    await send({"type": "http.response.body", "body": b""})
                    # an event stream would never end
                    until_body.cancel()

            await self.app({**scope, "method": "GET"}, receive, send_head)

    def _has_own(self, scope: Scope) -> bool:
        return any(route.matches(scope)[0] is Match.FULL for route in self._own)


def allowed_methods(routes: Iterable[BaseRoute], scope: Scope) -> list[str]:
    """The methods of all routes with the path of a request, sorted, for the header Allow.

    A path that is written out, such as `/webhooks/secret`, has none of the methods of `/webhooks/{webhookID}`.
    """
    found = {"OPTIONS"}
    matching = [route for route in routes if isinstance(route, Route) and route.matches(scope)[0] is not Match.NONE]
    nearest = min(matching, key=lambda route: len(route.param_convertors)).path if matching else ""
    for route in matching:
        found |= (route.methods or set()) if route.path == nearest else set()
    return sorted(found | {"HEAD"} if "GET" in found else found)


def written_out(routes: Sequence[BaseRoute]) -> list[BaseRoute]:
    """Routes that refuse, at each path that is written out, the methods that only a path with a variable has.

    They come before all others: else `DELETE /webhooks/secret` would remove the webhook `secret`.
    """
    known = [route for route in routes if isinstance(route, Route)]
    refusing: list[BaseRoute] = []
    for path in {route.path: None for route in known if not route.param_convertors}:
        own = {method for route in known if route.path == path for method in route.methods or ()}
        others = {
            method
            for route in known
            if route.param_convertors and route.path_regex.match(path)
            for method in route.methods or ()
        }
        if others - own - {"HEAD"}:
            refusing.append(Route(path, _refuse, methods=sorted(others - own - {"HEAD"}), include_in_schema=False))
    return refusing


async def _refuse(_request: Request) -> Response:
    raise HTTPException(HTTPStatus.METHOD_NOT_ALLOWED)


async def check_query(request: Request) -> None:
    """Refuse query parameters that the path does not have, and two values of one that has one value.

    Raises
    ------
    RequestError
        Naming them and those that the path has.
    """
    if not request.query_params:
        return
    path = getattr(request.scope.get("route"), "path", "")
    known = _query_names(request.app).get((path, request.method.lower()))
    if known is None:
        return
    takes = f"use {', '.join(map(str, known))}" if known else "this path has no query parameters"
    given = Counter(name for name, _ in request.query_params.multi_items())
    unknown = [] if None in known else [name for name in given if name not in known]  # None: the route knows them
    faults = [f"query {shortened(name)} is not known: {takes}" for name in unknown[:MOST_FAULTS]]
    if len(unknown) > MOST_FAULTS:
        faults.append(Further(len(unknown) - MOST_FAULTS))
    twice = [name for name, n in given.items() if n > 1 and known.get(name)]
    faults += [f"query {name} is given {given[name]} times: give it once" for name in twice]
    if faults:
        raise RequestError(faults)


@functools.lru_cache(maxsize=8)
def _query_names(app: FastAPI) -> Mapping[tuple[str, str], dict[str | None, bool]]:
    """The query parameters of every documented operation, by path and method, and whether each has one value.

    The name is None for an object whose members are parameters of any names.
    """
    paths: Mapping[str, Mapping[str, Any]] = app.openapi()["paths"]
    return {
        (path, method): {
            None if given["schema"].get("type") == "object" else given["name"]: given["schema"].get("type") != "array"
            for given in operation.get("parameters", ())
            if given["in"] == "query"
        }
        for path, item in paths.items()
        for method, operation in item.items()
    }
