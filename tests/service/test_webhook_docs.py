"""The receiver of the how-to, as it is written there."""

import os
import re
import sys
import time
from pathlib import Path

import httpx
import pytest
from processes import Programs, free_port, programs

from service.webhooks import EventType, new_secret, signed_headers

__all__ = ["programs"]

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how_to" / "webhooks.md"


@pytest.mark.slow
def test_the_receiver_of_the_docs_takes_what_is_signed_and_nothing_else(programs: Programs, tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (block,) = (block for block in blocks if "standardwebhooks" in block)
    port, secret = free_port(), new_secret()
    script = tmp_path / "receiver.py"
    script.write_text(block.replace("9000", str(port)))
    receiver = programs.start(
        "receiver", [sys.executable, "-u", str(script)], env={**os.environ, "WEBHOOK_SECRET": secret}
    )
    receiver.wait_for_port(port)
    body = b'{"type": "job.successful"}'
    now_s = int(time.time())
    url = f"http://127.0.0.1:{port}/"
    good = signed_headers(secret, "a" * 32, now_s, body)
    for _ in range(2):
        assert httpx.post(url, content=body, headers=good).status_code == 204
    assert receiver.text.count("job.successful") == 1
    old = signed_headers(secret, "b" * 32, now_s - 3600, body)
    foreign = signed_headers(new_secret(), "c" * 32, now_s, body)
    for headers, content in ((good, body + b" "), (old, body), (foreign, body)):
        assert httpx.post(url, content=content, headers=headers).status_code == 401


def test_the_page_has_every_event() -> None:
    assert {event.value for event in EventType} == set(re.findall(r"`(job\.[a-z]+)`", PAGE.read_text()))
