"""How long the web page takes to its first picture of a job, and until everything is there, in a real Chromium.

    python -m benchmarks.page_pictures TILE … [--crs EPSG:28992] [--points] [--visits 7] [--pictures DIR]

Submits the tiles to a service of its own and opens the finished job's page again and again, each time in a browser with
empty caches. The first picture is the first frame with models in it; complete is the page once the list, all models,
the terrain and the offer of points are there. Without a graphics card the processor draws, which takes the most time.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import httpx
from playwright.sync_api import Browser, sync_playwright

from benchmarks.service_load import serving

JOB_S = 3600.0
"""How long the job may take."""
SWITCHES = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WATCH = """
window.pictures = {};
new MutationObserver(() => {
    const { models, ready } = document.querySelector("canvas:not(.dossier-canvas)")?.dataset ?? {};
    if (Number(models) > 0) window.pictures.first ??= performance.now();
    if (ready) window.pictures.complete ??= performance.now();
}).observe(document, {
    subtree: true, childList: true, attributes: true, attributeFilter: ["data-models", "data-ready"],
});
"""
"""Notes both times in milliseconds since the navigation began."""


def finished_job(url: str, options: argparse.Namespace) -> str:
    """The id of a job on the tiles, once it is successful."""
    fields = {"points": str(options.points).lower()} | ({"crs": options.crs} if options.crs else {})
    with httpx.Client(base_url=url, timeout=600.0) as client:
        with contextlib.ExitStack() as opened:
            streams = [opened.enter_context(tile.open("rb")) for tile in options.tiles]
            parts = [("tile", (tile.name, stream)) for tile, stream in zip(options.tiles, streams, strict=True)]
            answer = client.post("/jobs", files=parts, data=fields)
        job = answer.raise_for_status().json()["jobID"]
        until = time.monotonic() + JOB_S
        while (status := client.get(f"/jobs/{job}").json())["status"] in {"accepted", "running"}:
            if time.monotonic() > until:
                raise SystemExit(f"job {job} did not end within {JOB_S:.0f} s")
            time.sleep(1.0)
    if status["status"] != "successful":
        raise SystemExit(f"job {job}: {status['message']}")
    print(status["message"])
    return str(job)


def visit(browser: Browser, address: str, picture: Path | None) -> tuple[float, float]:
    """Seconds to the first picture, and until the page is complete."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.add_init_script(WATCH)
    page = context.new_page()
    page.goto(address)
    page.wait_for_selector("canvas[data-ready][data-models]:not([data-models='0'])", timeout=120_000)
    if picture is not None:
        page.screenshot(path=picture)
    times = page.evaluate("[window.pictures.first, window.pictures.complete]")
    context.close()
    return times[0] / 1e3, max(times) / 1e3


def main() -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tiles", nargs="+", type=Path, metavar="TILE")
    parser.add_argument("--crs")
    parser.add_argument("--points", action="store_true", help="let the job write points over the models and terrain")
    parser.add_argument("--visits", type=int, default=7)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="keep a screenshot of each visit")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="gablework-pictures-") as folder,
        serving(Path(folder) / "state") as (url, _),
        sync_playwright() as started,
    ):
        job = finished_job(url, options)
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=SWITCHES)
        shots = [options.pictures and options.pictures / f"visit-{number}.png" for number in range(options.visits)]
        times = [visit(browser, f"{url}/#/jobs/{job}", shot) for shot in shots]
        browser.close()
    print(f"{os.cpu_count()} cores, {options.visits} visits of a job with {len(options.tiles)} tiles")
    for name, found in zip(("first picture", "complete"), zip(*times, strict=True), strict=True):
        print(f"{name:14} {statistics.median(found):.2f} s (best {min(found):.2f}, worst {max(found):.2f})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
