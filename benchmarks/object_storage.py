"""Cost of publishing into an object store, and of the ways to read a remote tile.

    .venv/bin/python benchmarks/object_storage.py RUN [TILE]

RUN is a finished run in a folder. Its files are put again, tile by tile as `publish` does, into a folder and into
moto's S3 server, which runs in a separate process. TILE is a LAZ file: its points are read from the disk, through
buffered ranges and after fetching it. Moto is written in Python and answers from the memory of the same machine,
so its figures are mostly its own work; the effect of a delay before each answer is also measured.
"""

from __future__ import annotations

import hashlib
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.io import Storage, open_source, storage_at
from pipeline.io.remote_file import RemoteFile
from pipeline.io.urls import filesystem_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from object_store import environment

DELAYS_MS = (0, 30)
"""Before each answer; 30 is what stores in the same region take."""
SERVER = """
import logging, sys, time
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server
logging.getLogger("werkzeug").setLevel(logging.ERROR)
app, delay = DomainDispatcherApplication(create_backend_app), float(sys.argv[1])
def late(environ, start):
    time.sleep(delay)
    return app(environ, start)
server = make_server("127.0.0.1", 0, late, threaded=True)
print(server.server_port, flush=True)
server.serve_forever()
"""


def served(delay_ms: float) -> tuple[subprocess.Popen[str], str]:
    """A server in a process of its own, and a bucket in it."""
    words = [sys.executable, "-c", SERVER, str(delay_ms / 1e3)]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    os.environ.update(environment(f"http://127.0.0.1:{server.stdout.readline().strip()}"))
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    filesystem_of("s3://bench").mkdir("bench")
    return server, "s3://bench"


def tiles_of(run: Path) -> dict[str, list[Path]]:
    """The files of each tile, its meshes first."""
    tiles: dict[str, list[Path]] = defaultdict(list)
    for kind in ("meshes", "cityjson", "planes", "rejected", "buildings"):
        for path in sorted((run / kind).rglob("*")):
            if path.is_file():
                tiles[path.relative_to(run).parts[1].removeprefix("tile=")].append(path)
    return tiles


def publish(storage: Storage, run: Path, tiles: dict[str, list[Path]]) -> None:
    """Put all tiles as `pipeline.runtime.stages.publish` does."""
    for key, paths in tiles.items():
        with storage.several(lambda: None) as puts:
            for path in paths:
                name = path.relative_to(run).as_posix()
                if not name.startswith("meshes/"):
                    puts.wait()
                puts.put(name, path.read_bytes())
        storage.put(f"state/{key}.json", b"{}")


def one_by_one(storage: Storage, run: Path, tiles: dict[str, list[Path]]) -> None:
    """The same with one request at a time."""
    for key, paths in tiles.items():
        for path in paths:
            storage.put(path.relative_to(run).as_posix(), path.read_bytes())
        storage.put(f"state/{key}.json", b"{}")


def resident() -> int:
    """Bytes of this process now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def measured(work: Callable[[], Any]) -> tuple[float, float, float]:
    """Wall-clock and CPU seconds of this process, and MB by which it grew at most."""
    before, most, over = resident(), [0], threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            most[0] = max(most[0], resident())

    watching = threading.Thread(target=watch)
    watching.start()
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    over.set()
    watching.join()
    return wall, cpu, (max(most[0], before) - before) / 1e6


def reported(what: str, found: tuple[float, float, float]) -> None:
    """A row of a table."""
    print(f"| {what} | {found[0]:.1f} | {found[1]:.1f} | {found[2]:.0f} |", flush=True)


def publishing(run: Path) -> None:
    """The table of puts."""
    tiles = tiles_of(run)
    files = [path for paths in tiles.values() for path in paths]
    size = sum(path.stat().st_size for path in files)
    print(f"{len(files)} files of {len(tiles)} tiles, {size / 1e6:.1f} MB\n")
    print("| into | wall s | CPU s | MB more |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        reported("a folder", measured(lambda: publish(storage_at(folder), run, tiles)))
    for delay_ms in DELAYS_MS:
        server, bucket = served(delay_ms)
        try:
            ways: tuple[tuple[str, Callable[..., None]], ...] = (("8 at once", publish), ("one by one", one_by_one))
            for name, way in ways:
                storage = storage_at(f"{bucket}/{name[0]}")
                storage.put("warm", b"")
                found = measured(lambda way=way, storage=storage: way(storage, run, tiles))
                reported(f"moto + {delay_ms} ms, {name}", found)
        finally:
            server.terminate()
            server.wait()


def points(source: Any) -> int:
    """Points of a source, read through."""
    return sum(len(cloud) for cloud in source.chunks(250_000))


def reading(tile: Path) -> None:
    """The table of reads."""
    print(f"\n{tile.name}, {tile.stat().st_size / 1e6:.1f} MB\n")
    print("| read | wall s | CPU s | MB more |\n| --- | --- | --- | --- |")
    reported("from the disk", measured(lambda: points(open_source(tile))))
    for delay_ms in DELAYS_MS:
        server, bucket = served(delay_ms)
        url = f"{bucket}/{tile.name}"
        try:
            filesystem_of(url).put_file(str(tile), url)
            reported(f"header only, + {delay_ms} ms", measured(lambda url=url: open_source(url)))
            reported(f"by ranges, + {delay_ms} ms", measured(lambda url=url: points(open_source(url))))
            with tempfile.TemporaryDirectory() as folder:
                copy = Path(folder, tile.name)
                reported(f"fetched, + {delay_ms} ms", measured(lambda url=url, copy=copy: RemoteFile(url).fetch(copy)))
                reported(
                    f"fetched and read, + {delay_ms} ms",
                    measured(lambda url=url, copy=copy: (RemoteFile(url).fetch(copy), points(open_source(copy)))),
                )
                same = hashlib.sha256(copy.read_bytes()).digest() == hashlib.sha256(tile.read_bytes()).digest()
                assert same
        finally:
            server.terminate()
            server.wait()


if __name__ == "__main__":
    run_dir, *given = (Path(word).resolve() for word in sys.argv[1:])
    publishing(run_dir)
    if given:
        reading(given[0])
