"""What routes depend on: settings, store, state folder and the caller, as `create_app` bound them to the application.

A route names what it needs by type: `def job(job_id: str, store: Store, reader: Reader) -> …`. `Reader`, `Submitter`
and `Admin` are the caller with that scope; `caller.owner` is what the store wants as `owner`.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.auth import Principal, authenticate
from service.errors import UnauthorizedError
from service.files import StateFolder
from service.keys import Scope
from service.rate_limits import RateLimiter
from service.settings import ServiceSettings
from service.store import JobStore

_bearer = HTTPBearer(
    scheme_name="key",
    bearerFormat="gw_…",
    description="A key made by `gablework keys create`. Not needed where the service listens on loopback and has none.",
    auto_error=False,
)


# Coroutines, since they neither wait nor compute: a plain function would cost a thread each.
async def _settings(request: Request) -> ServiceSettings:
    settings: ServiceSettings = request.app.state.settings
    return settings


async def _store(request: Request) -> JobStore:
    store: JobStore = request.app.state.store
    return store


async def _folder(request: Request) -> StateFolder:
    folder: StateFolder = request.app.state.folder
    return folder


async def _limiter(request: Request) -> RateLimiter:
    limiter: RateLimiter = request.app.state.limiter
    return limiter


async def _base_url(request: Request) -> str:
    settings: ServiceSettings = request.app.state.settings
    return (settings.public_url or str(request.base_url)).rstrip("/")


Settings_ = Annotated[ServiceSettings, Depends(_settings)]
"""The settings."""

Store = Annotated[JobStore, Depends(_store)]
"""Where jobs, uploads and keys are kept."""

Folder = Annotated[StateFolder, Depends(_folder)]
"""Where files are kept."""

Base = Annotated[str, Depends(_base_url)]
"""The service's own URL without a slash at its end, for links."""


def address_of(request: Request) -> str:
    """The client's address, as the limit of its requests knows it."""
    return "unknown" if request.client is None else request.client.host


async def visitor(request: Request, limiter: Annotated[RateLimiter, Depends(_limiter)]) -> None:
    """Count a request that needs no key against its address.

    Raises
    ------
    TooManyRequestsError
        Above the limit.
    """
    limiter.check(address_of(request))


def caller(
    request: Request,
    settings: Settings_,
    store: Store,
    limiter: Annotated[RateLimiter, Depends(_limiter)],
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Principal:
    """Who asks; counted against the key, or the address where there is none.

    Raises
    ------
    UnauthorizedError
        No key although one is needed, or one that is not known.
    TooManyRequestsError
        Above the limit.
    """
    del credentials  # only tells the OpenAPI document
    try:
        principal = authenticate(request.headers.get("authorization"), store, settings)
    except UnauthorizedError:
        # guessing keys is limited like everything else
        limiter.check(address_of(request))
        raise
    limiter.check(principal.key_id or address_of(request))
    return principal


Caller = Annotated[Principal, Depends(caller)]
"""Who asks, whatever its scopes."""


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
"""The caller, who may see and do what concerns everybody."""
