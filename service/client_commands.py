"""The commands that use a service elsewhere: submit, watch, fetch, jobs, request. They import the client lazily."""

from __future__ import annotations

import functools
import inspect
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.command_options import AsJson, Quiet, SettingsFile, set_parameters, takes_options
from pipeline.console import Console, ExitCode, exit_code_of
from pipeline.errors import SettingsError
from pipeline.extras.publish.publishing import FORMS
from pipeline.options import served

if TYPE_CHECKING:
    from service.client import Client, Event, Job, Transfer

jobs = typer.Typer(help="List the jobs of a service; cancel, retry, keep or remove one.", rich_markup_mode=None)

Url = Annotated[
    str | None,
    typer.Option(metavar="URL", help="The service; default GABLEWORK_URL, or http://127.0.0.1:8000."),
]
Key = Annotated[
    str | None,
    typer.Option(
        metavar="KEY",
        help="The key; default GABLEWORK_KEY. Others on this machine can see it here: prefer --key-file.",
    ),
]
KeyFile = Annotated[
    str | None, typer.Option(metavar="FILE", help="A file that holds the key; default GABLEWORK_KEY_FILE.")
]
Ca = Annotated[
    str | None, typer.Option(metavar="FILE", help="CA of the service's certificate, PEM; default SSL_CERT_FILE.")
]
Patience = Annotated[
    float,
    typer.Option(
        metavar="S", min=0.0, max=86_400.0, help="Seconds to go on while the service does not answer or is busy."
    ),
]
PATIENCE_S = 300.0
"""The default of the client, which is too slow to import for `--help`."""

JobId = Annotated[str, typer.Argument(metavar="JOB", help="Id of the job.")]

MEGABYTE = 1_000_000
RESULT_OF: Mapping[str, ExitCode] = {
    "job-failed-input": ExitCode.INPUT,
    "job-failed-refused": ExitCode.INPUT,
    "job-failed-settings": ExitCode.USAGE,
    "job-failed-internal": ExitCode.INTERNAL,
}
"""Exit codes of failed jobs, by the kind of their problem; those of other kinds are SERVICE."""
REFUSALS: Mapping[str, ExitCode] = {
    "invalid-request": ExitCode.USAGE,
    "invalid-settings": ExitCode.USAGE,
    "no-such-process": ExitCode.USAGE,
    "unusable-input": ExitCode.INPUT,
    "outside-area-of-use": ExitCode.INPUT,
    "input-refused": ExitCode.INPUT,
    "too-large": ExitCode.INPUT,
}
"""Exit codes of refused requests, by the kind of their problem; those of other kinds are SERVICE."""


def code_of(error: BaseException) -> ExitCode:
    """The exit code of an error of the client, or of any other."""
    from service.client import JobDismissedError, JobFailedError, RefusedError

    if isinstance(error, JobDismissedError):
        return ExitCode.DISMISSED
    if isinstance(error, JobFailedError):
        return RESULT_OF.get(error.job.problem.kind if error.job.problem else "", ExitCode.SERVICE)
    if isinstance(error, RefusedError):
        return REFUSALS.get(error.problem.kind, ExitCode.SERVICE)
    return exit_code_of(error)


class Remote:
    """The console of a command, and a client that is made when it is needed.

    Parameters
    ----------
    console : Console
        Also gets the client's warnings.
    **options
        Of the client.
    """

    def __init__(self, console: Console, **options: Any) -> None:
        self.console = console
        self._options = options

    @functools.cached_property
    def client(self) -> Client:
        """The client."""
        from service.client import Client

        return Client(notify=self.console.warn, **self._options)

    def close(self) -> None:
        """End its connections."""
        if "client" in self.__dict__:
            self.client.close()


def _of_service(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of a service after its own; it gets a `Remote` in their place."""

    def called(
        url: Url = None,
        key: Key = None,
        key_file: KeyFile = None,
        ca: Ca = None,
        patience: Patience = PATIENCE_S,
        as_json: AsJson = False,
        quiet: Quiet = False,
        **given: Any,
    ) -> None:
        with Console(as_json=as_json, quiet=quiet, code_of=code_of) as console:
            remote = Remote(console, url=url, key=key, key_file=key_file, ca=ca, patience_s=patience)
            try:
                command(remote, **given)
            finally:
                remote.close()

    own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    shared = list(inspect.signature(called, eval_str=True).parameters.values())[:-1]
    set_parameters(called, [*own, *shared])
    called.__name__, called.__doc__ = command.__name__, command.__doc__
    return called


# --- submit, watch, fetch --------------------------------------------------------------------------------------------


@_of_service
@takes_options("submit", meshes=None)
def submit(
    remote: Remote,
    tiles: Annotated[
        list[str], typer.Argument(metavar="TILES", help="Files, which are sent; or URLs, which the service fetches.")
    ],
    process: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="reconstruct (default), compare (default with --methods) or classify."),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(metavar="M1,M2,…", help="Compare these methods, each METHOD or METHOD:PRESET, instead of one."),
    ] = None,
    settings: SettingsFile = None,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--publish",
            metavar="FORMAT",
            help=f"Also {', '.join(list(FORMS)[:-1])} or {list(FORMS)[-1]}; repeat for several.",
        ),
    ] = None,
    geoid_height: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="Height of the geoid above the ellipsoid, for --publish 3dtiles."),
    ] = None,
    raster_cell: Annotated[
        float | None, typer.Option(metavar="SIDE", help="Side of the cells of rasters, in the CRS's units; classify.")
    ] = None,
    outputs: Annotated[
        list[str] | None,
        typer.Option("--output", metavar="NAME", help="Only this output; repeat --output for several. Default: all."),
    ] = None,
    title: Annotated[str | None, typer.Option(metavar="TEXT", help="Your own title for the job.")] = None,
    priority: Annotated[
        int | None, typer.Option(metavar="N", min=-10, max=10, help="Higher runs first; above 0 needs an admin key.")
    ] = None,
    subscriber: Annotated[
        str | None, typer.Option(metavar="JSON", help="URLs for news of the job: successUri, failedUri, …")
    ] = None,
    new: Annotated[
        bool, typer.Option("--new", help="Make another job, even if the same command has made one within a day.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Watch the job to its end, like `gablework watch`.")] = False,
    **given: Any,
) -> None:
    """Send tiles to a service and start a job. Run it again to continue after an interruption."""
    inputs = {
        **{one.input: given[one.name] or None for one in served()},
        "methods": None if methods is None else [word.strip() for word in methods.split(",") if word.strip()],
        "publish": list(formats or ()) or None,
        "geoidHeight": geoid_height,
        "rasterCell": raster_cell,
        "title": title,
        "priority": priority,
        "subscriber": None if subscriber is None else _document(subscriber, "--subscriber"),
    }
    made = remote.client.submission(
        tiles,
        process=process or ("reconstruct" if methods is None else "compare"),
        inputs=inputs | {"settings": None if settings is None else _settings(settings)},
        footprints=given["footprints"],
        guides=given["guides"],
        outputs=outputs or None,
        new=new,
        on_transfer=_shown(remote.console, "upload"),
    )
    job = made.job
    if not made.is_new:
        remote.console.warn(f"the same command has made this job before ({job.status}): --new makes another one")
    if wait:
        _watched(remote, job.id)
        return
    remote.console.say(job.id)
    remote.console.document(job.document)


@_of_service
def watch(remote: Remote, job: JobId) -> None:
    """Follow a job to its end; the exit code shows its outcome."""
    _watched(remote, job)


@_of_service
def fetch(
    remote: Remote,
    job: JobId,
    out: Annotated[str, typer.Option(metavar="DIR", help="The folder for the files.")],
    kinds: Annotated[
        list[str] | None, typer.Argument(metavar="OUTPUTS", help="buildings, report, …; default all of the job.")
    ] = None,
    method: Annotated[
        str | None, typer.Option(metavar="LABEL", help="The results of one method of a comparison.")
    ] = None,
    statuses: Annotated[
        list[str] | None,
        typer.Option(
            "--status",
            metavar="STATUS",
            help="Only buildings of this status: ok, doubtful, fallback or failed; with commas, or repeated.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that are there with another content.")
    ] = False,
) -> None:
    """Fetch the results of a job, with checksums. Run it again to continue after an interruption."""
    found = remote.client.fetch(
        job,
        out,
        kinds or (),
        method=method,
        status=statuses or (),
        overwrite=overwrite,
        on_transfer=_shown(remote.console, "fetch"),
    )
    for file in found:
        remote.console.say(f"{file.path}{'' if file.is_new else ' was here already'}")
    files = [
        {
            "output": file.output.id,
            "path": str(file.path),
            "bytes": file.output.size_bytes,
            "sha256": file.output.sha256,
            "new": file.is_new,
        }
        for file in found
    ]
    remote.console.document({"job": job, "files": files})


@_of_service
def request(
    remote: Remote,
    method: Annotated[str, typer.Argument(metavar="METHOD", help="GET, POST, PATCH or DELETE.")],
    path: Annotated[str, typer.Argument(metavar="PATH", help="Path below the service's URL, such as /schedules.")],
    data: Annotated[
        str | None,
        typer.Option(metavar="JSON", help="The body: JSON, @FILE for the JSON of a file, or - for standard input."),
    ] = None,
) -> None:
    """Send any other request with the key, and print the answer: schedules, webhooks, single buildings."""
    found = remote.client.request(method, path, document=None if data is None else _document(data, "--data"))
    if isinstance(found, bytes):
        sys.stdout.buffer.write(found)
        sys.stdout.buffer.flush()
    elif found is not None:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")


# --- jobs ------------------------------------------------------------------------------------------------------------


@jobs.callback(invoke_without_command=True)
@_of_service
def list_jobs(
    remote: Remote,
    context: typer.Context,
    status: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STATUS",
            help="accepted, running, successful, failed or dismissed; repeat --status for several.",
        ),
    ] = None,
    process: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only jobs of this process; repeat --process for several.")
    ] = None,
    limit: Annotated[int, typer.Option(metavar="N", min=1, max=1000, help="Maximum number of jobs.")] = 20,
    offset: Annotated[int, typer.Option(metavar="N", min=0, help="Number of newer jobs to skip.")] = 0,
) -> None:
    """List the jobs of a service, newest first."""
    if context.invoked_subcommand is not None:
        _refuse_options_before(context)
        return
    # one more shows whether there are more
    found = remote.client.jobs(status=status, process=process, limit=limit + 1, offset=offset)
    shown, has_more = found[:limit], len(found) > limit
    if not shown:
        remote.console.say("there are no such jobs")
    remote.console.table(
        "",
        ["job", "status", "%", "process", "created", "title"],
        [
            [job.id, job.status, job.progress, job.process, f"{job.created:%Y-%m-%d %H:%M}", job.title or ""]
            for job in shown
        ],
    )
    if has_more:
        remote.console.say(f"there are more: --offset {offset + limit}")
    remote.console.document({"jobs": [job.document for job in shown], "hasMore": has_more})


@jobs.command()
@_of_service
def show(remote: Remote, job: JobId) -> None:
    """Show a job: its status, and why it failed."""
    _shown_job(remote.console, remote.client.job(job))


@jobs.command()
@_of_service
def cancel(remote: Remote, job: JobId) -> None:
    """Stop a job that waits or runs; one that is over stays as it is."""
    _shown_job(remote.console, remote.client.cancel(job))


@jobs.command()
@_of_service
def retry(remote: Remote, job: JobId) -> None:
    """Start a new job with the request of one that is over, and print its id."""
    made = remote.client.retry(job)
    remote.console.say(made.id)
    remote.console.document(made.document)


@jobs.command()
@_of_service
def keep(
    remote: Remote,
    job: JobId,
    until_removed: Annotated[
        bool, typer.Option("--keep/--no-keep", help="Keep it whatever its age and size, or no longer.")
    ] = True,
) -> None:
    """Keep a job with its results, whatever its age and size."""
    found = remote.client.keep(job, keep=until_removed)
    remote.console.say(f"job {found.id} is {'kept' if found.keep else 'no longer kept'}")
    remote.console.document(found.document)


@jobs.command()
@_of_service
def remove(remote: Remote, job: JobId) -> None:
    """Remove a job that is over, with its results."""
    remote.client.remove(job)
    remote.console.say(f"removed {job}")
    remote.console.document({"removed": job})


def _refuse_options_before(context: typer.Context) -> None:
    """Refuse options of the list before a command: they would count for nothing, such as another service."""
    for name in context.params:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = f"--{name.replace('_', '-').removeprefix('as-')}"
            raise typer.BadParameter(f"write {option} after the word {context.invoked_subcommand}", param_hint=option)


# --- what is shown ---------------------------------------------------------------------------------------------------


def _watched(remote: Remote, job_id: str) -> None:
    """Show the events of a job; end as it ended."""
    job = remote.client.wait(job_id, on_event=lambda event: _show_event(remote.console, event))
    _shown_job(remote.console, job)
    if any(
        job.summary.get(name)
        for name in ("failed_tiles", "tiles_without_points", "tiles_without_terrain", "unpublished")
    ):
        raise typer.Exit(ExitCode.TILES_FAILED)


def _show_event(console: Console, event: Event) -> None:
    from pipeline.runtime.monitoring.progress import Event as RunEvent

    if event.kind in {"stage", "progress", "warning", "waiting"}:
        console.on_event(
            RunEvent(
                kind=event.kind,  # type: ignore[arg-type] # one of these four
                stage=event.stage,
                done=event.done,
                total=event.total,
                message=event.message,
            )
        )
    elif event.status is not None:
        words = f"job {event.status}" + (f": {event.message}" if event.message else "")
        console.on_event(RunEvent(kind="run", message=words))


def _shown_job(console: Console, job: Job) -> None:
    reason = "" if job.problem is None else f"\n{job.problem.detail}"
    console.say(f"job {job.id} is {job.status} ({job.progress} %): {job.message}{reason}")
    console.document(job.document)


def _shown(console: Console, stage: str) -> Callable[[Transfer], None]:
    """Shows transfers as progress in megabytes, each figure once."""
    from pipeline.runtime.monitoring.progress import Event as RunEvent

    last: RunEvent | None = None

    def show_transfer(transfer: Transfer) -> None:
        nonlocal last
        done, total = (-(-size // MEGABYTE) for size in (transfer.done_bytes, transfer.total_bytes))
        event = RunEvent(kind="progress", stage=stage, done=done, total=total, message=f"MB of {transfer.name}")
        if event != last:
            console.on_event(event)
        last = event

    return show_transfer


# --- what is read ----------------------------------------------------------------------------------------------------


def _settings(path: str) -> dict[str, Any]:
    """The tables of a settings file; the service checks them."""
    import tomllib

    try:
        found = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SettingsError([f"the settings file {path} cannot be read: {error}"]) from None
    table = found.get("settings")
    if not isinstance(table, dict) or len(found) != 1:
        raise SettingsError([f"the settings file {path} needs one table [settings], and nothing beside it"])
    return table


def _document(data: str, option: str) -> Any:
    """The JSON of an option, which may name a file."""
    try:
        text = sys.stdin.read() if data == "-" else Path(data[1:]).read_text("utf-8") if data[:1] == "@" else data
        return json.loads(text)
    except (OSError, ValueError) as error:
        raise SettingsError(
            [f"{option} is {data[:80]!r}: {error}. Write JSON, @FILE, or - for standard input"]
        ) from None
