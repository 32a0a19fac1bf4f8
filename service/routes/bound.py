"""Dependencies of routes: settings, store, state folder and the caller, as `create_app` bound them.

A route names what it needs by type: `def job(job_id: str, store: Store, reader: Reader) -> …`. `Reader`, `Submitter`
and `Admin` are the caller with that scope; `caller.owner` is the `owner` of the store's methods.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.auth import Principal, authenticate, needs_table
from service.errors import UnauthorizedError
from service.files import StateFolder
from service.keys import Scope
from service.outputs.selected import Selections
from service.rate_limits import RateLimiter
from service.settings import ServiceSettings
from service.store import JobStore

_bearer = HTTPBearer(
    scheme_name="key",
    bearerFormat="gw_…",
    description="A key made by `gablework keys create`. Not needed if the service listens on loopback and has none.",
    auto_error=False,
)


# Coroutines, because each plain function would cost a thread.
async def _settings(request: Request) -> ServiceSettings:
    settings: ServiceSettings = request.app.state.settings
    return settings


async def _store(request: Request) -> JobStore:
    store: JobStore = request.app.state.store
    return store


async def _folder(request: Request) -> StateFolder:
    folder: StateFolder = request.app.state.folder
    return folder


async def _selections(request: Request) -> Selections:
    selections: Selections = request.app.state.selections
    return selections


async def _limiter(request: Request) -> RateLimiter:
    limiter: RateLimiter = request.app.state.limiter
    return limiter


async def _base_url(request: Request) -> str:
    return base_url_of(request)


Settings_ = Annotated[ServiceSettings, Depends(_settings)]
"""The settings."""

Store = Annotated[JobStore, Depends(_store)]
"""The store of jobs, uploads and keys."""

Folder = Annotated[StateFolder, Depends(_folder)]
"""The folder of files."""

Selecting = Annotated[Selections, Depends(_selections)]
"""Makes outputs with the buildings of some statuses."""

Base = Annotated[str, Depends(_base_url)]
"""The service's own URL without a final slash, for links."""


def base_url_of(request: Request) -> str:
    """The service's own URL without a final slash, for links."""
    settings: ServiceSettings = request.app.state.settings
    return (settings.public_url or str(request.base_url)).rstrip("/")


def address_of(request: Request) -> str:
    """The client's address, for the limit of requests."""
    return "unknown" if request.client is None else request.client.host


async def visitor(request: Request, limiter: Annotated[RateLimiter, Depends(_limiter)]) -> None:
    """Count a request that needs no key against its address."""
    limiter.check(address_of(request))


def is_remembered(request: Request) -> bool:
    """Whether `principal_of` knows the caller without the database."""
    return not needs_table(request.headers.get("authorization"), request.app.state.store)


def principal_of(request: Request) -> Principal:
    """The caller; the request counts against its key, or its address without a key. It may ask the database.

    Raises
    ------
    UnauthorizedError
        A key is needed, and none was sent or it is not valid.
    TooManyRequestsError
        The caller has used up its requests.
    """
    store: JobStore = request.app.state.store
    settings: ServiceSettings = request.app.state.settings
    limiter: RateLimiter = request.app.state.limiter
    try:
        principal = authenticate(request.headers.get("authorization"), store, settings)
    except UnauthorizedError:
        # guessing keys is limited like everything else
        limiter.check(address_of(request))
        raise
    limiter.check(principal.key_id or address_of(request))
    return principal


def caller(
    request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> Principal:
    """The caller; see `principal_of`."""
    del credentials  # only for the OpenAPI document
    return principal_of(request)


Caller = Annotated[Principal, Depends(caller)]
"""The caller with any scopes."""


async def _reader(principal: Caller) -> Principal:
    principal.require(Scope.READ)
    return principal


async def _submitter(principal: Caller) -> Principal:
    principal.require(Scope.SUBMIT)
    return principal


async def _admin(principal: Caller) -> Principal:
    principal.require(Scope.ADMIN)
    return principal


Reader = Annotated[Principal, Depends(_reader)]
"""The caller, who may read."""

Submitter = Annotated[Principal, Depends(_submitter)]
"""The caller, who may submit, dismiss and remove."""

Admin = Annotated[Principal, Depends(_admin)]
"""The caller, who may see and change the data of all keys."""
