"""The site of the documentation in a browser that opens it from the disk, without a network."""

import re
from collections.abc import Callable

import pytest
from checkout import ROOT
from chromium import Visit
from playwright.sync_api import expect
from processes import missing

SITE = ROOT / "build" / "docs" / "site"

pytestmark = pytest.mark.slow


@pytest.fixture
def site() -> str:
    """URL of the site as `make site` leaves it, with a slash; CI builds it before the tests."""
    if not (SITE / "index.html").is_file():
        missing("the site is not built: run make site")
    return f"{SITE.as_uri()}/"


def test_pages_are_found_by_their_words_and_fit_a_telephone(site: str, visit: Callable[..., Visit]) -> None:
    opened = visit(site, viewport={"width": 390, "height": 800})
    page = opened.page
    page.goto(f"{site}how_to/gis.html")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.keyboard.press("Control+k")
    page.get_by_role("combobox", name="Search").fill("webhook signature")
    expect(page.get_by_role("option", name="Receive and verify")).to_be_visible()
    page.keyboard.press("Enter")
    expect(page).to_have_url(re.compile(r"/how_to/webhooks\.html"))
