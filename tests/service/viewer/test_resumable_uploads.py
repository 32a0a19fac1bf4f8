"""Uploads: tus-js-client against the service, and the page that loses its network or is loaded again meanwhile."""

import hashlib
import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from chromium import Visit
from gate import Gate, gate_before
from live_service import DEADLINE_S, las_bytes
from playwright.sync_api import expect

import hatch_build

pytestmark = [pytest.mark.slow]

Open = Callable[..., Visit]
HERE = Path(__file__).resolve().parent
SOME_BYTES = 3_000_000


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tile whose upload takes its time."""
    path = tmp_path_factory.mktemp("large") / "large.las"
    path.write_bytes(las_bytes(400_000, compressed=False))
    return path


@pytest.fixture
def gate(service: str) -> Iterator[Gate]:
    with gate_before(service) as opened:
        yield opened


def uploads(service: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = httpx.get(f"{service}uploads?limit=1000").json()["uploads"]
    return found


# --- tus-js-client


def test_tus_js_client_brings_a_file_through_ten_broken_connections(
    service: str, gate: Gate, large: Path, built_page: Path
) -> None:
    node, _ = hatch_build._node()
    size = large.stat().st_size
    command = [
        str(node),
        str(HERE / "tus_client.mjs"),
        str(built_page.parent.parent),
        f"{gate.url}/uploads/tus",
        str(large),
    ]
    gate.allow(size // 12)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
        for _ in range(10):
            gate.wait_until_used_up(DEADLINE_S)
            gate.cut()
            gate.allow(size // 12)
        gate.allow(float("inf"))
        reported, _ = client.communicate(timeout=DEADLINE_S)
    events = [json.loads(line) for line in reported.splitlines()]
    assert "done" in events[-1], events
    record = httpx.get(events[-1]["done"].replace(gate.url, service.rstrip("/"))).json()
    assert record["sha256"] == hashlib.sha256(large.read_bytes()).hexdigest()
    assert record["filename"] == "large.las"
    offsets = [int(event["offset"]) for event in events if event.get("method") == "HEAD" and event["status"] == 200]
    assert len(offsets) >= 10
    assert offsets == sorted(offsets)
    assert gate.passed_bytes < 1.2 * size


def test_tus_js_client_hears_why_a_file_is_refused(service: str, tmp_path: Path, built_page: Path) -> None:
    node, _ = hatch_build._node()
    bad = tmp_path / "bad.las"
    bad.write_bytes(b"not a tile" * 1000)
    command = [
        str(node),
        str(HERE / "tus_client.mjs"),
        str(built_page.parent.parent),
        f"{service}uploads/tus",
        str(bad),
    ]
    reported = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=DEADLINE_S, check=True).stdout
    last = json.loads(reported.splitlines()[-1])
    assert json.loads(last["body"])["type"] == "urn:gablework:problem:unusable-input"


# --- the page


def _patches(visit: Visit) -> list[int]:
    """The offsets at which the page sends, one per request; filled while it sends."""
    found: list[int] = []
    visit.page.on(
        "request",
        lambda request: found.append(int(request.headers["upload-offset"])) if request.method == "PATCH" else None,
    )
    return found


def _come_back(visit: Visit, gate: Gate) -> None:
    """Leave the page while its upload is held up, and open it again where nothing is held back."""
    visit.expect_error("ERR_", "Failed to load resource")
    visit.page.goto("about:blank")  # a page that is still there would go on by itself
    gate.cut()
    gate.allow(float("inf"))
    visit.page.goto(f"{gate.url}/")


def _expect_uploaded(visit: Visit, name: str = "large.las") -> None:
    expect(visit.page.locator(".file", has_text=name).locator(".facts").first).to_contain_text("points")
    expect(visit.page.get_by_role("button", name="Reconstruct")).to_have_attribute("aria-disabled", "false")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_waits_for_the_network_and_goes_on(
    visit: Open, gate: Gate, large: Path, scheme: str, tmp_path: Path
) -> None:
    opened = visit(f"{gate.url}/", viewport={"width": 390, "height": 844}, color_scheme=scheme)
    opened.expect_error("ERR_", "Failed to load resource")
    offsets = _patches(opened)
    gate.allow(SOME_BYTES)
    opened.page.set_input_files("#tiles", large)
    gate.wait_until_used_up(DEADLINE_S)
    expect(opened.page.locator(".sent")).to_contain_text("MB are sent")
    opened.page.screenshot(path=tmp_path / f"sending-{scheme}.png", full_page=True)
    gate.shut(True)
    gate.cut()
    expect(opened.page.locator(".sent")).to_contain_text("The service does not answer. It continues by itself.")
    opened.page.screenshot(path=tmp_path / f"waiting-{scheme}.png", full_page=True)
    assert opened.page.evaluate("document.documentElement.scrollWidth") == 390
    gate.allow(float("inf"))
    gate.shut(False)
    _expect_uploaded(opened)
    assert len(offsets) >= 2
    assert offsets[-1] > 0


def test_a_page_that_was_left_offers_to_go_on_and_does(
    visit: Open, gate: Gate, large: Path, service: str, tmp_path: Path
) -> None:
    opened = visit(f"{gate.url}/")
    gate.allow(SOME_BYTES)
    opened.page.set_input_files("#tiles", large)
    gate.wait_until_used_up(DEADLINE_S)
    _come_back(opened, gate)
    offered = opened.page.get_by_role("list", name="Interrupted uploads")
    expect(offered).to_contain_text("Choose the file again to continue.")
    opened.page.screenshot(path=tmp_path / "offered.png", full_page=True)
    offsets = _patches(opened)
    opened.page.set_input_files("#tiles", large)
    expect(offered).to_be_empty()
    _expect_uploaded(opened)
    assert offsets[0] > 0
    assert uploads(service)[0]["sha256"] == hashlib.sha256(large.read_bytes()).hexdigest()
    opened.page.reload()
    expect(
        opened.page.get_by_role("button", name="Add a tile first").or_(opened.page.locator("#tiles"))
    ).to_be_attached()
    opened.page.wait_for_function("localStorage.length === 0")


def test_an_interrupted_upload_that_is_forgotten_is_gone_from_the_service(visit: Open, gate: Gate, large: Path) -> None:
    opened = visit(f"{gate.url}/")
    gate.allow(SOME_BYTES)
    opened.page.set_input_files("#tiles", large)
    gate.wait_until_used_up(DEADLINE_S)
    _come_back(opened, gate)
    with opened.page.expect_response(lambda answer: answer.request.method == "DELETE") as removed:
        opened.page.get_by_role("button", name="Forget large.las").click()
    assert removed.value.status == 204
    opened.page.wait_for_function("localStorage.length === 0")


def test_a_file_that_is_removed_while_it_is_sent_leaves_nothing(visit: Open, gate: Gate, large: Path) -> None:
    opened = visit(f"{gate.url}/")
    gate.allow(SOME_BYTES)
    opened.page.set_input_files("#tiles", large)
    gate.wait_until_used_up(DEADLINE_S)
    with opened.page.expect_response(lambda answer: answer.request.method == "DELETE") as removed:
        opened.page.get_by_role("button", name="Remove large.las").click()
        gate.allow(float("inf"))
    assert removed.value.status in {204, 423}
    opened.page.wait_for_function("localStorage.length === 0")
