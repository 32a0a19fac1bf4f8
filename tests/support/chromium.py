"""One open page: what it loads, what it complains about, and what is seen of its models."""

import colorsys
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Locator, Page, Request, expect

HUES = {"pent": 0.454, "gable": 0.113, "hip": 0.909, "combination": 0.557}
"""Hues of roof types (0 to 1), those of the palette of Okabe and Ito; light does not change them."""


FRAMES_AT_REST = 5
"""Frames alike that show that nothing moves."""


class Visit:
    """A page of Playwright, not opened yet, with its complaints; the service's `url` has a slash at its end."""

    def __init__(self, page: Page, url: str) -> None:
        self.page = page
        self.url = url
        self.errors: list[str] = []
        self.elsewhere: list[str] = []
        self.urls: list[str] = []
        self.expected: tuple[str, ...] = ()
        page.on("console", lambda message: self._complain(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self._complain(str(error)))
        page.on("request", lambda request: self._note(request.url))

    def expect_error(self, *words: str) -> None:
        """Browsers put every answer of 400 and more into the console; these are what the test is about.

        One may have come while the page was loaded.
        """
        self.expected += words
        self.errors = [text for text in self.errors if not any(word in text for word in words)]

    def _complain(self, text: str) -> None:
        if not any(words in text for words in self.expected):
            self.errors.append(text)

    def _note(self, url: str) -> None:
        self.urls.append(url)
        if not url.startswith((self.url, "blob:", "data:")):
            self.elsewhere.append(url)

    def drop(self, tile: Path) -> None:
        """Give the page a tile, and wait until it says what it holds."""
        self.page.set_input_files("#tiles", tile)
        expect(self.page.locator(".facts")).to_contain_text("points")

    @property
    def canvas(self) -> Locator:
        """The canvas of all models; a dossier that was just closed may still hold its own."""
        return self.page.locator("canvas:not(.dossier-canvas)")

    def open_job(self, job: str) -> None:
        """Choose a job of the list, and wait for its models."""
        self.choose_job(job)
        self.wait_for_models()

    def choose_job(self, job: str) -> None:
        """Choose a job of the list; what was shown before is gone then."""
        link = self.page.locator(f'a.job[href="#/jobs/{job}"]')
        link.click()
        expect(link).to_have_attribute("aria-current", "page")

    def wait_for_models(self) -> Locator:
        """The canvas, once all models are drawn."""
        self.page.wait_for_selector("canvas[data-ready]", timeout=600_000)
        self._wait_for_frame()
        return self.canvas

    def _wait_for_frame(self) -> None:
        """Wait until the browser has drawn what it was asked for."""
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def pixels_at_rest(self) -> NDArray[np.uint8]:
        """The same once several frames after one another are alike: the camera has arrived."""
        shots = [self.pixels()]
        while len(shots) < FRAMES_AT_REST or any((shot != shots[-1]).any() for shot in shots[-FRAMES_AT_REST:]):
            shots.append(self.pixels())
        return shots[-1]

    def pixels(self, save_as: Path | None = None) -> NDArray[np.uint8]:
        """What the canvas shows, as rows of red, green, blue."""
        self._wait_for_frame()
        shot = self.canvas.screenshot()
        if save_as is not None:
            save_as.write_bytes(shot)
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def at_rest(drawn: Locator) -> bytes:
    """What an element shows once some frames after one another are alike, as a PNG."""
    shots = [drawn.screenshot()]
    while len(shots) < FRAMES_AT_REST or len(set(shots[-FRAMES_AT_REST:])) > 1:
        drawn.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        shots.append(drawn.screenshot())
    return shots[-1]


def of_hue(pixels: NDArray[np.uint8], roof_type: str) -> NDArray[np.bool_]:
    """Which pixels have the colour of a roof type, lit or in shade."""
    flat = pixels.reshape(-1, 3)
    colours, inverse = np.unique(flat, axis=0, return_inverse=True)
    hsv = np.array([colorsys.rgb_to_hsv(*(colour / 255.0)) for colour in colours])
    away = np.abs(hsv[:, 0] - HUES[roof_type])
    near = (np.minimum(away, 1.0 - away) < 0.02) & (hsv[:, 1] > 0.3) & (hsv[:, 2] > 0.25)
    return near[inverse].reshape(pixels.shape[:2])


def inside_of(mask: NDArray[np.bool_], margin: int = 4) -> tuple[int, int]:
    """Column and row of a pixel whose surroundings are all set: the middle of something, not an edge."""
    size = 2 * margin + 1
    sums = np.pad(mask.astype(np.int64), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    full = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size] == size * size
    rows, columns = np.nonzero(full)
    assert rows.size > 0, f"no {size} by {size} pixels of that colour are seen"
    return int(columns[rows.size // 2]) + margin, int(rows[rows.size // 2]) + margin


def rows(page: Page, name: str = "Jobs"):
    return page.get_by_role("table", name=name).locator("tbody tr")


def at(visit: Callable[..., Visit], url: str, place: str, **options: object) -> Visit:
    """The page at an address."""
    opened = visit(f"{url}{place}", **options)
    opened.url = url
    opened.elsewhere.clear()
    return opened


def posted(request: Request) -> object:
    return json.loads(request.post_data or "null")
