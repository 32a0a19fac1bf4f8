"""The Python of the how-to pages that use the service runs as it is written there, and each has all three ways."""

import contextlib
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from client_site import OUTLINES, Site, event
from finished_runs import ident, write_comparison, write_run
from live_service import POINTS, las_bytes

from service.outputs import write_comparison_outputs, write_outputs
from service.outputs.published_forms import publish

HOW_TO = Path(__file__).resolve().parents[2] / "docs" / "how_to"
METHODS = ["fuzzy-sart", "fuzzy-sart:faithful"]
IMPORT = "from service.client import"
PAGES = sorted(path.name for path in HOW_TO.glob("*.md") if IMPORT in path.read_text())


def blocks(page: str) -> list[str]:
    """The blocks of Python that use the client."""
    found = re.findall(r"^```python\n(.*?)^```", (HOW_TO / page).read_text(), re.MULTILINE | re.DOTALL)
    return [block for block in found if "client" in block]


@contextlib.contextmanager
def driven(site: Site) -> Iterator[None]:
    """A driver whose jobs succeed at once with the results of a run that is there already."""
    ending = threading.Event()

    def drive() -> None:
        while not ending.wait(0.02):
            job = site.store.claim("a driver", lease_s=3600.0, max_attempts=3)
            if job is None:
                continue
            site.store.record(job, [event("stage", stage="split", progress=10)])
            folder, outputs = site.runs.folder, site.runs.folder.outputs(job.job_id, job.attempt)
            if job.request.process_id == "compare":
                labels = ("fuzzy-sart", "fuzzy-sart-faithful")
                written = write_comparison(folder.comparison(job.job_id, job.attempt))
                write_comparison_outputs(written, labels, outputs, job.request.outputs)
            elif job.request.process_id == "reconstruct":
                run_dir = write_run(folder.run(job.job_id, job.attempt))
                publish(run_dir, outputs, job.request.publish, name=job.job_id)
                write_outputs(run_dir, outputs, job.request.outputs)
            site.store.succeed(job, message="done", summary={})

    driver = threading.Thread(target=drive)
    driver.start()
    try:
        yield
    finally:
        ending.set()
        driver.join()


@pytest.mark.parametrize("page", sorted(path.name for path in HOW_TO.glob("*.md")))
def test_a_page_that_uses_the_service_shows_curl_the_command_and_python(page: str) -> None:
    text = (HOW_TO / page).read_text()
    if "curl" in text:
        assert re.search("gablework (submit|watch|fetch|jobs|request) ", text), "the command"
        assert IMPORT in text, "Python"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs(site: Site, page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = site.folder / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(site.cache))
    site.restart(webhook_hosts=("hooks.example.org",))
    monkeypatch.setenv("GABLEWORK_URL", site.url)
    for name, points in {"tile": 500, "east": 600, "west": 700, "large": 20_000}.items():
        Path(f"{name}.laz").write_bytes(las_bytes(points))
    Path("outlines.geojson").write_bytes(OUTLINES)
    names: dict[str, object] = {}
    with driven(site):
        for block in blocks(page):
            exec(compile(_placed(block, site), page, "exec"), names)


def _placed(block: str, site: Site) -> str:
    """A block with URL, files and ids that exist."""
    client = site.client()
    block = re.sub(r'"https?://(127\.0\.0\.1:8000|models\.example\.org)"', repr(site.url), block)
    block = block.replace("outlines.gpkg", "outlines.geojson").replace(', key_file="key.txt"', "")
    for word, make in {
        "JOB": lambda: client.wait(client.submit("tile.laz", new=True)).id,
        "COMPARISON": lambda: client.wait(client.submit("tile.laz", process="compare", methods=METHODS, new=True)).id,
        "UPLOAD": lambda: client.upload(site.file("points.xyz", POINTS)),
    }.items():
        if re.search(rf"\b{word}\b", block):
            block = re.sub(rf"\b{word}\b", make(), block)
    return block.replace("3givd2mvtyerfjxv2yytjbmi", ident("gable"))
