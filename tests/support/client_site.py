"""A service under a real server behind a gate, and clients of it."""

import contextlib
import datetime as dt
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import finished_runs as runs
from gate import Gate, gate_before
from live_service import add_key, las_bytes, serving, settings_in
from migrated import with_tables
from processes import wait_for

from service.client import AsyncClient, Client, UploadMemory
from service.files import StateFolder
from service.jobs import Job, JobEvent, JobRequest
from service.keys import Scope
from service.resumable import PREFIX
from service.store import JobStore

LARGE = las_bytes(200_000, compressed=False)
"""Some megabytes: more than the buffers of a connection."""

OUTLINES = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": {"type":
"Polygon", "coordinates": [[[84001, 447001], [84009, 447001], [84009, 447009], [84001, 447001]]]}}]}"""
"""A file of footprints."""
LINES = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": {"type":
"LineString", "coordinates": [[84001, 447001], [84009, 447001]]}}]}"""
"""A file of guides."""


class Site:
    """A service, what it holds, and clients that reach it through a gate."""

    def __init__(self, folder: Path, gate: Gate, store: JobStore, stack: contextlib.ExitStack) -> None:
        self.settings = settings_in(folder, poll_s=0.01)
        self.folder = folder
        self.gate = gate
        self.store = store
        self.runs = runs.Service(client=None, store=store, folder=StateFolder(self.settings.state))  # type: ignore[arg-type]
        self.cache = folder / "cache"
        self.url = ""
        """The service itself, not behind the gate."""
        self.said: list[str] = []
        """What clients have reported."""
        self._stack = stack
        self._serving = contextlib.ExitStack()

    @classmethod
    @contextlib.contextmanager
    def opened(cls, folder: Path) -> Iterator[Self]:
        """A site whose service answers."""
        with contextlib.ExitStack() as stack:
            store = stack.enter_context(JobStore(with_tables(settings_in(folder).database)))
            # the gate leads nowhere until the service is there
            gate = stack.enter_context(gate_before("http://127.0.0.1:9"))
            site = cls(folder, gate, store, stack)
            stack.callback(site.stop)
            site.start()
            yield site

    def start(self, **values: Any) -> None:
        """Start the service, on another port than before; values change its settings."""
        self.settings = self.settings.model_copy(update=values)
        self.url = self._serving.enter_context(serving(self.settings))
        self.gate.lead_to(self.url)
        self.gate.shut(False)

    def cut(self) -> None:
        """End all connections, and wait until the bytes of an upload that have passed are stored.

        A service that is busy may read them later than the client asks how many there are; the client then sends some
        of them again.
        """
        before = self._stored_bytes()
        self.gate.cut()
        wait_for(lambda: self._stored_bytes() > before, "the bytes that have passed")

    def _stored_bytes(self) -> int:
        """Bytes of unfinished uploads whose requests have ended."""
        places = self.runs.folder.uploads.glob(f"{PREFIX}*/progress.json")
        return sum(json.loads(place.read_text())["synced_bytes"] for place in places)

    def stop(self) -> None:
        """Stop the service; new connections are refused."""
        self.gate.shut(True)
        self.gate.cut()
        self._serving.close()

    def restart(self, **values: Any) -> None:
        """Stop and start."""
        self.stop()
        self.start(**values)

    def client(self, **options: Any) -> Client:
        """A client; all of them remember the same uploads."""
        return self._stack.enter_context(Client(self.gate.url, **self._options(options)))

    def async_client(self, **options: Any) -> AsyncClient:
        """The same for an event loop."""
        return AsyncClient(self.gate.url, **self._options(options))

    def _options(self, given: dict[str, Any]) -> dict[str, Any]:
        memory = UploadMemory(self.cache / "gablework" / "uploads")
        return {"patience_s": 60.0, "notify": self.said.append, "memory": memory, **given}

    def key(self, scope: Scope) -> str:
        """A new key."""
        return add_key(self.settings, scope)[1].removeprefix("Bearer ")

    def file(self, name: str = "tile.las", content: bytes = LARGE) -> Path:
        """A file to send."""
        path = self.folder / name
        path.write_bytes(content)
        return path

    def stored(self) -> list[Any]:
        """The records of all finished uploads."""
        return self.store.list_uploads(limit=1000)

    def claimed(self) -> Job:
        """The job that waits longest, held by a driver."""
        job = self.store.claim("a driver", lease_s=3600.0, max_attempts=3)
        assert job is not None
        return job

    def echoed(self, **request: Any) -> Job:
        """A job that waits."""
        asked = JobRequest(process_id="echo", tiles=(), echo={"message": "hello", "delay": 0.0}, **request)
        return self.store.create(asked, owner=None)


def event(kind: str, **values: Any) -> JobEvent:
    """An event that a driver reports."""
    return JobEvent(sequence=0, at=dt.datetime.now(tz=dt.UTC), kind=kind, **values)
