"""Settings of the service: environment variables `GABLEWORK_…`, under the options of the command line."""

from __future__ import annotations

import functools
import ipaddress
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import urlsplit

import platformdirs
from pydantic import Field, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.errors import StartUpError
from service.jobs import QueueLimits

if TYPE_CHECKING:
    from pipeline.runtime.resources import Resources

_GIB = 2**30


class ServiceSettings(BaseSettings):
    """Everything that can be set about the service; each field is an environment variable, `GABLEWORK_` before it."""

    model_config = SettingsConfigDict(env_prefix="GABLEWORK_", frozen=True, extra="ignore")

    # where
    state: Path = Field(
        default_factory=lambda: Path(platformdirs.user_data_dir("gablework", appauthor=False)),
        description="Folder of the database (unless `database_url` names another), uploads, runs and results; "
        "API, drivers and workers share it.",
    )
    database_url: str | None = Field(
        default=None,
        description="SQLAlchemy URL; default SQLite in the state folder. PostgreSQL: postgresql+pg8000://user:password@host/database",
    )
    database_wait_s: float = Field(
        default=3.0,
        ge=0.1,
        le=30.0,
        allow_inf_nan=False,
        description="Seconds that a request, or a step of a driver, waits for locks of the database that others hold. "
        "Then the answer is 503, and nothing is written.",
    )
    host: str = Field(default="127.0.0.1", description="Address to listen on; all except loopback need keys.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    public_url: str | None = Field(
        default=None, description="URL by which clients reach the service, for links; default as in the request."
    )
    root_path: str = Field(default="", description="Path prefix behind a proxy.")

    # who
    open_without_keys: bool = Field(
        default=False,
        description="Accept requests without keys on addresses except loopback. Only for closed networks.",
    )

    # inputs
    input_roots: tuple[Path, ...] = Field(
        default=(), description="Folders below which jobs may name inputs by path; none by default."
    )
    input_hosts: tuple[str, ...] = Field(
        default=(), description="Hosts (name or name:port) from which jobs may fetch inputs by URL; none by default."
    )
    max_upload_bytes: int = Field(default=4 * _GIB, gt=0, description="Maximum bytes of an upload or a fetched input.")
    max_body_bytes: int = Field(default=2**20, gt=0, description="Maximum bytes of the body of other requests.")
    max_points: int = Field(default=500_000_000, gt=0, description="Maximum number of points of all inputs of one job.")
    max_inputs: int = Field(default=1000, gt=0, description="Maximum number of input files of one job.")
    job_days: float = Field(
        default=0.0,
        ge=0.0,
        le=36_500.0,
        description="Days after which a job that is over is removed with its results; 0 for never. Kept jobs stay.",
    )
    max_results_bytes: int = Field(
        default=0,
        ge=0,
        description="Maximum bytes of the files of all jobs: beyond it those that ended first are removed; 0 for no "
        "limit. Kept jobs stay.",
    )
    upload_days: float = Field(
        default=7.0, gt=0.0, le=36_500.0, description="Days after which an upload that no job needs is removed."
    )
    unfinished_upload_hours: float = Field(
        default=24.0,
        gt=0.0,
        le=876_000.0,
        description="Hours after its last request after which an unfinished resumable upload is removed.",
    )
    max_unfinished_uploads: int = Field(
        default=100, gt=0, description="Maximum number of unfinished resumable uploads of one key."
    )

    # what is published
    publish: tuple[str, ...] = Field(
        default=(),
        description="Run directories, or their URLs, whose buildings, planes and rejected objects are served as "
        "collections of OGC API - Features, each as RUN or NAME=RUN; none by default. Every key may read them.",
    )

    # limits
    max_upload_bytes_per_key: int = Field(
        default=0,
        ge=0,
        description="Maximum bytes of all uploads of one key together, or of all uploads if keys are not used; "
        "0 for any number.",
    )
    max_uploads_per_key: int = Field(
        default=10_000,
        gt=0,
        description="Maximum number of uploads of one key, unfinished ones included, or in total if keys are not used.",
    )
    reserve_bytes: int = Field(
        default=512 * 2**20,
        ge=0,
        description="Free bytes of the state folder's disk that uploads, fetched inputs and runs may not use. They are "
        "kept for the database, and for what a run still writes until it is stopped.",
    )
    idempotency_hours: float = Field(
        default=24.0,
        gt=0.0,
        le=876_000.0,
        description="Hours for which the answer to a request with an Idempotency-Key is kept.",
    )
    max_queued: int = Field(default=1000, gt=0, description="Maximum number of waiting jobs; more are refused.")
    max_queued_per_key: int = Field(default=200, gt=0, description="Maximum number of waiting jobs of one key.")
    max_schedules_per_key: int = Field(
        default=100, gt=0, description="Maximum number of schedules of one key, or in total if keys are not used."
    )
    max_webhooks_per_key: int = Field(
        default=100, gt=0, description="Maximum number of webhooks of one key, or in total if keys are not used."
    )
    rate_limit: str = Field(
        default="6000/minute", description="Request limit of one key or address, in the notation of the library limits."
    )
    max_event_streams: int = Field(default=200, gt=0, description="Maximum number of open event streams.")
    max_event_streams_per_key: int = Field(
        default=100, gt=0, description="Maximum number of open event streams of one key."
    )
    max_connections: int = Field(
        default=1000,
        gt=0,
        description="Maximum number of open connections, and never more than half of the files that the process may "
        "open. Beyond it idle ones are closed first; then only /healthz is answered, all else is 503.",
    )
    max_connections_per_address: int = Field(
        default=400,
        gt=0,
        description="Maximum number of open connections of one address; more are answered 503. All clients behind a "
        "proxy have its address.",
    )

    # slow and silent peers
    min_bytes_per_s: float = Field(
        default=1000.0,
        gt=0.0,
        allow_inf_nan=False,
        description="Bytes per second below which a host of inputs, a client that sends, or one that reads is too "
        "slow: its transfer ends.",
    )
    slow_s: float = Field(
        default=60.0,
        gt=0.0,
        le=3600.0,
        description="Seconds over which the rate of a host, or of a client that sends, is measured.",
    )
    unread_s: float = Field(
        default=120.0,
        gt=0.0,
        le=3600.0,
        description="The same of a client that reads; if it takes no byte of an answer for so long, it is gone. It is "
        "longer because systems take bytes in large steps.",
    )
    silent_s: float = Field(
        default=30.0,
        gt=0.0,
        le=3600.0,
        description="Seconds without a byte after which a host of inputs, or a client that sends, counts as gone.",
    )
    max_head_s: float = Field(
        default=20.0,
        gt=0.0,
        le=3600.0,
        description="Maximum seconds for the head of a request, from the connection or from its first byte on.",
    )
    max_fetch_s: float = Field(
        default=3600.0,
        gt=0.0,
        allow_inf_nan=False,
        description="Maximum seconds to fetch one input by URL, with all redirects, pauses and attempts.",
    )

    # webhooks
    webhook_hosts: tuple[str, ...] = Field(
        default=(),
        description="Hosts (name, name:port or http://name:port) to which webhooks are sent although their addresses "
        "are private or they use plain http; none by default. Public addresses need https and no entry.",
    )
    webhook_hours: float = Field(
        default=24.0, gt=0.0, le=24.0 * 30.0, description="Hours for which a webhook that fails is tried again."
    )
    webhook_pause_s: float = Field(
        default=5.0,
        gt=0.0,
        le=3600.0,
        description="Seconds before the second attempt at a webhook; each further pause is three times as long, up to "
        "4 hours.",
    )
    webhook_log_days: float = Field(
        default=30.0,
        gt=0.0,
        le=36_500.0,
        description="Days after which a finished delivery is removed from the log.",
    )
    webhook_log_max: int = Field(
        default=20_000,
        gt=0,
        description="Maximum number of finished deliveries in the log, and of failed ones; the oldest are removed.",
    )

    # the web page
    map_tiles: str | None = Field(
        default=None,
        description="URL of tiles beneath the map of the web page: https, with {z}, {x} and {y} in Web Mercator, such "
        "as https://tiles.example.org/{z}/{x}/{y}.png. None by default: the page then loads nothing from elsewhere.",
    )
    map_credit: str = Field(
        default="",
        max_length=200,
        validate_default=True,
        description="Owners of these tiles, as the map credits them; needed with `map_tiles`.",
    )
    map_max_zoom: int = Field(default=19, ge=0, le=24, description="Finest level of these tiles.")

    # the driver and its cluster
    scheduler: str | None = Field(default=None, description="Address of a Dask scheduler; default an embedded cluster.")
    tls_ca: str | None = Field(
        default=None, description="CA of the certificates of the cluster's processes, PEM; turns TLS on."
    )
    tls_cert: str | None = Field(default=None, description="The driver's own certificate for the cluster, PEM.")
    tls_key: str | None = Field(default=None, description="Its key, PEM, if it is not in the same file.")
    workers: Annotated[int, Field(ge=1, le=1024)] | Literal["auto"] = Field(
        default="auto", description="Processes of the embedded cluster; auto takes one per core."
    )
    driver_jobs: int = Field(default=2, ge=1, description="Jobs that one driver runs at once.")
    lease_s: float = Field(
        default=30.0,
        gt=0.5,
        allow_inf_nan=False,
        description="Seconds after which a silent driver's job passes to another.",
    )
    max_attempts: int = Field(
        default=3,
        ge=1,
        description="Number of lost drivers after which a job fails; also of attempts that stood still, or ended by "
        "themselves, in the same stage.",
    )
    poll_s: float = Field(
        default=0.5,
        gt=0.0,
        allow_inf_nan=False,
        description="Seconds between a driver's checks for work and for dismissals.",
    )
    stall_s: float = Field(
        default=600.0,
        gt=0.0,
        allow_inf_nan=False,
        description="Seconds without any progress of a job (a file, a task, a building) after which its process is "
        "ended and the job tried again. Stages whose steps take longer have limits of their own.",
    )
    stop_s: float = Field(
        default=5.0,
        gt=0.0,
        le=60.0,
        description="Seconds that the process of a job gets to stop, after a dismissal or SIGTERM; then it is ended.",
    )
    stalled_days: float = Field(
        default=30.0,
        ge=0.0,
        le=36_500.0,
        description="Days for which the inputs are kept of a job that failed since it stood still again and again.",
    )
    attempt_memory_bytes: int = Field(
        default=4 * _GIB,
        ge=_GIB,
        description="Resident memory at which the process of a job is stopped. It plans, and reads vector files; "
        "points are read, and buildings modelled, in other processes.",
    )
    drain_s: float = Field(
        default=30.0,
        ge=0.0,
        description="Seconds within which a driver ends after SIGTERM; `stop_s` and five seconds before, jobs that are "
        "not done are handed back, and their next attempt resumes finished stages.",
    )
    log_json: bool = Field(default=False, description="Log one JSON object per line instead of plain lines.")
    input_timeout_s: float = Field(
        default=600.0,
        gt=0.0,
        allow_inf_nan=False,
        description="Seconds within which some more of an input must be read; else the job fails.",
    )
    building_timeout_s: float = Field(
        default=600.0, gt=0.0, allow_inf_nan=False, description="Seconds after which a building's work is stopped."
    )
    building_memory_bytes: int = Field(
        default=4 * _GIB, ge=_GIB // 2, description="Resident memory at which a building's work is stopped."
    )

    @field_validator("map_tiles")
    @classmethod
    def _tiles(cls, value: str | None) -> str | None:
        """A template that can be used, and whose origin is safe in a header."""
        if value is None:
            return None
        example = "give one such as https://tiles.example.org/{z}/{x}/{y}.png"
        if re.fullmatch(r"https://[A-Za-z0-9.-]+(:[0-9]{1,5})?/[!#-;=?-~]*", value) is None:
            raise ValueError(f"{value[:80]!r} is not an https URL of plain characters: {example}")
        missing = [name for name in ("{z}", "{x}", "{y}") if value.count(name) != 1]
        if missing or len(re.findall("[{}]", value)) != 6:
            raise ValueError(f"{value[:80]!r} does not have {{z}}, {{x}} and {{y}} once each, and no other: {example}")
        return value

    @field_validator("map_credit")
    @classmethod
    def _credit(cls, value: str, info: ValidationInfo) -> str:
        """Tiles need a credit."""
        if info.data.get("map_tiles") is not None and not value.strip():
            raise ValueError("map_tiles is set: name the owners of these tiles")
        return value

    @property
    def queue_limits(self) -> QueueLimits:
        """How many jobs may wait."""
        return QueueLimits(max_queued=self.max_queued, max_queued_per_key=self.max_queued_per_key)

    @property
    def map_origin(self) -> str | None:
        """The origin of the tiles beneath the map; None without them."""
        if self.map_tiles is None:
            return None
        return "https://" + urlsplit(self.map_tiles).netloc.lower()

    @property
    def database(self) -> str:
        """The SQLAlchemy URL."""
        return self.database_url or f"sqlite:///{(self.state / 'service.db').resolve()}"

    @functools.cached_property
    def resources(self) -> Resources:
        """The resources of jobs; `workers` is None if the driver chooses.

        Raises
        ------
        SettingsError
            Certificates cannot be used.
        """
        from pipeline.runtime.cluster.tls import given_tls
        from pipeline.runtime.resources import Resources

        return Resources(
            workers=None if self.workers == "auto" else self.workers,
            scheduler=self.scheduler,
            tls=given_tls(self.tls_ca, self.tls_cert, self.tls_key),
            input_timeout_s=self.input_timeout_s,
            building_timeout_s=self.building_timeout_s,
            building_memory_bytes=self.building_memory_bytes,
        )

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach the address."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def check_address(self, *, has_keys: bool) -> None:
        """Refuse an address that others can reach if there are no keys.

        Raises
        ------
        StartUpError
            The address is not loopback and there are no keys.
        """
        if not (self.is_loopback or has_keys or self.open_without_keys):
            raise StartUpError(
                f"{self.host} can be reached from elsewhere and there are no keys: make one with "
                "`gablework keys create`, or listen on 127.0.0.1"
            )
