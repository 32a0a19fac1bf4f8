"""A client of resumable uploads, as plain as the protocol."""

import base64
from typing import Any

import httpx
from live_service import las_bytes
from processes import wait_for

from service.files import StateFolder

CONTENT = las_bytes(20_000)
LARGE = las_bytes(200_000)
"""More than three blocks."""
TUS = {"Tus-Resumable": "1.0.0"}
PATCH = {**TUS, "Content-Type": "application/offset+octet-stream"}


def metadata(filename: str = "tile.laz", **more: str) -> str:
    pairs = {"filename": filename, **more}
    return ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in pairs.items())


def creation(length: int = len(CONTENT), filename: str = "tile.laz", **more: str) -> dict[str, str]:
    return {**TUS, "Upload-Length": str(length), "Upload-Metadata": metadata(filename, **more)}


def begin(client: httpx.Client, **headers: str) -> str:
    """The URL of a new upload of CONTENT."""
    answer = client.post("/uploads/tus", headers={**creation(), **headers})
    assert answer.status_code == 201, answer.text
    return answer.headers["location"]


def send(client: httpx.Client, url: str, at: int, content: bytes, **headers: str) -> httpx.Response:
    return client.patch(url, headers={**PATCH, "Upload-Offset": str(at), **headers}, content=content)


def offset(client: httpx.Client, url: str, **headers: str) -> int:
    answer = client.head(url, headers={**TUS, **headers})
    assert answer.status_code == 200, answer.status_code
    return int(answer.headers["upload-offset"])


def offset_once_free(client: httpx.Client, url: str) -> int:
    """The same, asked again while the service has not yet noticed that an earlier request has ended."""

    def answered() -> httpx.Response | None:
        answer = client.head(url, headers=TUS)
        return None if answer.status_code == 423 else answer

    answer = wait_for(answered, "the end of the request before")
    assert answer.status_code == 200, answer.status_code
    return int(answer.headers["upload-offset"])


def names_in(service: Any) -> list[str]:
    return [path.name for path in StateFolder(service.settings.state).uploads.iterdir()]
