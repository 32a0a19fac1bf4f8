"""Pages and their pictures as tests look at them."""

import io
import re
from html.parser import HTMLParser

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

VOID = {"meta", "img", "rect", "line", "circle", "polyline", "br", "input"}


class Reader(HTMLParser):
    """Elements with their attributes; complains where one is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["style"], ["script"]):
            self.texts.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        """The attributes of all elements of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]


def pixels(png: bytes) -> np.ndarray:
    """A picture as (h, w, 4) from 0 to 1."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA")).astype(np.float64) / 255.0


def count(png: bytes, colour: str) -> int:
    """Opaque pixels of a colour."""
    picture = pixels(png)
    near = np.abs(picture[:, :, :3] - to_rgb(colour)).max(axis=2) < 0.03
    return int(np.sum(near & (picture[:, :, 3] > 0.9)))


def assert_links_stay_within(read: Reader) -> None:
    """Every link and picture of a page is of the page itself."""
    for _, attributes in read.elements:
        for name in ("src", "href", "xlink:href", "srcset", "action"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/png;base64,"))


def assert_loads_nothing(text: str, scripts: int = 0) -> Reader:
    """A page is one file that loads nothing and holds only scripts of its own; the elements of the page."""
    read = Reader(text)
    assert read.open == []
    assert len(read.all("script")) == scripts
    assert not {"link", "iframe", "object", "embed"} & {tag for tag, _ in read.elements}
    assert_links_stay_within(read)
    assert not any(name.startswith("on") for _, attributes in read.elements for name in attributes)
    assert not re.search(r"https?:|url\(|@import", text)
    return read


def assert_pictures_have_words_and_ids_are_unique(read: Reader) -> None:
    """Each image says in words what it shows, and each link leads to one place of the page."""
    assert all(len(image["alt"] or "") > 20 for image in read.all("img"))
    names = [attributes["id"] for _, attributes in read.elements if "id" in attributes]
    assert len(set(names)) == len(names)
    assert {(link["href"] or "")[1:] for link in read.all("a")} <= set(names)
