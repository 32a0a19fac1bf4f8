"""Resumable uploads: what has arrived is kept and never damaged, whatever ends a request, and by whom."""

import asyncio
import contextlib
import datetime as dt
import errno
import hashlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from live_service import DEADLINE_S, las_bytes, raw_request, serving, settings_in
from migrated import with_tables
from processes import free_port, program, wait_for
from starlette.requests import ClientDisconnect
from tus_client import CONTENT, LARGE, PATCH, TUS, begin, names_in, offset, offset_once_free, send

from service import arrivals, resumable
from service.errors import UploadBusyError
from service.files import StateFolder
from service.keys import Scope
from service.resumable import Promise, Unfinished
from service.store import JobStore
from service.uploads import BLOCK_BYTES

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)


@pytest.fixture
def client(local_service: Any) -> httpx.Client:
    return local_service.client


@pytest.fixture
def live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[httpx.Client]:
    """A client of a real server, which soon ends a request of a silent client."""
    monkeypatch.setattr(arrivals, "SILENT_S", 0.2)
    with serving(settings_in(tmp_path)) as url, httpx.Client(base_url=url, timeout=DEADLINE_S) as client:
        yield client


# --- two requests at once


def test_of_many_requests_at_once_one_wins_and_the_file_is_its_own(
    live: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrivals, "SILENT_S", DEADLINE_S)  # no client counts as gone, however busy the machine is
    content = [bytes([number]) * len(CONTENT) for number in range(8)]
    url = begin(live, **{"Upload-Length": str(len(CONTENT) + 1)})

    def one(number: int) -> int:
        return send(live, url, 0, content[number]).status_code

    with ThreadPoolExecutor(len(content)) as pool:
        answers = list(pool.map(one, range(len(content))))
    assert answers.count(204) == 1
    assert set(answers) <= {204, 409, 423}
    assert offset(live, url) == len(CONTENT)
    assert _data_file(tmp_path).read_bytes() == content[answers.index(204)]


def test_a_request_while_another_finishes_the_upload_is_refused(
    live: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered, go_on, examined = threading.Event(), threading.Event(), arrivals.examined

    async def slow(*values: Any, **named: Any) -> Any:
        entered.set()
        await arrivals.anyio.to_thread.run_sync(go_on.wait)
        return await examined(*values, **named)

    monkeypatch.setattr(arrivals, "examined", slow)
    url = begin(live)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(send, live, url, 0, CONTENT)
        assert entered.wait(DEADLINE_S)
        for method in ("HEAD", "DELETE"):
            refused = live.request(method, url, headers=TUS)
            assert (refused.status_code, refused.headers["retry-after"]) == (423, "1"), method
        assert send(live, url, 0, CONTENT).status_code == 423
        go_on.set()
        assert first.result(DEADLINE_S).status_code == 204
    assert offset(live, url) == len(CONTENT)


def test_a_request_that_another_process_holds_is_refused(client: httpx.Client, local_service: Any) -> None:
    folder, url = StateFolder(local_service.settings.state), begin(client)
    held = Unfinished(folder, resumable.find(folder, url.rpartition("/")[2], None))
    assert send(client, url, 0, CONTENT).status_code == 423
    assert client.head(url, headers=TUS).status_code == 423
    held.close()
    assert send(client, url, 0, CONTENT).status_code == 204


def _partly(client: httpx.Client, url: str, content: bytes, **headers: str) -> Any:
    """A connection over which only some of an upload comes."""
    head = {**PATCH, "Upload-Offset": "0", "Content-Length": str(len(CONTENT)), **headers}
    path = httpx.URL(url).path
    return raw_request(
        str(client.base_url), f"PATCH {path}", content, **{name.replace("-", "_"): v for name, v in head.items()}
    )


def _data_file(tmp_path: Path) -> Path:
    (found,) = (tmp_path / "state" / "uploads").glob(".tus-*/file/*")
    return found


def test_a_broken_connection_keeps_what_has_arrived(live: httpx.Client, tmp_path: Path) -> None:
    url = begin(live, **{"Upload-Length": str(len(LARGE))})
    with _partly(live, url, LARGE[: 2 * BLOCK_BYTES], **{"Content-Length": str(len(LARGE))}):
        wait_for(lambda: _data_file(tmp_path).stat().st_size >= BLOCK_BYTES, "the first block")
    at = offset_once_free(live, url)
    assert at >= BLOCK_BYTES
    assert send(live, url, at, LARGE[at:]).status_code == 204
    assert live.get(f"/uploads/{url.rpartition('/')[2]}").json()["sha256"] == hashlib.sha256(LARGE).hexdigest()


@pytest.mark.parametrize(("checksum", "kept"), [(None, 1000), (("sha1", b"0" * 20), 0)])
@pytest.mark.parametrize("fault", [ClientDisconnect, asyncio.CancelledError])
def test_whatever_ends_a_request_its_bytes_are_kept_to_the_last_but_not_those_with_a_checksum(
    folder: StateFolder, checksum: tuple[str, bytes] | None, kept: int, fault: type[BaseException]
) -> None:
    async def ending() -> AsyncIterator[bytes]:
        yield CONTENT[:600]
        yield CONTENT[600:1000]
        raise fault

    async def interrupted() -> int:
        with JobStore(with_tables(settings_in(folder.root).database)) as store:
            arriving = arrivals.Arrivals(store, folder, settings_in(folder.root))
            made = await arriving.create("a.laz", 5000, sha256=None, metadata="", owner=None)
            part = arrivals.Part(stream=ending(), offset=0, length=5000, checksum=checksum)
            with contextlib.suppress(asyncio.CancelledError):
                await arriving.append(made.upload_id, part, owner=None)
            return (await arriving.state(made.upload_id, owner=None)).offset

    assert asyncio.run(interrupted()) == kept


def test_a_client_that_goes_on_sending_is_not_overtaken(folder: StateFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrivals, "SILENT_S", 0.2)

    async def drops(ended: asyncio.Event) -> AsyncIterator[bytes]:
        while not ended.is_set():
            yield b"x"
            await asyncio.sleep(0)

    async def contested() -> tuple[int, int]:
        ended = asyncio.Event()
        with JobStore(with_tables(settings_in(folder.root).database)) as store:
            arriving = arrivals.Arrivals(store, folder, settings_in(folder.root))
            made = await arriving.create("a.laz", 10**9, sha256=None, metadata="", owner=None)
            part = arrivals.Part(stream=drops(ended), offset=0)
            first = asyncio.create_task(arriving.append(made.upload_id, part, owner=None))
            while made.upload_id not in arriving._holders:
                await asyncio.sleep(0)
            with pytest.raises(UploadBusyError):
                await arriving.state(made.upload_id, owner=None)
            ended.set()
            state = await first
            return state.offset, (await arriving.state(made.upload_id, owner=None)).offset

    sent, found = asyncio.run(contested())
    assert sent == found > 0


def test_a_client_that_fell_silent_is_overtaken_and_its_bytes_are_kept(live: httpx.Client, tmp_path: Path) -> None:
    content = LARGE
    url = begin(live, **{"Upload-Length": str(len(content))})
    with _partly(live, url, content[: BLOCK_BYTES + 1000], **{"Content-Length": str(len(content))}) as silent:
        wait_for(lambda: _data_file(tmp_path).stat().st_size >= BLOCK_BYTES, "the first block")
        at = offset_once_free(live, url)
        assert at >= BLOCK_BYTES
        assert send(live, url, at, content[at:]).status_code == 204
        assert silent.recv(100).split()[1] == b"423"
    assert live.get(f"/uploads/{url.rpartition('/')[2]}").json()["sha256"] == hashlib.sha256(content).hexdigest()


def test_a_stranger_overtakes_no_one(starting: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrivals, "SILENT_S", 0.0)
    service = starting()
    owner, other = service.key(Scope.SUBMIT), service.key(Scope.SUBMIT)
    content = LARGE
    with serving(service.settings) as url, httpx.Client(base_url=url, timeout=DEADLINE_S) as live:
        place = begin(live, **owner, **{"Upload-Length": str(len(content))})
        headers = {**owner, "Content-Length": str(len(content))}
        with _partly(live, place, content[:BLOCK_BYTES], **headers) as link:
            wait_for(lambda: _data_file(tmp_path).stat().st_size >= BLOCK_BYTES, "the first block")
            assert live.head(place, headers={**TUS, **other}).status_code == 404
            link.sendall(content[BLOCK_BYTES:])
            assert link.recv(100).split()[1] == b"204"


# --- what ends a service


def _unfinished(folder: StateFolder, size: int = 100) -> Promise:
    promise = Promise(
        upload_id=resumable.new_id(), owner=None, filename="a.laz", size_bytes=size, sha256=None, metadata=""
    )
    resumable.create(folder, promise, NOW, most=10)
    return promise


def _opened(folder: StateFolder, promise: Promise) -> Unfinished:
    found = Unfinished(folder, promise)
    found.recover()
    return found


@pytest.fixture
def folder(tmp_path: Path) -> StateFolder:
    StateFolder(tmp_path).make()
    return StateFolder(tmp_path)


@pytest.mark.parametrize("is_same_boot", [True, False])
def test_after_a_loss_of_power_only_what_was_synced_counts_after_a_killed_process_all(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch, is_same_boot: bool
) -> None:
    promise = _unfinished(folder)
    first = _opened(folder, promise)
    first.begin(NOW, is_checked=False)
    first.write(b"a" * 30)
    first.end()
    first.begin(NOW, is_checked=False)
    first.write(b"b" * 20)
    first.close()
    if not is_same_boot:
        other = folder.root / "boot"
        other.write_text("another boot")
        monkeypatch.setattr(resumable, "_BOOT", other)
    second = _opened(folder, promise)
    assert second.offset == (50 if is_same_boot else 30)
    second.begin(NOW, is_checked=False)
    second.write(b"c" * 10)
    second.end()
    assert second.path.read_bytes() == b"a" * 30 + b"b" * (20 if is_same_boot else 0) + b"c" * 10
    second.close()


def test_a_process_killed_over_bytes_with_a_checksum_leaves_none_of_them(folder: StateFolder) -> None:
    promise = _unfinished(folder)
    first = _opened(folder, promise)
    first.begin(NOW, is_checked=True)
    first.write(b"a" * 30)
    first.close()
    assert _opened(folder, promise).offset == 0


def test_a_long_request_is_synced_on_the_way(folder: StateFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resumable, "SYNC_BYTES", 20)
    monkeypatch.setattr(resumable, "_BOOT", folder.root / "unknown")
    promise = _unfinished(folder)
    held = _opened(folder, promise)
    held.begin(NOW, is_checked=False)
    for _ in range(5):
        held.write(b"a" * 9)
    held.close()
    assert _opened(folder, promise).offset == 27


def test_a_disk_that_fails_to_sync_takes_back_what_is_uncertain(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_number: int) -> None:
        raise OSError(errno.EIO, "cannot write")

    promise = _unfinished(folder)
    held = _opened(folder, promise)
    held.begin(NOW, is_checked=False)
    held.write(b"a" * 9)
    held.end()
    held.begin(NOW, is_checked=False)
    held.write(b"a" * 9)
    with monkeypatch.context() as failing:
        failing.setattr(os, "fdatasync", fail)
        with pytest.raises(OSError, match="cannot write"):
            held.end()
    held.close()
    assert _opened(folder, promise).offset == 9


def test_a_full_disk_keeps_what_it_has_and_the_upload_goes_on_later(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_self: Unfinished, _block: bytes) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    url = begin(client)
    assert send(client, url, 0, CONTENT[:1000]).status_code == 204
    with monkeypatch.context() as filled:
        filled.setattr(Unfinished, "write", full)
        answer = send(client, url, 1000, CONTENT[1000:])
    assert answer.status_code == 507
    assert "no room on the disk for the upload. Remove finished jobs or uploads" in answer.json()["detail"]
    assert offset(client, url) == 1000
    assert send(client, url, 1000, CONTENT[1000:]).status_code == 204


def test_if_the_record_cannot_be_stored_the_bytes_stay_and_head_finishes_later(
    client: httpx.Client, local_service: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(_upload: Any) -> None:
        raise arrivals.NoSpaceError("the database is full")

    url = begin(client)
    with monkeypatch.context() as broken:
        broken.setattr(local_service.store, "add_uploads", away)
        assert send(client, url, 0, CONTENT).status_code == 507
        assert client.head(url, headers=TUS).status_code == 507
    assert offset(client, url) == len(CONTENT)
    assert client.get(f"/uploads/{url.rpartition('/')[2]}").json()["sha256"] == hashlib.sha256(CONTENT).hexdigest()


@pytest.mark.parametrize("has_record", [False, True])
def test_a_process_that_died_over_the_last_step_leaves_a_whole_upload(
    client: httpx.Client, local_service: Any, monkeypatch: pytest.MonkeyPatch, has_record: bool
) -> None:
    class KilledError(BaseException):
        """Ends the last step where a killed process would."""

    url = begin(client)
    upload_id = url.rpartition("/")[2]
    state = StateFolder(local_service.settings.state)
    assert send(client, url, 0, CONTENT[:-1]).status_code == 204
    if has_record:
        monkeypatch.setattr(Unfinished, "remove", lambda _self: None)
        assert send(client, url, len(CONTENT) - 1, CONTENT[-1:]).status_code == 204
        monkeypatch.undo()
    else:
        held = _opened(state, resumable.find(state, upload_id, None))
        held.begin(NOW, is_checked=False)
        held.write(CONTENT[-1:])
        held.end()
        held.path.parent.rename(state.upload(upload_id))
        held.close()
    assert (state.uploads / f".tus-{upload_id}").is_dir()
    assert offset(client, url) == len(CONTENT)
    assert client.get(f"/uploads/{upload_id}").json()["sha256"] == hashlib.sha256(CONTENT).hexdigest()
    assert (state.upload(upload_id) / "tile.laz").read_bytes() == CONTENT
    assert names_in(local_service) == [upload_id]


def test_two_processes_never_hold_one_upload(folder: StateFolder) -> None:
    promise = _unfinished(folder)
    held = Unfinished(folder, promise)
    code = (
        "import sys; from pathlib import Path; from service.files import StateFolder; from service import resumable\n"
        "folder = StateFolder(Path(sys.argv[1]))\n"
        "try: resumable.Unfinished(folder, resumable.find(folder, sys.argv[2], None)); print('held')\n"
        "except resumable.UploadBusyError: print('busy')"
    )
    command = [sys.executable, "-c", code, str(folder.root), promise.upload_id]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "busy\n"
    with pytest.raises(UploadBusyError):
        Unfinished(folder, promise)
    held.close()
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "held\n"


@pytest.mark.slow
def test_a_killed_server_goes_on_where_the_bytes_end(tmp_path: Path) -> None:
    content = las_bytes(1_000_000)
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    command = [str(program("gablework")), "serve", "--no-driver", "--port", str(port)]
    command += ["--state", str(tmp_path / "state")]

    def started() -> subprocess.Popen[bytes]:
        server = subprocess.Popen(command)

        def answers() -> bool:
            try:
                return httpx.get(f"{url}/healthz").is_success
            except httpx.TransportError:
                return False

        wait_for(answers, "an answer")
        return server

    server = started()
    try:
        with httpx.Client(base_url=url, timeout=DEADLINE_S) as client:
            place = begin(client, **{"Upload-Length": str(len(content))})
            with _partly(client, place, content[:1_500_000], **{"Content-Length": str(len(content))}):
                wait_for(lambda: _data_file(tmp_path).stat().st_size >= 1_000_000, "a million bytes")
                server.send_signal(signal.SIGKILL)
                server.wait(DEADLINE_S)
        server = started()
        with httpx.Client(base_url=url, timeout=DEADLINE_S) as client:
            at = offset(client, place)
            assert 1_000_000 <= at <= 1_500_000
            assert send(client, place, at, content[at:]).status_code == 204
            record = client.get(f"/uploads/{place.rpartition('/')[2]}").json()
            assert record["sha256"] == hashlib.sha256(content).hexdigest()
    finally:
        server.kill()
        server.wait(DEADLINE_S)
