"""What has a name in storage is complete: one contract for folders and object stores."""

import hashlib
import os
import stat
import threading
from pathlib import Path

import pytest

from pipeline.errors import RunError
from pipeline.extras.remote.object_storage import ObjectStorage
from pipeline.io import LocalStorage, sha256_of, storage_at
from pipeline.io.storage import TEMPORARY_SUFFIX


@pytest.fixture(params=["folder", "object store"])
def storage(request, tmp_path):
    if request.param == "folder":
        return storage_at(tmp_path / "run")
    return storage_at(f"{request.getfixturevalue('bucket')}/deep/run")


def test_a_path_and_a_url_give_their_storages(tmp_path):
    assert storage_at(str(tmp_path)) == LocalStorage(root=tmp_path)
    assert storage_at("S3://bucket//runs/a/") == ObjectStorage(url="s3://bucket/runs/a")
    assert storage_at(storage_at("s3://bucket/a").place) == storage_at("s3://bucket/a")


def test_what_is_put_can_be_got_listed_and_replaced(storage):
    storage.make()
    storage.put("state/a.json", b"1")
    storage.put("state/deep/b.json", b"2")
    storage.put("run.json", b"3")
    storage.put("state/a.json", b"456")
    assert storage.get("state/a.json") == b"456"
    assert storage.size("state/a.json") == 3
    assert storage.keys() == ["run.json", "state/a.json", "state/deep/b.json"]
    assert storage.keys("state") == ["state/a.json", "state/deep/b.json"]
    assert storage.names() == ["run.json", "state"]
    assert storage.has("run.json")
    assert not storage.has("other.json")
    assert not storage.has("state")
    assert storage.keys("nowhere") == []


def test_odd_names_stay_what_they_are(storage):
    key = "meshes/tile=x1_y2/Straße 5, [a] #1 100%.obj"
    storage.put(key, b"x")
    assert storage.keys() == [key]
    assert storage.get(key) == b"x"
    storage.delete(key)
    assert storage.keys() == []


def test_a_write_that_fails_leaves_the_old_content_and_no_trace(storage):
    storage.put("a.bin", b"old")

    def write_half() -> None:
        with storage.putting("a.bin") as path:
            path.write_bytes(b"half")
            raise ValueError("out of paper")

    with pytest.raises(ValueError, match="out of paper"):
        write_half()
    assert storage.get("a.bin") == b"old"
    assert storage.names() == ["a.bin"]


def test_what_is_being_written_has_no_name_yet(storage):
    with storage.putting("a.bin") as path:
        path.write_bytes(b"x")
        assert not storage.has("a.bin")
        assert storage.keys() == []
    assert storage.keys() == ["a.bin"]
    assert not path.exists()


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


def test_several_puts_are_all_there_when_the_block_ends(storage):
    asked = []
    with storage.several(lambda: asked.append(1)) as puts:
        for k in range(30):
            puts.put(f"meshes/{k:02}", bytes([k]))
        puts.wait()
        assert len(storage.keys("meshes")) == 30
        puts.put("buildings", b"")
    assert [storage.get(key) for key in storage.keys("meshes")] == [bytes([k]) for k in range(30)]
    assert storage.has("buildings")
    assert len(asked) >= 31


def test_several_names_survive_a_power_loss_from_the_next_wait_on(tmp_path, monkeypatch):
    """Files get their names when all of them are on the disk; then their folder is synced, once."""
    synced = []

    def sync(handle: int) -> None:
        names = sorted(path.name for path in (tmp_path / "meshes").iterdir())
        synced.append((Path(f"/proc/self/fd/{handle}").readlink(), names))

    monkeypatch.setattr(os, "fsync", sync)
    storage = LocalStorage(root=tmp_path)
    with storage.several(lambda: None) as puts:
        for name in ("a", "b", "c"):
            puts.put(f"meshes/{name}", b"x")
        puts.wait()
        assert len({path for path, _ in synced[:3]}) == 3
        assert {Path(name).suffix for _, names in synced[:3] for name in names} == {TEMPORARY_SUFFIX}
        assert synced[3:] == [(tmp_path / "meshes", ["a", "b", "c"])]
        puts.put("buildings", b"x")
    assert [path.parent for path, _ in synced[4:5]] == [tmp_path]
    assert [path for path, _ in synced[5:]] == [tmp_path]


def test_several_things_wait_for_the_disk_at_the_same_time(tmp_path, monkeypatch):
    together = threading.Barrier(3, timeout=60)
    monkeypatch.setattr(os, "fsync", lambda handle: stat.S_ISREG(os.fstat(handle).st_mode) and together.wait())
    storage = LocalStorage(root=tmp_path)
    with storage.several(lambda: None) as puts:
        for name in ("a", "b", "c"):
            puts.put(name, b"x")
    assert storage.keys() == ["a", "b", "c"]


def test_what_the_check_raises_ends_several_puts(storage):
    left = [5]

    def check() -> None:
        left[0] -= 1
        if left[0] < 0:
            raise InterruptedError("cancelled")

    def put_many() -> None:
        with storage.several(check) as puts:
            for k in range(100):
                puts.put(str(k), b"x")

    with pytest.raises(InterruptedError, match="cancelled"):
        put_many()
    assert len(storage.keys()) <= 5


def test_clearing_takes_things_and_folders_and_nothing_else(storage):
    for key in ("run.json", "state/a.json", "state/deep/b.json", "statement", "state.json"):
        storage.put(key, b"")
    storage.clear(["state", "run.json", "nothing"])
    assert storage.keys() == ["state.json", "statement"]


def test_a_thing_that_is_not_there_can_be_removed(storage):
    storage.delete("a.bin")
    storage.put("a.bin", b"")
    storage.delete("a.bin")
    storage.delete("a.bin")
    assert not storage.has("a.bin")


@pytest.mark.parametrize("key", ["", ".", "/etc/passwd", "../a", "a/../../b", "a\\b"])
@pytest.mark.parametrize("make", [lambda folder: LocalStorage(root=folder), lambda _: ObjectStorage(url="s3://b/c")])
def test_keys_that_lead_out_of_the_storage_are_refused(make, key, tmp_path):
    with pytest.raises(RunError, match="is not a key"):
        make(tmp_path).put(key, b"")


def test_what_is_not_there_is_reported_with_its_key(storage):
    with pytest.raises(RunError, match=r"a\.bin"):
        storage.get("a.bin")
    with pytest.raises(RunError, match=r"'a\.bin' is not in "):
        storage.size("a.bin")


def test_a_folder_that_cannot_be_made_is_reported(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match="cannot be made"):
        LocalStorage(root=tmp_path / "file").put("a/b", b"")


def test_the_digest_is_that_of_the_content(tmp_path):
    content = bytes(range(256)) * 10_000
    (tmp_path / "a").write_bytes(content)
    assert sha256_of(tmp_path / "a") == hashlib.sha256(content).hexdigest()
