"""The client against a real service: over broken connections, restarts and refusals."""

import asyncio
import dataclasses
import hashlib
import inspect
import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from client_site import LARGE, Site, event
from live_service import DEADLINE_S, POINTS
from processes import LONG_S, wait_for

from pipeline.errors import InputError, RunError, SettingsError
from service import client as api
from service.client import AsyncClient, Client
from service.client import client_answers as answers
from service.client.events import EventParser
from service.jobs import Fault, JobFailure, JobStatus
from service.keys import Scope
from service.wire.jobs import Event, StatusInfo
from service.wire.problems import Problem

SHA256 = hashlib.sha256(LARGE).hexdigest()


@pytest.fixture
def beside() -> Iterator[ThreadPoolExecutor]:
    """Threads for calls that the test interrupts."""
    with ThreadPoolExecutor(4) as threads:
        yield threads


# --- uploads


def test_an_upload_goes_on_over_broken_connections(site: Site, beside: ThreadPoolExecutor) -> None:
    site.gate.allow(len(LARGE) // 6)
    sent = beside.submit(site.client().upload, site.file())
    for _ in range(4):
        site.gate.wait_until_used_up(DEADLINE_S)
        site.cut()
        site.gate.allow(len(LARGE) // 6)
    site.gate.allow(float("inf"))
    record = site.store.upload(sent.result(DEADLINE_S))
    assert (record.sha256, record.filename) == (SHA256, "tile.las")
    assert site.gate.passed_bytes < 1.2 * len(LARGE)
    assert any("does not answer" in sentence for sentence in site.said)


def test_a_call_that_was_interrupted_continues_in_another_process(site: Site, beside: ThreadPoolExecutor) -> None:
    path = site.file()
    site.gate.allow(len(LARGE) // 2)
    first = beside.submit(site.client(patience_s=0.0).upload, path)
    site.gate.wait_until_used_up(DEADLINE_S)
    site.gate.shut(True)
    site.cut()
    with pytest.raises(api.UnreachableError):
        first.result(DEADLINE_S)
    site.gate.allow(float("inf"))
    site.gate.shut(False)
    upload_id = site.client().upload(path)
    assert [record.upload_id for record in site.stored()] == [upload_id]
    assert site.gate.passed_bytes < 1.2 * len(LARGE)
    # it is whole now, and costs two requests without bytes
    before = site.gate.passed_bytes
    assert site.client().upload(path) == upload_id
    assert site.gate.passed_bytes - before < 2000


def test_an_upload_goes_on_after_a_restart_of_the_service(site: Site, beside: ThreadPoolExecutor) -> None:
    site.gate.allow(len(LARGE) // 2)
    sent = beside.submit(site.client().upload, site.file())
    site.gate.wait_until_used_up(DEADLINE_S)
    site.stop()
    site.gate.allow(float("inf"))
    site.start()
    assert site.store.upload(sent.result(DEADLINE_S)).sha256 == SHA256


def test_a_file_that_has_changed_or_was_removed_there_is_sent_anew(site: Site) -> None:
    path, client = site.file("points.xyz", POINTS), site.client()
    first = client.upload(path)
    site.store.remove_upload(first)
    second = client.upload(path)
    path.write_bytes(POINTS + b"84010.0 447010.0 4.5\n")
    third = client.upload(path)
    assert len({first, second, third}) == 3
    assert {record.upload_id for record in site.stored()} == {second, third}


def test_a_file_that_changes_while_it_is_sent_is_reported(site: Site, beside: ThreadPoolExecutor) -> None:
    path = site.file()
    site.gate.allow(len(LARGE) // 2)
    sent = beside.submit(site.client().upload, path)
    site.gate.wait_until_used_up(DEADLINE_S)
    os.utime(path, ns=(0, 0))
    site.gate.cut()
    site.gate.allow(float("inf"))
    with pytest.raises(InputError, match="changed while it was sent"):
        sent.result(DEADLINE_S)


def test_the_memory_of_uploads_holds_no_key_and_is_the_users_alone(site: Site) -> None:
    key = site.key(Scope.SUBMIT)
    site.client(key=key).upload(site.file("points.xyz", POINTS))
    entries = list((site.cache / "gablework" / "uploads").iterdir())
    assert len(entries) == 1
    assert key not in entries[0].read_text() + entries[0].name
    assert entries[0].parent.stat().st_mode & 0o077 == 0
    # another key sees nothing of it, so it sends the file anew
    site.client(key=site.key(Scope.SUBMIT)).upload(site.folder / "points.xyz")
    assert len(site.stored()) == 2


@pytest.mark.parametrize("content", ["", "no JSON", "[]", '{"upload": 5}'])
def test_a_damaged_memory_costs_no_more_than_sending_again(site: Site, content: str) -> None:
    path = site.file("points.xyz", POINTS)
    site.client().upload(path)
    (entry,) = (site.cache / "gablework" / "uploads").iterdir()
    entry.write_text(content)
    assert site.client().upload(path) == site.stored()[0].upload_id


def test_a_cache_that_cannot_be_written_is_reported_and_the_file_is_sent(site: Site) -> None:
    site.cache.write_text("a file where the folder would be")
    site.client().upload(site.file("points.xyz", POINTS))
    assert len(site.stored()) == 1
    assert any("the cache cannot be written" in sentence for sentence in site.said)


@pytest.mark.parametrize(("name", "said"), [("no.laz", "no.laz"), ("empty.laz", "is empty"), (".", "is a folder")])
def test_a_file_that_cannot_be_sent_is_named(site: Site, name: str, said: str) -> None:
    (site.folder / "empty.laz").touch()
    with pytest.raises(InputError, match=said):
        site.client().upload(site.folder / name)


def test_a_refused_file_is_reported_each_time_with_its_fault(site: Site) -> None:
    path = site.file("bad.laz", b"not a tile" * 100)
    for _ in range(2):
        with pytest.raises(api.RefusedError, match=r"bad\.laz") as caught:
            site.client().upload(path)
        assert caught.value.problem.kind == "unusable-input"
    assert site.stored() == []


# --- submission


def test_an_equal_submission_gives_the_same_job_and_another_one_does_not(site: Site) -> None:
    path = site.file("points.xyz", POINTS)
    first = site.client().submit(path, crs="EPSG:28992", title="one")
    assert (first.status, first.process, first.title) == ("accepted", "reconstruct", "one")
    again = site.client().submission([path], process="reconstruct", inputs={"title": "one", "crs": "EPSG:28992"})
    assert (again.job.id, again.is_new) == (first.id, False)
    other = site.client().submit(path, crs="EPSG:28992", title="two")
    new = site.client().submit(path, crs="EPSG:28992", title="one", new=True)
    assert len({first.id, other.id, new.id}) == 3
    assert len(site.stored()) == 1


@pytest.mark.parametrize("fate", ["dismissed", "failed", "gone"])
def test_a_job_that_has_no_result_is_not_given_again(site: Site, fate: str) -> None:
    path, client = site.file("points.xyz", POINTS), site.client()
    first = client.submit(path, crs="EPSG:28992")
    if fate == "failed":
        site.store.fail(site.claimed(), JobFailure(fault=Fault.CLUSTER, detail="no workers"))
    else:
        assert client.cancel(first).status == "dismissed"
    if fate == "gone":
        client.remove(first)
    second = client.submit(path, crs="EPSG:28992")
    assert second.id != first.id
    assert client.submit(path, crs="EPSG:28992").id == second.id


def test_a_submission_whose_answer_is_lost_makes_one_job(site: Site, beside: ThreadPoolExecutor) -> None:
    client = site.client()
    upload = f"/uploads/{client.upload(site.file('points.xyz', POINTS))}"
    site.gate.allow(0, back=True)
    made = beside.submit(client.submit, upload, crs="EPSG:28992")
    wait_for(lambda: site.store.counts()[JobStatus.ACCEPTED] == 1, "the job")
    site.gate.cut()
    site.gate.allow(float("inf"), back=True)
    assert site.store.get(made.result(DEADLINE_S).id).status is JobStatus.ACCEPTED
    assert sum(site.store.counts().values()) == 1


def test_other_processes_take_their_own_inputs(site: Site) -> None:
    path, client = site.file("points.xyz", POINTS), site.client()
    compared = client.submit(path, process="compare", crs="EPSG:28992", methods=["kmeans", "fuzzy-sart"])
    classified = client.submit(path, process="classify", crs="EPSG:28992", rasterCell=1.0, outputs=["points"])
    echoed = client.submit([], process="echo", message="hello")
    assert [compared.process, classified.process, echoed.process] == ["compare", "classify", "echo"]
    assert list(classified.document["request"]["outputs"]) == ["points"]
    with pytest.raises(SettingsError, match="not a JSON value"):
        client.submit([], process="echo", message=object())


# --- watching


def test_a_watch_goes_on_across_a_restart_and_misses_nothing(site: Site, beside: ThreadPoolExecutor) -> None:
    waiting = site.echoed()
    job, seen = site.claimed(), []
    ended = beside.submit(site.client().wait, waiting.job_id, on_event=seen.append)
    site.store.record(job, [event("warning", message="before")])
    wait_for(lambda: "before" in [one.message for one in seen], "the first events")
    site.stop()
    site.store.record(job, [event("warning", message="meanwhile")])
    site.start()
    site.store.record(job, [event("warning", message="after", progress=70)])
    wait_for(lambda: "after" in [one.message for one in seen], "the events after the restart")
    site.store.succeed(job, message="done", summary={"digest": "d"})
    found = ended.result(DEADLINE_S)
    assert (found.status, found.message, found.summary) == ("successful", "done", {"digest": "d"})
    assert [one.message for one in seen if one.kind == "warning"] == ["before", "meanwhile", "after"]
    assert [one.status for one in seen if one.kind == "status"] == ["accepted", "running", "successful"]
    assert [one.id for one in seen] == sorted({one.id for one in seen})


def test_a_watch_can_be_left_and_begun_later(site: Site) -> None:
    site.echoed()
    job = site.claimed()
    site.store.succeed(job, message="done", summary={})
    events = site.client().watch(job.job_id)
    first = next(events)
    events.close()
    rest = list(site.client().watch(job.job_id, after=first.id))
    assert [one.status for one in (first, *rest)] == ["accepted", "running", "successful"]
    assert list(site.client().watch(job.job_id, after=rest[-1].id)) == []


def test_the_end_of_a_job_without_success_is_an_error_with_its_reason(site: Site) -> None:
    site.echoed()
    failed = site.claimed()
    site.store.fail(failed, JobFailure(fault=Fault.INPUT, detail="a.laz: truncated. Send it again"))
    with pytest.raises(api.JobFailedError, match=r"a\.laz: truncated\. Send it again") as caught:
        site.client().wait(failed.job_id)
    assert caught.value.job.problem is not None
    assert caught.value.job.problem.kind == "job-failed-input"
    with pytest.raises(api.JobFailedError, match="truncated"):
        site.client().fetch(failed.job_id, site.folder / "out")
    waiting = site.echoed().job_id
    assert site.client().cancel(waiting).status == "dismissed"
    with pytest.raises(api.JobDismissedError):
        site.client().wait(waiting)
    with pytest.raises(api.NotFoundError):
        site.client().wait("0" * 32)


def test_a_stream_in_any_pieces_gives_the_same_messages() -> None:
    stream = 'retry: 2000\n\nevent: a\nid: 1\ndata: {"x": "ü"}\n\n: keep alive\n\ndata: {}\r\n\r\ndata: cut'.encode()
    for size in range(1, len(stream) + 1):
        parser = EventParser()
        pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
        assert [text for piece in pieces for text in parser.feed(piece)] == ['{"x": "ü"}', "{}"], size


# --- results


def large_job(site: Site) -> tuple[str, bytes]:
    """A job with one large output."""
    content = os.urandom(3_000_000)

    def write(folder: Path) -> None:
        from finished_runs import write_run

        write_run(folder)

    job_id = site.runs.finished(write, outputs=("report",))
    folder = site.runs.folder.outputs(job_id, 1)
    catalogue = json.loads((folder / "outputs.json").read_text())
    (folder / "report.json").write_bytes(content)
    entry = catalogue["outputs"]["report"]
    entry |= {"size_bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    (folder / "outputs.json").write_text(json.dumps(catalogue))
    return job_id, content


def test_a_fetch_goes_on_over_broken_connections_and_in_another_call(site: Site, beside: ThreadPoolExecutor) -> None:
    job_id, content = large_job(site)
    out = site.folder / "out"
    site.gate.allow(len(content) // 3, back=True)
    first = beside.submit(site.client(patience_s=0.0).fetch, job_id, out)
    site.gate.wait_until_used_up(DEADLINE_S, back=True)
    site.gate.shut(True)
    site.gate.cut()
    with pytest.raises(api.UnreachableError):
        first.result(DEADLINE_S)
    assert [path.suffix for path in out.iterdir()] == [".part"]
    site.gate.shut(False)
    site.gate.allow(len(content) // 3, back=True)
    second = beside.submit(site.client().fetch, job_id, out)
    site.gate.wait_until_used_up(DEADLINE_S, back=True)
    site.gate.cut()
    site.gate.allow(float("inf"), back=True)
    (file,) = second.result(DEADLINE_S)
    assert (file.path, file.is_new, file.path.read_bytes() == content) == (out / "report.json", True, True)
    assert [path.name for path in out.iterdir()] == ["report.json"]
    assert site.gate.passed_back_bytes < 1.2 * len(content)


def test_what_is_here_is_not_fetched_again_and_other_files_are_not_replaced(site: Site) -> None:
    job_id = site.runs.finished()
    out, client = site.folder / "out", site.client()
    found = client.fetch(job_id, out)
    assert {file.output.id for file in found} == {output.id for output in client.results(job_id)}
    assert all(file.is_new and file.path.stat().st_size == file.output.size_bytes for file in found)
    assert {file.path.name for file in found} >= {"buildings.parquet", "report.json", "meshes.zip"}
    before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    assert not any(file.is_new for file in client.fetch(job_id, out))
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == before
    (out / "report.json").write_text("notes of mine")
    with pytest.raises(RunError, match="another content"):
        client.fetch(job_id, out, ["report"])
    assert (out / "report.json").read_text() == "notes of mine"
    (file,) = client.fetch(job_id, out, ["report"], overwrite=True)
    assert hashlib.sha256(file.path.read_bytes()).hexdigest() == file.output.sha256


@pytest.mark.parametrize("left", [0, 1000, 3_000_000, 3_000_001])
def test_bytes_that_are_not_those_of_the_result_are_never_kept(site: Site, left: int) -> None:
    job_id, content = large_job(site)
    out = site.folder / "out"
    out.mkdir()
    part = out / f".report.json.{hashlib.sha256(content).hexdigest()[:16]}.part"
    part.write_bytes(b"x" * left)
    (file,) = site.client().fetch(job_id, out)
    assert file.path.read_bytes() == content
    assert [path.name for path in out.iterdir()] == ["report.json"]


def test_a_result_that_always_arrives_damaged_is_an_error(site: Site) -> None:
    job_id, content = large_job(site)
    stored = site.runs.folder.outputs(job_id, 1) / "report.json"
    stored.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(api.DamagedError, match=r"report\.json"):
        site.client().fetch(job_id, site.folder / "out")
    assert list((site.folder / "out").iterdir()) == []


def test_the_results_of_each_method_of_a_comparison_have_names_of_their_own(site: Site) -> None:
    job_id = site.runs.compared()
    client, out = site.client(), site.folder / "out"
    assert {"page", "table", "summary", "archive"} == {output.id for output in client.results(job_id)}
    client.fetch(job_id, out, ["summary"])
    client.fetch(job_id, out, ["report"], method="fuzzy-sart-faithful")
    assert {path.name for path in out.iterdir()} == {"compare.json", "fuzzy-sart-faithful-report.json"}


def test_results_of_a_job_that_was_submitted_as_raw_are_the_same(site: Site) -> None:
    raw, plain = (site.runs.finished(response=kind, outputs=("report", "planes")) for kind in ("raw", "document"))
    client, out = site.client(), site.folder / "out"
    assert [file.path.name for file in client.fetch(raw, out)] == ["planes.parquet", "report.json"]
    found, expected = ({one.id: one.media_type for one in client.results(job)} for job in (raw, plain))
    assert found == expected
    assert [file.output.id for file in client.fetch(raw, out / "one", ["report"])] == ["report"]


def test_results_that_are_not_there_are_explained(site: Site) -> None:
    job_id, waiting = site.runs.finished(outputs=("report",)), site.echoed().job_id
    with pytest.raises(api.NotFoundError, match="report"):
        site.client().fetch(job_id, site.folder, ["buildings"])
    with pytest.raises(api.NotFoundError) as caught:
        site.client().fetch(waiting, site.folder)
    assert caught.value.problem.kind == "result-not-ready"
    (site.folder / "file").touch()
    with pytest.raises(RunError, match="cannot be written"):
        site.client().fetch(job_id, site.folder / "file" / "out")


# --- jobs


def test_cancel_never_removes_what_is_over(site: Site) -> None:
    job_id, client = site.runs.finished(), site.client()
    assert client.cancel(job_id).status == "successful"
    assert client.keep(job_id).keep
    assert not client.keep(job_id, keep=False).keep
    waiting = site.echoed().job_id
    with pytest.raises(SettingsError, match="cancel it first"):
        client.remove(waiting)
    assert client.cancel(waiting).status == "dismissed"
    again = client.retry(waiting, message="again")
    assert again.document["request"]["inputs"]["message"] == "again"
    client.remove(job_id)
    with pytest.raises(api.NotFoundError):
        client.job(job_id)


@pytest.mark.parametrize("job_id", ["", "../uploads", "a/b", "a?f=html"])
def test_what_is_no_id_is_not_sent(site: Site, job_id: str) -> None:
    with pytest.raises(SettingsError, match="give its id"):
        site.client().cancel(job_id)


def test_any_other_request_has_the_key_and_the_errors(site: Site) -> None:
    client = site.client(key=site.key(Scope.ADMIN))
    body = {"url": "https://hooks.example.org/a", "events": ["job.failed"]}
    made = client.request("POST", "/webhooks", document=body)
    assert client.request("GET", "webhooks", params={"limit": 1})["webhooks"][0]["url"] == body["url"]
    assert client.request("DELETE", f"/webhooks/{made['webhookID']}") is None
    assert isinstance(client.request("GET", "/metrics"), bytes)
    with pytest.raises(api.NotFoundError):
        client.request("GET", "/nothing")


# --- both clients


def test_the_client_for_an_event_loop_does_the_same(site: Site) -> None:
    path, seen = site.file("points.xyz", POINTS), []

    async def use() -> tuple[Any, ...]:
        async with asyncio.timeout(LONG_S), site.async_client() as client:
            first, second = await asyncio.gather(
                client.submit(path, crs="EPSG:28992"), client.submit(site.file(), title="large")
            )
            for _ in range(2):
                site.store.succeed(site.claimed(), message="done", summary={})
            seen.extend([one async for one in client.watch(first)])
            done = await client.wait(first)
            files = await client.fetch(site.runs.finished(), site.folder / "out", ["report", "buildings"])
            return first, second, done, files, await client.jobs(status="successful")

    first, second, done, files, listed = asyncio.run(use())
    assert (first.status, done.status, second.title) == ("accepted", "successful", "large")
    assert [one.status for one in seen] == ["accepted", "running", "successful"]
    assert {file.path.name for file in files} == {"report.json", "buildings.parquet"}
    assert len(listed) == 3
    assert SHA256 in {record.sha256 for record in site.stored()}


def test_both_clients_have_the_same_methods_with_the_same_parameters() -> None:
    def public(kind: type) -> dict[str, inspect.Signature]:
        return {
            name: inspect.signature(found)
            for name, found in inspect.getmembers(kind, inspect.isfunction)
            if name[0] != "_"
        }

    blocking, other = public(Client), public(AsyncClient)
    assert set(blocking) == set(other)
    for name, signature in blocking.items():
        assert signature.parameters == other[name].parameters, name
        if name != "watch":
            assert signature.return_annotation == other[name].return_annotation, name
    assert inspect.signature(Client).parameters == inspect.signature(AsyncClient).parameters


@pytest.mark.parametrize(
    ("ours", "theirs", "other_names"),
    [
        (
            answers.Job,
            StatusInfo,
            {"id": "jobID", "process": "processID", "schedule_id": "scheduleID", "problem": "exception"},
        ),
        (answers.Event, Event, {}),
        (answers.Problem, Problem, {"kind": "type", "job_id": "jobID"}),
    ],
)
def test_what_the_client_reads_is_what_the_service_writes(
    ours: type[Any], theirs: type[Any], other_names: dict[str, str]
) -> None:
    read = {other_names.get(field.name, field.name) for field in dataclasses.fields(ours)} - {"document"}
    assert read <= set(theirs.model_fields)
