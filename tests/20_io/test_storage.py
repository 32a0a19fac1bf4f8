"""What has a name in storage is complete."""

from __future__ import annotations

import hashlib
import threading

import pytest

from pipeline.errors import RunError
from pipeline.io import LocalStorage, sha256_of


@pytest.fixture
def storage(tmp_path):
    return LocalStorage(root=tmp_path / "run")


def test_what_is_put_can_be_got_listed_and_replaced(storage):
    storage.put("state/a.json", b"1")
    storage.put("state/deep/b.json", b"2")
    storage.put("run.json", b"3")
    storage.put("state/a.json", b"4")
    assert storage.get("state/a.json") == b"4"
    assert storage.keys() == ["run.json", "state/a.json", "state/deep/b.json"]
    assert storage.keys("state") == ["state/a.json", "state/deep/b.json"]
    assert storage.has("run.json")
    assert not storage.has("other.json")
    assert storage.keys("nowhere") == []


def test_a_write_that_fails_leaves_the_old_content_and_no_trace(storage):
    storage.put("a.bin", b"old")

    def write_half() -> None:
        with storage.putting("a.bin") as path:
            path.write_bytes(b"half")
            raise ValueError("out of paper")

    with pytest.raises(ValueError, match="out of paper"):
        write_half()
    assert storage.get("a.bin") == b"old"
    assert [path.name for path in storage.root.iterdir()] == ["a.bin"]


def test_what_is_being_written_has_no_name_yet(storage):
    with storage.putting("a.bin") as path:
        path.write_bytes(b"x")
        assert not storage.has("a.bin")
        assert storage.keys() == []
        assert path.parent == storage.root
    assert storage.keys() == ["a.bin"]


def test_a_block_that_writes_nothing_is_an_error(storage):
    with pytest.raises(RunError, match=r"'a\.bin' was not written"), storage.putting("a.bin"):
        pass


def test_readers_never_see_a_half_written_thing(storage):
    contents = [bytes([letter]) * 200_000 for letter in b"abcdef"]
    storage.put("a.bin", contents[0])
    seen: set[bytes] = set()
    stop = threading.Event()

    def watch() -> None:
        while not stop.is_set():
            seen.add(storage.get("a.bin"))

    watcher = threading.Thread(target=watch)
    watcher.start()
    for _ in range(5):
        for content in contents:
            storage.put("a.bin", content)
    stop.set()
    watcher.join()
    assert seen <= set(contents)
    assert seen


@pytest.mark.parametrize("key", ["", ".", "/etc/passwd", "../a", "a/../../b", "a\\b"])
def test_keys_that_lead_out_of_the_folder_are_refused(storage, key):
    with pytest.raises(RunError, match="is no key"):
        storage.put(key, b"")


def test_what_is_not_there_is_told(storage):
    with pytest.raises(RunError, match=r"'a\.bin' is not in"):
        storage.get("a.bin")


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match="cannot be made"):
        LocalStorage(root=tmp_path / "file").put("a/b", b"")


def test_the_digest_is_that_of_the_content(tmp_path):
    content = bytes(range(256)) * 10_000
    (tmp_path / "a").write_bytes(content)
    assert sha256_of(tmp_path / "a") == hashlib.sha256(content).hexdigest()
