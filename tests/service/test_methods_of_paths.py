"""Every path announces the methods that it has, and refuses the others: also where two templates match one path."""

from __future__ import annotations

from typing import Any

import pytest
from starlette.routing import Route

from service.app import ROUTERS
from service.guard import TUS

ROUTES = [route for router in ROUTERS for route in router.routes if isinstance(route, Route)]
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE")


def paths() -> dict[str, set[str]]:
    """All templates of paths, with their methods."""
    found: dict[str, set[str]] = {}
    for route in ROUTES:
        found.setdefault(route.path, set()).update(route.methods or ())
    return found


def one_of(template: str) -> str:
    """A path of a template, whose variables match nothing else."""
    return "/".join("x1" if part.startswith("{") else part for part in template.split("/"))


@pytest.mark.parametrize("template", paths())
def test_options_names_the_methods_of_the_path_and_no_other(local_service: Any, template: str) -> None:
    own = paths()[template]
    answer = local_service.client.options(one_of(template))
    assert answer.status_code == 204
    expected = own | {"OPTIONS"} | ({"HEAD"} if "GET" in own else set())
    assert set(answer.headers["allow"].split(", ")) == expected


@pytest.mark.parametrize("template", paths())
def test_any_other_method_is_refused_with_those_that_are_there(local_service: Any, template: str) -> None:
    for method in sorted(set(METHODS) - paths()[template]):
        headers = {"Tus-Resumable": "1.0.0"} if template.startswith(TUS) else {}
        answer = local_service.client.request(method, one_of(template), headers=headers)
        assert answer.status_code == 405, (method, answer.text)
        announced = set(answer.headers["allow"].split(", "))
        assert method not in announced
        assert paths()[template] <= announced


def test_some_paths_overlap_so_that_the_tests_above_show_something() -> None:
    overlapping = {
        (route.path, other)
        for route in ROUTES
        for other in paths()
        if route.param_convertors and "{" not in other and route.path_regex.match(other)
    }
    assert ("/webhooks/{webhookID}", "/webhooks/secret") in overlapping
    assert ("/uploads/{uploadID}", "/uploads/tus") in overlapping
