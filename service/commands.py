"""The commands that run a service: serve, driver, backup, restore, keys. They import the service lazily."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, count_or_auto, takes_options
from pipeline.console import Console
from pipeline.errors import RunError, SettingsError

if TYPE_CHECKING:
    from service.keys import Key
    from service.settings import ServiceSettings
    from service.store import JobStore

keys = typer.Typer(help="Manage the keys that identify clients.", no_args_is_help=True, rich_markup_mode=None)

State = Annotated[
    str | None, typer.Option(metavar="DIR", help="Folder of database, uploads and results; default GABLEWORK_STATE.")
]
DatabaseUrl = Annotated[
    str | None, typer.Option(metavar="URL", help="SQLAlchemy URL of the database; default SQLite in the state folder.")
]
ServiceWorkers = Annotated[
    str | None,
    typer.Option(
        metavar="N|auto",
        parser=functools.partial(count_or_auto, least=1),
        help="Processes of the embedded cluster, auto for one per core; default GABLEWORK_WORKERS.",
    ),
]

KeyId = Annotated[str, typer.Argument(metavar="ID", help="Id of the key, as in `gablework keys list`.")]
Days = Annotated[
    float | None, typer.Option(metavar="N", min=0.001, max=36_500.0, help="Days from now after which it expires.")
]

_STANDARD_INPUT = 0
"""File descriptor of the pipe that `serve` holds open for its driver."""
_NICENESS = 10
"""Of a driver beside the API on the same processors: answers go before models."""


@contextlib.contextmanager
def _service_errors() -> Iterator[None]:
    """Turn the service's errors into those that the console shows.

    Raises
    ------
    SettingsError
        Settings with which the service must not start.
    RunError
        The database does not answer.
    """
    from service.errors import ServiceError, StartUpError

    try:
        yield
    except StartUpError as error:
        raise SettingsError([str(error)]) from error
    except ServiceError as error:
        raise RunError(str(error)) from error


def _settings(**options: Any) -> ServiceSettings:
    """Settings from the environment, overridden by the options of the command line.

    Raises
    ------
    SettingsError
        With all faults.
    """
    from pydantic import ValidationError

    from service.settings import ServiceSettings

    try:
        return ServiceSettings(**{name: value for name, value in options.items() if value not in (None, [], ())})
    except ValidationError as error:
        faults = [
            f"{'.'.join(map(str, fault['loc']))} is {fault['input']!r}: {fault['msg']}" for fault in error.errors()
        ]
        raise SettingsError(faults) from error


def _log_to_stderr() -> None:
    import logging

    # no effect if lines are JSON: the console has set up the root logger
    logging.basicConfig(format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    logging.getLogger().setLevel(logging.INFO)
    # each line names a malformed request; a client that sends many must not fill the log
    for chatty in ("alembic", "python_multipart"):
        logging.getLogger(chatty).setLevel(logging.ERROR)


@takes_options("serve")
def serve(
    host: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Address to listen on; all except loopback need keys.")
    ] = None,
    port: Annotated[
        int | None, typer.Option(metavar="N", min=0, max=65535, help="Port to listen on; 0 takes a free one.")
    ] = None,
    state: State = None,
    database_url: DatabaseUrl = None,
    workers: ServiceWorkers = None,
    driver: Annotated[
        bool, typer.Option("--driver/--no-driver", help="Run a driver here, or leave jobs to drivers elsewhere.")
    ] = True,
    public_url: Annotated[
        str | None, typer.Option(metavar="URL", help="URL by which clients reach the service behind a proxy.")
    ] = None,
    input_root: Annotated[
        list[str] | None, typer.Option(metavar="DIR", help="Jobs may name inputs below this folder; repeatable.")
    ] = None,
    input_host: Annotated[
        list[str] | None, typer.Option(metavar="HOST", help="Jobs may fetch inputs from this host; repeatable.")
    ] = None,
    publish: Annotated[
        list[str] | None,
        typer.Option(metavar="[NAME=]RUN", help="Serve a finished run, a folder or URL, as features; repeatable."),
    ] = None,
    as_json: AsJson = False,
    **given: Any,
) -> None:
    """Serve the REST API and the web page, with a job driver and a cluster."""
    with Console(as_json=as_json) as console, _service_errors():
        from service.supervisor import serve as serve_until_stopped

        _log_to_stderr()
        settings = _settings(
            host=host,
            port=port,
            state=state,
            database_url=database_url,
            workers=workers,
            public_url=public_url,
            input_roots=input_root,
            input_hosts=input_host,
            publish=publish,
            **given,
        )

        if driver:
            # fails here, not in a driver that is started again and again
            _ = settings.resources

        def on_ready(url: str) -> None:
            console.status(f"gablework listens on {url}")
            console.document({"url": url, "state": str(settings.state)})

        serve_until_stopped(settings, on_ready, with_driver=driver)


@takes_options("driver")
def drive(
    state: State = None,
    database_url: DatabaseUrl = None,
    workers: ServiceWorkers = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name in logs and leases; default host and process.")
    ] = None,
    with_parent: Annotated[
        bool, typer.Option("--with-parent", help="End when standard input closes; set by `gablework serve`.")
    ] = False,
    **given: Any,
) -> None:
    """Run the jobs of a service: the driver alone, for an API that runs elsewhere."""
    with Console(), _service_errors():
        from service.driver import run_driver
        from service.files import StateFolder

        _log_to_stderr()
        settings = _settings(state=state, database_url=database_url, workers=workers, **given)
        StateFolder(settings.state).prepare()
        if with_parent:
            os.nice(_NICENESS)
        code = run_driver(settings, name=name, parent_pipe=_STANDARD_INPUT if with_parent else None)
        if code:
            raise typer.Exit(code)


# --- backups ---------------------------------------------------------------------------------------------------------


def backup(
    to: Annotated[str, typer.Option(metavar="DIR", help="Folder of the backup: new, or of an earlier backup.")],
    state: State = None,
    database_url: DatabaseUrl = None,
    as_json: AsJson = False,
) -> None:
    """Copy database, results and uploads of a service while it runs; a further backup copies only what is new."""
    with Console(as_json=as_json) as console, _service_errors():
        from service.backup import back_up
        from service.files import StateFolder

        settings = _settings(state=state, database_url=database_url)
        console.status(f"copying {settings.state} to {to}")
        report = back_up(settings.database, StateFolder(settings.state), Path(to))
        for name in report.missing:
            console.warn(f"{name} is in the database and not in the state folder: the backup does not have it")
        console.say(f"{to} holds the service, {report.sentence}")
        console.document({"backup": to, **dataclasses.asdict(report)})


def restore(
    source: Annotated[str, typer.Argument(metavar="BACKUP", help="Folder that `gablework backup` made.")],
    state: State = None,
    database_url: DatabaseUrl = None,
    as_json: AsJson = False,
) -> None:
    """Make a service from a backup, in an empty state folder and a new database; jobs that ran wait again."""
    with Console(as_json=as_json) as console, _service_errors():
        from service.backup import restore as restore_service
        from service.files import StateFolder

        settings = _settings(state=state, database_url=database_url)
        console.status(f"copying {source} to {settings.state}")
        report, freed = restore_service(Path(source), StateFolder(settings.state), settings.database)
        for name in report.missing:
            console.warn(f"{name} is in the database and not in the backup: the restored service does not have it")
        console.say(f"{settings.state} holds the service, {report.sentence}; {freed} running jobs wait again")
        console.document({"state": str(settings.state), "waitingAgain": freed, **dataclasses.asdict(report)})


# --- keys ------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _opened(state: str | None, database_url: str | None) -> Iterator[JobStore]:
    """The store, with its tables in place."""
    from service.files import StateFolder
    from service.store import JobStore

    settings = _settings(state=state, database_url=database_url)
    if settings.database_url is None:
        StateFolder(settings.state).prepare()
    with JobStore(settings.database) as store:
        store.migrate()
        yield store


def _known(store: JobStore, key_id: str) -> Key:
    """The key of an id.

    Raises
    ------
    SettingsError
        There is none.
    """
    found = store.keys()
    made = {key.key_id: key for key in found}
    if key_id not in made:
        raise SettingsError([f"there is no key {key_id!r}: `gablework keys list` shows all {len(made)}"])
    return made[key_id]


def _days(number: float | None) -> dt.timedelta | None:
    return None if number is None else dt.timedelta(days=number)


def _day(at: dt.datetime | None) -> str | None:
    return None if at is None else at.isoformat(timespec="seconds")


@keys.command(name="create")
def create_key(
    name: Annotated[str, typer.Option(metavar="TEXT", help="Your own name for the key.")],
    scope: Annotated[
        str, typer.Option(metavar="SCOPE", help="read, submit or admin; each includes those before it.")
    ] = "submit",
    days: Days = None,
    state: State = None,
    database_url: DatabaseUrl = None,
    as_json: AsJson = False,
) -> None:
    """Make a key and show it once; only its hash is stored."""
    with Console(as_json=as_json) as console, _service_errors():
        from service.keys import Scope, new_key

        if scope not in list(Scope):
            raise SettingsError([f"scope is {scope!r}: use one of {', '.join(Scope)}"])
        with _opened(state, database_url) as store:
            key, secret = new_key(name, Scope(scope), now=store.now(), lasting=_days(days))
            store.add_key(key)
        console.say(secret)
        shown = {"id": key.key_id, "name": name, "scopes": sorted(key.scopes), "key": secret}
        console.document(shown | {"expires": _day(key.expires_at)})


@keys.command(name="rotate")
def rotate_key(
    key_id: KeyId,
    grace_hours: Annotated[
        float, typer.Option(metavar="HOURS", min=0.0, max=8760.0, help="Hours for which the old secret still works.")
    ] = 24.0,
    days: Days = None,
    state: State = None,
    database_url: DatabaseUrl = None,
    as_json: AsJson = False,
) -> None:
    """Give a key a new secret and show it once; jobs, uploads and schedules of the key stay."""
    with Console(as_json=as_json) as console, _service_errors():
        from service.keys import rotated

        with _opened(state, database_url) as store:
            key = _known(store, key_id)
            if key.revoked_at is not None:
                raise SettingsError([f"the key {key_id!r} was revoked: make another one"])
            grace = dt.timedelta(hours=grace_hours)
            key, secret = rotated(key, now=store.now(), grace=grace, lasting=_days(days))
            store.rotate_key(key)
        console.say(secret)
        times = {"oldUntil": key.old_until and key.old_until.isoformat(timespec="seconds")}
        console.document({"id": key_id, "key": secret, "expires": _day(key.expires_at)} | times)


@keys.command(name="list")
def list_keys(state: State = None, database_url: DatabaseUrl = None, as_json: AsJson = False) -> None:
    """List ids, names and scopes of the keys; the keys themselves are not stored."""
    with Console(as_json=as_json) as console, _service_errors():
        with _opened(state, database_url) as store:
            found = store.keys()
        rows: list[dict[str, Any]] = [
            {
                "id": key.key_id,
                "name": key.name,
                "scopes": sorted(key.scopes),
                "created": key.created_at.isoformat(timespec="seconds"),
                "expires": _day(key.expires_at),
                "revoked": _day(key.revoked_at),
            }
            for key in found
        ]
        if not rows:
            console.say("there are no keys")
        times = ("created", "expires", "revoked")
        console.table(
            "Keys",
            ["id", "name", "scopes", *times],
            [[row["id"], row["name"], ", ".join(row["scopes"]), *(row[at] or "" for at in times)] for row in rows],
        )
        console.document({"keys": rows})


@keys.command(name="revoke")
def revoke_key(
    key_id: KeyId,
    state: State = None,
    database_url: DatabaseUrl = None,
    as_json: AsJson = False,
) -> None:
    """Revoke a key. It is refused from now on; its jobs stay."""
    with Console(as_json=as_json) as console, _service_errors(), _opened(state, database_url) as store:
        store.revoke_key(_known(store, key_id).key_id)
        console.say(f"revoked {key_id}")
        console.document({"revoked": key_id})
