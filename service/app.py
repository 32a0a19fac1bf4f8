"""The application: binds settings, store, limits and routes."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool

from pipeline import __version__
from service import openapi, problems
from service.arrivals import Arrivals
from service.compression import Compressed
from service.features.runs import check_published, published_runs
from service.files import StateFolder
from service.guard import Guard
from service.input_policy import check_hosts, check_roots
from service.methods import HeadAsGet, check_query, written_out
from service.metrics import Measured, Metrics
from service.outputs.selected import Selections
from service.rate_limits import RateLimiter
from service.routes import (
    buildings,
    collections,
    events,
    health,
    jobs,
    landing,
    log,
    processes,
    published,
    results,
    schedules,
    tus,
    uploads,
    webhooks,
)
from service.routes.events import Streams
from service.routes.polling import PolledJobs
from service.routes.replay import ReplayedError, replayed
from service.routes.writing import writing
from service.settings import ServiceSettings
from service.store import JobStore
from service.traces import telemetry

ROUTERS: tuple[APIRouter, ...] = (
    landing.router,
    processes.router,
    uploads.router,
    tus.router,
    jobs.router,
    events.router,
    log.router,
    schedules.router,
    webhooks.router,
    results.router,
    buildings.router,
    published.router,
    collections.router,
    health.router,
)
"""All routes, in the order of the documentation."""


def create_app(settings: ServiceSettings, store: JobStore | None = None) -> FastAPI:
    """Build the application. By default it opens the store named in the settings and migrates it at start.

    Raises
    ------
    StartUpError
        A published run has no name that can be used. At start: other machines can reach the address, and there are
        no keys; or a published run cannot be read.
    """
    kept = JobStore(settings.database, wait_s=settings.database_wait_s) if store is None else store
    streams = Streams()
    folder = StateFolder(settings.state, settings.reserve_bytes)
    metrics = Metrics(kept, lambda: streams.count, folder.disk)

    @contextlib.asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(start, settings, kept)
        try:
            yield
        finally:
            streams.closing = True
            if store is None:
                await run_in_threadpool(kept.close)

    app = FastAPI(
        title="gablework",
        version=__version__,
        lifespan=lifespan,
        docs_url=None,  # both load scripts from elsewhere
        redoc_url=None,
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,
        separate_input_output_schemas=False,
        dependencies=[Depends(check_query)],  # a further one must be added to `routes.polling`, too
        telemetry=telemetry(),
    )
    app.state.settings = settings
    app.state.store = kept
    app.state.folder = folder
    app.state.published = published_runs(settings.publish, settings.state)
    app.state.limiter = RateLimiter(settings)
    app.state.streams = streams
    app.state.selections = Selections()
    app.state.polled_jobs = PolledJobs(kept, settings.database_wait_s)
    app.state.writing = writing(settings)
    app.state.metrics = metrics
    app.state.arrivals = Arrivals(kept, app.state.folder, settings)
    routes = [route for router in ROUTERS for route in router.routes]
    problems.install(app, routes)
    app.add_exception_handler(ReplayedError, replayed)
    app.router.routes.extend(written_out(routes))
    for router in ROUTERS:
        app.include_router(router)
    if landing.VIEWER.is_dir():
        app.mount("/viewer", StaticFiles(directory=landing.VIEWER), name="viewer")
    app.openapi = lambda: openapi.document(app)  # type: ignore[method-assign]
    app.add_middleware(Guard, settings=settings)
    app.add_middleware(Compressed)
    app.add_middleware(HeadAsGet, routes=routes)
    app.add_middleware(Measured, metrics=metrics)
    return app


def start(settings: ServiceSettings, store: JobStore) -> None:
    """Make the state folder and the tables; refuse an address that others can reach if there are no keys.

    Raises
    ------
    StartUpError
        Other machines can reach the address, and there are no keys; or a listed host is not a host name; or the state
        folder cannot be used, or a folder of inputs is a file; or a published run cannot be read.
    StoreError
        The database does not answer.
    """
    check_hosts(settings)
    check_roots(settings)
    StateFolder(settings.state).prepare()
    if settings.publish:
        check_published(published_runs(settings.publish, settings.state))
    store.migrate()
    store.fill_ballast(settings.reserve_bytes)
    settings.check_address(has_keys=store.has_keys())
