"""Kinds of bad input, each one mistake or one attack: files that are sent, and requests."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import json
import sqlite3
import struct
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from live_service import POINTS, las_bytes

LAS = las_bytes(200, compressed=False)
LAZ = las_bytes(200)
UPLOAD = "UPLOAD"
"""Stands for the id of a good upload."""
NAN, INF = float("nan"), float("inf")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BadRequest:
    """A request that must be refused."""

    method: str
    path: str
    headers: Mapping[str, str] = dataclasses.field(default_factory=dict)
    content: bytes | None = None


def bad_files() -> dict[str, tuple[str, bytes]]:
    """Name and content of files by what is wrong with them."""
    return {**_bad_las(), **_bad_texts(), **_bad_ply(), **_foreign_files(), **_bad_footprints(), **_bad_names()}


def _patched(at: int, kind: str, *values: float) -> tuple[str, bytes]:
    """The good LAS file with other values at an offset of its header."""
    content = bytearray(LAS)
    struct.pack_into("<" + kind, content, at, *values)
    return "tile.las", bytes(content)


def _bad_las() -> dict[str, tuple[str, bytes]]:
    points_at = struct.unpack_from("<I", LAS, 96)[0]
    chunk_table = bytearray(LAZ)
    struct.pack_into("<q", chunk_table, struct.unpack_from("<I", LAZ, 96)[0], 2**62)
    return {
        "LAS: no byte": ("tile.las", b""),
        "LAZ: no byte": ("tile.laz", b""),
        "LAS: signature alone": ("tile.las", b"LASF"),
        "LAS: another signature": ("tile.las", b"LASX" + LAS[4:]),
        "LAS: half a header": ("tile.las", LAS[:100]),
        "LAS: cut within the points": ("tile.las", LAS[: points_at + 1000]),
        "LAS: cut before the points": ("tile.las", LAS[:points_at]),
        "LAZ: cut within the points": ("tile.laz", LAZ[: len(LAZ) * 2 // 3]),
        "LAZ: chunk table far beyond the end": ("tile.laz", bytes(chunk_table)),
        "LAS: version 9.9": _patched(24, "BB", 9, 9),
        "LAS: header of 10 bytes": _patched(94, "H", 10),
        "LAS: header of 65,535 bytes": _patched(94, "H", 65_535),
        "LAS: points beyond the end": _patched(96, "I", 2**32 - 1),
        "LAS: points within the header": _patched(96, "I", 20),
        "LAS: four billion VLRs": _patched(100, "I", 2**32 - 1),
        "LAS: point format 42": _patched(104, "B", 42),
        "LAS: records of no byte": _patched(105, "H", 0),
        "LAS: records too short for their format": _patched(105, "H", 5),
        "LAS: records of 65,535 bytes": _patched(105, "H", 65_535),
        "LAS: no points": _patched(107, "I", 0),
        "LAS: four billion points": _patched(107, "I", 2**32 - 1),
        "LAS: scale 0": _patched(131, "d", 0.0),
        "LAS: scale NaN": _patched(131, "d", NAN),
        "LAS: scale infinite": _patched(139, "d", INF),
        "LAS: offset NaN": _patched(155, "d", NAN),
        "LAS: offset 1e300": _patched(155, "d", 1e300),
        "LAS: geographic CRS": ("tile.las", las_bytes(200, crs="EPSG:4326", compressed=False)),
        "LAS: a CRS whose area of use is elsewhere": ("tile.las", las_bytes(200, crs="EPSG:2193", compressed=False)),
    }


def _bad_texts() -> dict[str, tuple[str, bytes]]:
    return {
        "text: no byte": ("tile.xyz", b""),
        "text: blanks": ("tile.xyz", b"  \n\n \n"),
        "text: two columns": ("tile.xyz", b"1.0 2.0\n" * 9),
        "text: words": ("tile.xyz", b"one two three\n" * 9),
        "text: a heading alone": ("tile.xyz", b"x y z\n"),
        "text: NaN": ("tile.xyz", POINTS + b"nan 447000.0 3.5\n"),
        "text: infinite": ("tile.xyz", POINTS + b"84000.0 inf 3.5\n"),
        "text: a line with a word in the middle": ("tile.xyz", POINTS + b"84000.0 north 3.5\n" + POINTS),
        "text: a line with two columns in the middle": ("tile.xyz", POINTS + b"84000.0 447000.0\n" + POINTS),
        "text: UTF-16": ("tile.xyz", POINTS.decode().encode("utf-16")),
        "text: zeros": ("tile.xyz", bytes(4096)),
        "text: coordinates of 1e308": ("tile.xyz", b"1e308 1e308 3.5\n-1e308 -1e308 2.0\n"),
        "text: one line of a megabyte": ("tile.xyz", b"1" * 1_000_000),
        "text: comments alone": ("tile.xyz", b"# a comment\n" * 9),
    }


def _bad_ply() -> dict[str, tuple[str, bytes]]:
    def ply(header: str, body: bytes = b"") -> tuple[str, bytes]:
        return "tile.ply", b"ply\n" + header.encode() + b"end_header\n" + body

    xyz = "property double x\nproperty double y\nproperty double z\n"
    ascii_ = "format ascii 1.0\n"
    binary = "format binary_little_endian 1.0\n"
    return {
        "PLY: no byte": ("tile.ply", b""),
        "PLY: header without an end": ("tile.ply", b"ply\n" + ascii_.encode()),
        "PLY: no format": ply(f"element vertex 1\n{xyz}", b"1 2 3\n"),
        "PLY: an unknown format": ply(f"format text 7.0\nelement vertex 1\n{xyz}", b"1 2 3\n"),
        "PLY: no vertices": ply(ascii_ + "element face 0\n"),
        "PLY: no z": ply(ascii_ + "element vertex 1\nproperty double x\nproperty double y\n", b"1 2\n"),
        "PLY: fewer vertices than promised": ply(f"{ascii_}element vertex 9\n{xyz}", b"1 2 3\n"),
        "PLY: cut binary vertices": ply(f"{binary}element vertex 9\n{xyz}", bytes(100)),
        "PLY: 10^18 vertices": ply(f"{binary}element vertex {10**18}\n{xyz}", bytes(100)),
        "PLY: -1 vertices": ply(f"{binary}element vertex -1\n{xyz}", bytes(100)),
        "PLY: a list as coordinate": ply(ascii_ + "element vertex 1\nproperty list uchar int x\n", b"1 2\n"),
        "PLY: an unknown type": ply(ascii_ + "element vertex 1\nproperty quaternion x\n", b"1\n"),
    }


def _foreign_files() -> dict[str, tuple[str, bytes]]:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("tile.las", LAS)
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"
    return {
        "LAZ: a zip archive": ("tile.laz", packed.getvalue()),
        "LAZ: an image": ("tile.laz", b"\x89PNG\r\n\x1a\n" + bytes(500)),
        "LAZ: a web page": ("tile.laz", b"<!doctype html><title>Sign in</title>" + b" " * 500),
        "LAZ: a pointer of Git LFS": ("tile.laz", pointer.encode()),
        "LAZ: a PDF": ("tile.laz", b"%PDF-1.7\n" + bytes(500)),
        "LAZ: JSON": ("tile.laz", b'{"error": "no such file"}'),
        "LAZ: compressed again": ("tile.laz", b"\x1f\x8b\x08" + bytes(500)),
        "LAS: points as text": ("tile.las", POINTS),
    }


def _bad_footprints() -> dict[str, tuple[str, bytes]]:
    def collection(*geometries: Any, **members: Any) -> tuple[str, bytes]:
        features = [{"type": "Feature", "properties": {}, "geometry": one} for one in geometries]
        return "outlines.geojson", json.dumps({"type": "FeatureCollection", "features": features, **members}).encode()

    def polygon(*ring: Any) -> dict[str, Any]:
        return {"type": "Polygon", "coordinates": [list(ring)]}

    square = polygon([84000, 447000], [84009, 447000], [84009, 447009], [84000, 447000])
    plain = pa.BufferOutputStream()
    pq.write_table(pa.table({"height": [1.0]}), plain)
    table = plain.getvalue().to_pybytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "plain.gpkg")
        with sqlite3.connect(path) as database:
            database.execute("CREATE TABLE houses (id INTEGER)")
        database.close()
        plain_database = path.read_bytes()
    return {
        "GeoJSON: no byte": ("outlines.geojson", b""),
        "GeoJSON: not JSON": ("outlines.geojson", b"outlines"),
        "GeoJSON: cut": ("outlines.geojson", collection(square)[1][:-20]),
        "GeoJSON: a list": ("outlines.geojson", b"[]"),
        "GeoJSON: another type": ("outlines.geojson", b'{"type": "Topology"}'),
        "GeoJSON: no features": collection(),
        "GeoJSON: points": collection({"type": "Point", "coordinates": [84000, 447000]}),
        "GeoJSON: no geometry": collection(None),
        "GeoJSON: a ring of two points": collection(polygon([84000, 447000], [84009, 447000])),
        "GeoJSON: words as coordinates": collection(polygon(["a", "b"], ["c", "d"], ["e", "f"], ["a", "b"])),
        "GeoJSON: NaN": collection(polygon([NAN, 0], [1, 0], [1, 1], [NAN, 0])),
        "GeoJSON: unknown CRS": collection(square, crs={"type": "name", "properties": {"name": "EPSG:999999"}}),
        "GeoJSON: nested 100,000 deep": ("outlines.geojson", b"[" * 100_000),
        "GeoJSON: not UTF-8": ("outlines.geojson", b'{"type": "\xff\xfe"}'),
        "GeoPackage: no byte": ("outlines.gpkg", b""),
        "GeoPackage: text": ("outlines.gpkg", b"not a database" * 99),
        "GeoPackage: a plain database": ("outlines.gpkg", plain_database),
        "GeoPackage: cut": ("outlines.gpkg", plain_database[:1500]),
        "GeoParquet: no byte": ("outlines.parquet", b""),
        "GeoParquet: text": ("outlines.parquet", b"PAR1 not a table PAR1"),
        "GeoParquet: no geometry": ("outlines.parquet", table),
        "GeoParquet: cut": ("outlines.parquet", table[: len(table) // 2]),
    }


def _bad_names() -> dict[str, tuple[str, bytes]]:
    names = [
        "tile",
        "tile.exe",
        ".laz",
        "tile.las.zip",
        "tile.e57",
        "outlines.shp",
        "tile.laz/",
        "..",
        "tile.laz\0.exe",
    ]
    long = "x" * 2000 + ".laz"
    return {f"file name {name!r}": (name, LAZ) for name in names} | {"file name of 2,000 characters": (long, LAZ)}


def bad_requests() -> dict[str, BadRequest]:
    """Requests by what is wrong with them."""
    found: dict[str, BadRequest] = {}
    for part in (_bodies(), _executions(), _queries(), _sendings(), _resumable(), _others()):
        for name, request in part:
            assert name not in found, name
            found[name] = request
    return found


def _json(method: str, path: str, document: Any, **headers: str) -> BadRequest:
    content = json.dumps(document).encode()
    return BadRequest(
        method=method, path=path, headers={"Content-Type": "application/json", **headers}, content=content
    )


def _bodies() -> Iterator[tuple[str, BadRequest]]:
    path = "/processes/echo/execution"
    as_json = {"Content-Type": "application/json"}
    bodies = {
        "no body": b"",
        "not JSON": b"inputs=1",
        "a list": b"[]",
        "a number": b"7",
        "null": b"null",
        "not UTF-8": b'{"inputs": {"message": "\xff"}}',
        "NaN": b'{"inputs": {"message": "a", "delay": NaN}}',
        "1e400": b'{"inputs": {"message": "a", "delay": 1e400}}',
        "half a surrogate": b'{"inputs": {"message": "\\ud800"}}',
        "nested 100,000 deep": b'{"inputs": ' + b"[" * 100_000,
        "too long": b'{"inputs": {"message": "' + b"x" * (2 << 20) + b'"}}',
        "cut": b'{"inputs": {"message": "he',
    }
    for name, content in bodies.items():
        yield f"body: {name}", BadRequest(method="POST", path=path, headers=as_json, content=content)
    good = b'{"inputs": {"message": "hello"}}'
    for kind in ("text/plain", "application/xml", "multipart/form-data"):
        headers = {"Content-Type": kind}
        yield f"body: {kind}", BadRequest(method="POST", path=path, headers=headers, content=good)
    packed = {**as_json, "Content-Encoding": "gzip"}
    yield "body: compressed", BadRequest(method="POST", path=path, headers=packed, content=good)
    for name, key in (("empty", ""), ("of 300 characters", "k" * 300)):
        yield f"Idempotency-Key: {name}", _json("POST", path, {"inputs": {"message": "a"}}, **{"Idempotency-Key": key})


def _executions() -> Iterator[tuple[str, BadRequest]]:
    tile = {"href": f"/uploads/{UPLOAD}"}
    run, compare, classify, echo = (
        f"/processes/{name}/execution" for name in ("reconstruct", "compare", "classify", "echo")
    )
    hrefs = [
        "",
        "../../etc/passwd",
        "/etc/passwd",
        "file:///etc/passwd",
        "/uploads/" + "0" * 32,
        "/uploads/x",
        "http://127.0.0.1/tile.laz",
        "http://169.254.169.254/latest/meta-data",
        "http://[::1]/tile.laz",
        "http://0x7f000001/tile.laz",
        "https://user:secret@example.org/tile.laz",
        "ftp://example.org/tile.laz",
        "javascript:alert(1)",
        "data:text/plain,1 2 3",
        "http://",
        "http://example.org:99999/tile.laz",
        "s3://bucket/tile.laz",
        "tile.laz\n",
    ]
    for href in hrefs:
        yield f"tiles: href {href!r}", _json("POST", run, {"inputs": {"tiles": [{"href": href}]}})
    inline = base64.b64encode(POINTS).decode()
    as_points = {"encoding": "base64", "mediaType": "text/plain"}
    tiles: dict[str, Any] = {
        "none": None,
        "empty": [],
        "a number": 7,
        "a word": "tile.laz",
        "a list of numbers": [1, 2],
        "no href": [{}],
        "href is a number": [{"href": 7}],
        "href is a list": [{"href": ["a"]}],
        "href and value": [{"href": tile["href"], "value": inline}],
        "value that is not base64": [{"value": "***", **as_points}],
        "value of an unknown media type": [{"value": inline, "encoding": "base64", "mediaType": "image/png"}],
        "value with an unknown encoding": [{"value": inline, "encoding": "rot13", "mediaType": "text/plain"}],
        "nested": [[[[tile]]]],
        "1,001 of them": [tile] * 1001,
    }
    for name, value in tiles.items():
        yield f"tiles: {name}", _json("POST", run, {"inputs": {"tiles": value}})
    inputs: dict[str, dict[str, Any]] = {
        "an unknown input": {"colour": "red"},
        "footprints are points": {"footprints": tile},
        "footprints: two": {"footprints": [tile, tile]},
        "guides are points": {"guides": tile},
        "guides: two": {"guides": [tile, tile]},
        "crs: unknown": {"crs": "EPSG:999999"},
        "crs: words": {"crs": "somewhere"},
        "crs: empty": {"crs": ""},
        "crs: geographic": {"crs": "EPSG:4326"},
        "crs: a control character": {"crs": "EPSG:28992\u0000"},
        "crs: 30,000 characters": {"crs": "x" * 30_000},
        "verticalUnit: unknown": {"verticalUnit": "cubit"},
        "bbox: three numbers": {"bbox": [1, 2, 3]},
        "bbox: no area": {"bbox": [1, 1, 1, 1]},
        "bbox: turned round": {"bbox": [84100, 447100, 84000, 447000]},
        "bbox: words": {"bbox": ["a", "b", "c", "d"]},
        "bbox: beyond every CRS": {"bbox": [0, 0, 1e13, 1e13]},
        "bbox: in another CRS": {"bbox": {"bbox": [4, 52, 5, 53], "crs": "EPSG:4326"}, "crs": "EPSG:28992"},
        "method: unknown": {"method": "magic"},
        "method: a number": {"method": 7},
        "preset: unknown": {"preset": "best"},
        "classes: unknown": {"classes": "perhaps"},
        "lods: unknown": {"lods": "LoD4"},
        "meshes: unknown": {"meshes": "stl"},
        "allowOutsideAreaOfUse: a word": {"allowOutsideAreaOfUse": "perhaps"},
        "priority: 11": {"priority": 11},
        "priority: a word": {"priority": "high"},
        "priority: a fraction": {"priority": 0.5},
        "title: blanks": {"title": "  "},
        "title: 501 characters": {"title": "x" * 501},
        "title: control characters": {"title": "a\u0007b"},
        "licence: a list": {"licence": ["CC-BY", "CC-0"]},
        "settings: a list": {"settings": [1]},
        "settings: a word": {"settings": "robust"},
        "settings: unknown table": {"settings": {"chimneys": {}}},
        "settings: a table that is none": {"settings": {"candidates": 15}},
        "settings: unknown": {"settings": {"candidates": {"min_aera_m2": 15}}},
        "settings: out of range": {"settings": {"candidates": {"min_area_m2": -1}}},
        "settings: a word as number": {"settings": {"candidates": {"min_area_m2": "large"}}},
        "settings: contradiction": {"method": "kmeans", "settings": {"method": "hofmann"}},
    }
    for name, more in inputs.items():
        yield name, _json("POST", run, {"inputs": {"tiles": [tile], **more}})
    members: dict[str, dict[str, Any]] = {
        "outputs: unknown": {"outputs": {"video": {}}},
        "outputs: a list": {"outputs": ["buildings"]},
        "outputs: by value": {"outputs": {"buildings": {"transmissionMode": "value"}}},
        "outputs: another media type": {"outputs": {"buildings": {"format": {"mediaType": "image/png"}}}},
        "outputs: unknown member": {"outputs": {"buildings": {"colour": "red"}}},
        "response: unknown": {"response": "xml"},
        "mode: sync": {"mode": "sync"},
        "subscriber: empty": {"subscriber": {}},
        "subscriber: unknown member": {"subscriber": {"doneUri": "https://example.org/"}},
        "subscriber: ftp": {"subscriber": {"successUri": "ftp://example.org/"}},
        "subscriber: a private address": {"subscriber": {"successUri": "http://192.168.1.1/"}},
        "subscriber: this machine": {"subscriber": {"successUri": "http://localhost:8000/jobs"}},
        "subscriber: a word": {"subscriber": {"failedUri": "me"}},
    }
    for name, more in members.items():
        yield name, _json("POST", run, {"inputs": {"tiles": [tile]}, **more})
    methods: dict[str, Any] = {
        "none": None,
        "one": ["kmeans"],
        "twice the same": ["kmeans", "kmeans"],
        "unknown": ["kmeans", "magic"],
        "a number": 7,
        "nine": ["kmeans"] * 9,
    }
    for name, value in methods.items():
        yield f"methods: {name}", _json("POST", compare, {"inputs": {"tiles": [tile], "methods": value}})
    for name, cell in (("0", 0), ("negative", -1), ("a kilometre and more", 1001), ("a word", "fine")):
        yield f"rasterCell: {name}", _json("POST", classify, {"inputs": {"tiles": [tile], "rasterCell": cell}})
    delays: dict[str, dict[str, Any]] = {
        "echo: no message": {},
        "echo: a number as message": {"message": 7},
        "echo: negative delay": {"message": "a", "delay": -1},
        "echo: delay of an hour": {"message": "a", "delay": 3600},
        "echo: 10,001 characters": {"message": "x" * 10_001},
    }
    for name, values in delays.items():
        yield name, _json("POST", echo, {"inputs": values})
    yield "process: unknown", _json("POST", "/processes/magic/execution", {"inputs": {}})


def _queries() -> Iterator[tuple[str, BadRequest]]:
    paths = [
        "/jobs?limit=0",
        "/jobs?limit=-1",
        "/jobs?limit=1000000000",
        "/jobs?limit=many",
        "/jobs?limit=1.5",
        "/jobs?limit=1&limit=2",
        "/jobs?offset=-1",
        "/jobs?offset=99999999999999999999",
        "/jobs?status=sleeping",
        "/jobs?datetime=yesterday",
        "/jobs?datetime=2026-02-30T00:00:00Z",
        "/jobs?datetime=2026-03-02T00:00:00Z/2026-03-01T00:00:00Z",
        "/jobs?minDuration=-1",
        "/jobs?minDuration=long",
        "/jobs?sortby=colour",
        "/jobs?f=xml",
        "/processes?limit=0",
        "/processes/reconstruct?colour=red",
        "/uploads?limit=0",
        "/schedules?limit=x",
        "/webhooks?offset=-5",
        "/webhooks/deliveries?status=lost",
        "/jobs/x",
        "/jobs/" + "0" * 32,
        "/jobs/" + "0" * 32 + "/results",
        "/jobs/" + "0" * 32 + "/buildings",
        "/jobs/" + "0" * 32 + "/events",
        "/jobs/%00",
        "/jobs/" + "x" * 5000,
        "/uploads/" + "0" * 32,
        "/uploads/%2e%2e%2fservice.db",
        "/schedules/x",
        "/webhooks/x",
        "/webhooks/deliveries/x",
        "/processes/%F0%9F%8F%A0",
        "/api/v1/jobs",
        "/../../etc/passwd",
        "/.git/config",
    ]
    for path in paths:
        yield f"GET {path[:60]}", BadRequest(method="GET", path=path)
    for method, path in (
        ("PUT", "/jobs"),
        ("DELETE", "/jobs"),
        ("PATCH", "/uploads"),
        ("POST", "/healthz"),
        ("DELETE", "/processes/reconstruct"),
        ("POST", "/conformance"),
        ("BREW", "/jobs"),
        ("DELETE", "/jobs/" + "0" * 32),
        ("DELETE", "/uploads/" + "0" * 32),
        ("DELETE", "/schedules/" + "0" * 32),
        ("DELETE", "/webhooks/" + "0" * 32),
    ):
        yield f"{method} {path}", BadRequest(method=method, path=path)


def _form(*parts: tuple[str, bytes], boundary: str = "line") -> bytes:
    """Parts of a form: the parameters of each one's disposition, and its content."""
    lines = [
        f"--{boundary}\r\nContent-Disposition: form-data{named}\r\n\r\n".encode() + content for named, content in parts
    ]
    return b"\r\n".join([*lines, f"--{boundary}--\r\n".encode()])


def _sendings() -> Iterator[tuple[str, BadRequest]]:
    def form(content: bytes, kind: str = "multipart/form-data; boundary=line") -> BadRequest:
        return BadRequest(method="POST", path="/uploads", headers={"Content-Type": kind}, content=content)

    def raw(path: str = "/uploads?filename=tile.laz", **headers: str) -> BadRequest:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return BadRequest(method="POST", path=path, headers=named, content=LAZ)

    file = ('; name="file"; filename="tile.laz"', LAZ)
    right = base64.b64encode(hashlib.sha256(LAZ).digest()).decode()
    wrong = base64.b64encode(hashlib.sha256(b"").digest()).decode()
    yield "form: no part", form(_form())
    yield "form: no file", form(_form(('; name="title"', b"a")))
    yield "form: two files", form(_form(file, file))
    yield "form: a file in another field", form(_form(('; name="tile"; filename="tile.laz"', LAZ)))
    yield "form: a part without a name", form(_form(("", LAZ)))
    yield "form: cut", form(_form(file)[:-100])
    yield "form: no boundary", form(_form(file), "multipart/form-data")
    yield "form: another boundary", form(_form(file), "multipart/form-data; boundary=other")
    yield "form: not a form", form(b"nothing of the kind")
    yield (
        "form: a digest of the whole",
        dataclasses.replace(
            form(_form(file)),
            headers={"Content-Type": "multipart/form-data; boundary=line", "Content-Digest": f"sha-256=:{right}:"},
        ),
    )
    yield "upload: no name", raw("/uploads")
    yield "upload: unknown parameter", raw("/uploads?filename=tile.laz&colour=red")
    yield "upload: another digest", raw(Content_Digest=f"sha-256=:{wrong}:")
    yield "upload: half a digest", raw(Content_Digest=f"sha-256=:{right[:20]}:")
    yield "upload: a digest that is not base64", raw(Content_Digest="sha-256=:***:")
    yield "upload: two digests", raw(Content_Digest=f"sha-256=:{right}:", Repr_Digest=f"sha-256=:{wrong}:")
    yield "upload: compressed on the way", raw(Content_Encoding="gzip")
    yield "upload: too long by its header", raw(Content_Length="99999999")


def _resumable() -> Iterator[tuple[str, BadRequest]]:
    name = "filename " + base64.b64encode(b"tile.laz").decode()
    good = {"Tus-Resumable": "1.0.0", "Upload-Length": "1000", "Upload-Metadata": name}
    changes: dict[str, dict[str, str | None]] = {
        "no version": {"Tus-Resumable": None},
        "version 0.2.2": {"Tus-Resumable": "0.2.2"},
        "no length": {"Upload-Length": None},
        "negative length": {"Upload-Length": "-1"},
        "a word as length": {"Upload-Length": "long"},
        "too long": {"Upload-Length": "99999999999999"},
        "length comes later": {"Upload-Length": None, "Upload-Defer-Length": "1"},
        "no file name": {"Upload-Metadata": None},
        "file name that is not base64": {"Upload-Metadata": "filename ***"},
        "file name of another kind": {"Upload-Metadata": "filename " + base64.b64encode(b"tile.exe").decode()},
        "concatenation": {"Upload-Concat": "partial"},
    }
    for what, change in changes.items():
        headers = {header: value for header, value in {**good, **change}.items() if value is not None}
        yield f"tus: {what}", BadRequest(method="POST", path="/uploads/tus", headers=headers)
    piece = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    for method in ("PATCH", "DELETE"):
        path = "/uploads/tus/" + "0" * 32
        yield (
            f"tus: {method} of an unknown upload",
            BadRequest(method=method, path=path, headers=piece, content=b"a" if method == "PATCH" else None),
        )


def _others() -> Iterator[tuple[str, BadRequest]]:
    execute = {"inputs": {"tiles": [{"href": f"/uploads/{UPLOAD}"}]}}
    good: dict[str, Any] = {"cron": "30 2 * * *", "execute": execute}
    schedules: dict[str, dict[str, Any]] = {
        "no cron": {"cron": None},
        "four fields": {"cron": "30 2 * *"},
        "minute 61": {"cron": "61 2 * * *"},
        "never": {"cron": "0 0 30 2 *"},
        "words": {"cron": "every night"},
        "@reboot": {"cron": "@reboot"},
        "unknown time zone": {"timeZone": "Europe/Atlantis"},
        "time zone of a path": {"timeZone": "../../etc/passwd"},
        "unknown process": {"processID": "magic"},
        "no request": {"execute": None},
        "bad settings": {"execute": {"inputs": {**execute["inputs"], "settings": {"chimneys": {}}}}},
        "negative grace": {"graceSeconds": -1},
        "unknown overlap": {"overlap": "both"},
        "unknown missed": {"missed": "run-all"},
        "unknown member": {"colour": "red"},
    }
    for what, change in schedules.items():
        document = {name: value for name, value in {**good, **change}.items() if value is not None}
        yield f"schedule: {what}", _json("POST", "/schedules", document)
    webhooks: dict[str, Any] = {
        "nothing": {},
        "no URL": {"events": ["job.failed"]},
        "a word as URL": {"url": "me"},
        "ftp": {"url": "ftp://example.org/"},
        "a private address": {"url": "http://10.0.0.1/hook"},
        "this machine": {"url": "http://[::1]/hook"},
        "the address of a cloud's metadata": {"url": "http://169.254.169.254/"},
        "password in the URL": {"url": "https://user:secret@example.org/"},
        "unknown event": {"url": "https://example.org/", "events": ["job.bored"]},
        "no events": {"url": "https://example.org/", "events": []},
        "unknown member": {"url": "https://example.org/", "colour": "red"},
    }
    for what, document in webhooks.items():
        yield f"webhook: {what}", _json("POST", "/webhooks", document)
    unknown = "/jobs/" + "0" * 32
    yield "retry of an unknown job", _json("POST", f"{unknown}/retry", {})
    yield "keep an unknown job", _json("PATCH", unknown, {"keep": True})
    yield "replay of an unknown delivery", BadRequest(method="POST", path=f"/webhooks/deliveries/{'0' * 32}/replay")
    yield "run of an unknown schedule", BadRequest(method="POST", path=f"/schedules/{'0' * 32}/run")
