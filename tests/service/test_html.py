"""Documents as pages for people."""

import finished_runs as runs
import httpx
import pytest
from html_pages import Read

from service.routes.html import page

BROWSER = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}


def leaves(value: object) -> list[str]:
    """All texts in a document."""
    if isinstance(value, dict):
        return [leaf for member in value.values() for leaf in leaves(member)]
    if isinstance(value, list):
        return [leaf for member in value for leaf in leaves(member)]
    return [value] if isinstance(value, str) else []


def check(answer: httpx.Response, document: object) -> Read:
    """A page that holds all texts of a document and all its links."""
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    read = Read(answer.text)
    assert read.open == []
    shown = " ".join(read.texts) + " ".join(read.links)
    for leaf in leaves(document):
        assert leaf in shown or f'rel="{leaf}"' in answer.text
    return read


@pytest.mark.parametrize("path", ["/conformance", "/processes", "/processes/reconstruct", "/jobs"])
def test_a_browser_gets_a_page_and_a_program_json(service: runs.Service, path: str) -> None:
    document = service.client.get(path)
    assert document.headers["content-type"] == "application/json"
    assert document.headers["vary"] == "Accept"
    check(service.client.get(path, headers=BROWSER), document.json())
    check(service.client.get(path, params={"f": "html"}), document.json())
    assert service.client.get(path, params={"f": "json"}, headers=BROWSER).json() == document.json()
    assert service.client.get(path, params={"f": "xml"}).status_code == 400


def test_the_pages_of_a_job_lead_to_its_results(service: runs.Service) -> None:
    job_id = service.finished()
    place = f"/jobs/{job_id}"
    read = check(service.client.get(place, headers=BROWSER), service.client.get(place).json())
    results = next(link for link in read.links if link.endswith("/results"))
    listed = check(service.client.get(results, headers=BROWSER), service.client.get(results).json())
    assert any(link.endswith("/results/cityjson") for link in listed.links)


def test_problems_and_files_stay_what_they_are(service: runs.Service) -> None:
    missing = service.client.get(f"/jobs/{'0' * 32}", headers=BROWSER)
    assert (missing.status_code, missing.headers["content-type"]) == (404, "application/problem+json")
    file = service.client.get(f"/jobs/{service.finished()}/results/report", headers={"Accept": "*/*"})
    assert file.headers["content-type"] == "application/json"


def test_a_client_that_asks_for_another_type_still_gets_json(service: runs.Service) -> None:
    answer = service.client.get("/jobs", headers={"Accept": "application/geo+json"})
    assert answer.headers["content-type"] == "application/json"


def test_nothing_of_a_document_becomes_markup_or_a_link_that_runs() -> None:
    hostile = {"<b>": "<script>alert(1)</script>", "links": [{"href": "javascript:alert(1)", "rel": '"><i>'}]}
    text = page("<u>", hostile)
    read = Read(text)
    assert read.links == []
    assert "<script" not in text
    for tag in ("<b>", "<u>", "<i>"):
        assert tag not in text
