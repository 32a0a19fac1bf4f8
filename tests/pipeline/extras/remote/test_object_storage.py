"""An object store that fails, answers late or not at all, counted request by request."""

import logging
import pickle
import subprocess
import sys
import time

import pytest
from object_store import SECRET

from pipeline.backoff import Backoff
from pipeline.errors import RunError
from pipeline.extras.remote import urls
from pipeline.extras.remote.object_storage import AT_ONCE, ObjectStorage
from pipeline.io import arrow_at, storage_at

QUICK = Backoff(attempts=4, first_s=0.01, longest_s=0.02)


@pytest.fixture
def storage(bucket):
    return ObjectStorage(url=f"{bucket}/run", policy=QUICK)


def first(what, n=1, method=""):
    """A script by which the first requests of a method meet something."""
    met = []

    def script(request):
        if (method and request.method != method) or len(met) >= n:
            return "pass"
        met.append(request)
        return what

    return script


@pytest.mark.parametrize("what", ["busy", "cut", "lost"])
def test_a_put_that_fails_is_made_again_and_is_there_once(storage, s3, what):
    s3.script = first(what, 2)
    storage.put("run.json", b"content")
    assert [reported for _, reported in s3.seen] == [what, what, "pass"]
    assert storage.get("run.json") == b"content"
    assert storage.keys() == ["run.json"]


def test_a_server_that_says_nothing_is_asked_again(storage, s3, monkeypatch):
    s3.script = first("silent")
    with monkeypatch.context() as short:
        short.setattr(urls, "READ_S", 0.5)
        storage.put("run.json", b"content")
    # it had arrived the first time: to put it twice does no harm, and on a busy machine others may be late, too
    assert s3.count("silent", method="PUT") == 1
    assert s3.count("pass", method="PUT") >= 1
    assert storage.get("run.json") == b"content"


def test_half_an_answer_is_none(storage, s3):
    content = bytes(range(256)) * 1000
    storage.put("a.bin", content)
    s3.script = first("half", 2, "GET")
    assert storage.get("a.bin") == content
    assert s3.count("half") == 2


def test_an_upload_of_a_file_is_made_again(storage, s3):
    s3.script = first("cut", 2, "PUT")
    with storage.putting("a.bin") as path:
        path.write_bytes(b"x" * 100_000)
    assert storage.size("a.bin") == 100_000
    assert s3.count(method="PUT") == 3


@pytest.mark.parametrize(
    ("answer", "message", "attempts"),
    [
        ("busy", r"run/state/a\.json cannot be written: the server is busy at all of 4 attempts", 4),
        ("denied", r"a\.json cannot be written: access is denied .*Check the credentials", 1),
    ],
)
def test_after_the_last_attempt_the_error_names_the_key_the_cause_and_the_fix(storage, s3, answer, message, attempts):
    s3.script = lambda _: answer
    with pytest.raises(RunError, match=message):
        storage.put("state/a.json", b"")
    assert len(s3.seen) == attempts


def test_a_fault_is_not_taken_for_an_absence(storage, s3):
    s3.script = lambda _: "denied"
    for ask in (lambda: storage.has("run.json"), storage.names, storage.keys):
        with pytest.raises(RunError, match="access is denied"):
            ask()


def test_a_bucket_that_is_not_there_is_reported(s3):
    storage = storage_at("s3://no-such-bucket/run")
    for ask in (storage.names, storage.keys, lambda: storage.put("a", b""), lambda: storage.has("a")):
        with pytest.raises(RunError, match="there is no such bucket"):
            ask()


def put_many(storage):
    with storage.several(lambda: None) as puts:
        for k in range(500):
            puts.put(f"m/{k}", b"x")


def test_one_fault_at_the_server_ends_several_puts(storage, s3):
    s3.script = lambda request: "denied" if request.path.partition("?")[0].endswith("/m/7") else "pass"
    with pytest.raises(RunError, match=r"m/7 cannot be written: access is denied"):
        put_many(storage)
    assert s3.count("denied") == 1
    assert len(storage.keys()) < 500


def test_no_more_than_a_window_is_under_way(monkeypatch):
    going, most = set(), []

    def put(_storage, key, *_):
        going.add(key)
        most.append(len(going))
        time.sleep(0.001)
        going.discard(key)

    monkeypatch.setattr(ObjectStorage, "_put", put)
    put_many(ObjectStorage(url="s3://bucket/run"))
    assert max(most) <= AT_ONCE


def test_readers_by_arrow_ask_again_too(storage, s3):
    storage.put("buildings/tile=a/part-0.parquet", b"x" * 1000)
    filesystem, path = arrow_at(storage.place)
    s3.seen.clear()
    s3.script = first("cut", 3)
    with filesystem.open_input_file(f"{path}/buildings/tile=a/part-0.parquet") as stream:
        assert stream.read() == b"x" * 1000
    assert s3.count("cut") == 3
    with pytest.raises(FileNotFoundError):
        filesystem.open_input_stream(f"{path}/nothing")


def test_a_storage_travels_without_secrets(storage, s3, caplog):
    caplog.set_level(logging.DEBUG)
    s3.script = first("busy")
    storage.put("run.json", b"")
    assert SECRET.encode() not in pickle.dumps(storage)
    own = [record.getMessage() for record in caplog.records if record.name.startswith(("pipeline", "s3fs", "fsspec"))]
    assert not any(SECRET in message for message in own)


def test_without_the_extra_the_error_names_it():
    code = (
        "import sys; sys.modules['s3fs'] = None\n"
        "from pipeline.io import storage_at\n"
        "storage_at('s3://bucket/run').put('a', b'')"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "RunError: s3://bucket/run: s3:// needs s3fs, which is not installed. Install gablework[s3]" in ended.stderr


@pytest.mark.parametrize(
    ("url", "reported"),
    [
        ("ftp://host/run", "ftp:// is not supported"),
        ("https://host/run", "nothing can be stored there"),
        ("s3://", "names no bucket"),
        ("s3://bucket/../other", "names no bucket"),
        ("https://me:hidden@host/run?token=hidden", "nothing can be stored there"),
    ],
)
def test_urls_where_nothing_can_be_stored_are_refused(url, reported):
    with pytest.raises(RunError, match=reported) as refused:
        storage_at(url)
    assert "hidden" not in str(refused.value)
