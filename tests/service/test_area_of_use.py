"""A tile far outside the area of use of its CRS: the preflight says so, and a job needs the client's confirmation."""

from typing import Any

import pytest
from live_service import POINTS, las_bytes

from pipeline.errors import CrsError
from service.driver.failure_words import Scrubber
from service.wording import as_inputs

WRONG = "EPSG:2193"
"""New Zealand's grid, for points in Delft."""


def sent(local_service: Any, content: bytes, name: str = "delft.laz") -> dict[str, Any]:
    answer = local_service.client.post(f"/uploads?filename={name}", content=content)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def submitted(local_service: Any, upload: dict[str, Any], **inputs: Any) -> Any:
    tiles = [{"href": f"/uploads/{upload['uploadID']}"}]
    return local_service.client.post("/processes/reconstruct/execution", json={"inputs": {"tiles": tiles, **inputs}})


def test_the_preflight_says_where_the_tile_lies_and_what_the_crs_is_for(local_service) -> None:
    known = sent(local_service, las_bytes())["preflight"]
    assert known["place"] == pytest.approx({"longitude": 4.357, "latitude": 52.009}, abs=0.01)
    assert known["areaOfUse"]["name"].startswith("Netherlands")
    assert known["areaOfUse"]["west"] < known["place"]["longitude"] < known["areaOfUse"]["east"]
    assert known["outsideAreaOfUse"] is None
    assert known["usable"] is True


def test_a_wrong_crs_in_the_header_is_a_problem_with_the_place_and_the_fix(local_service) -> None:
    known = sent(local_service, las_bytes(crs=WRONG))["preflight"]
    assert known["usable"] is False
    (problem,) = known["problems"]
    assert problem == known["outsideAreaOfUse"]
    for words in (WRONG, "75.98° S", "New Zealand", "the input crs", "the input allowOutsideAreaOfUse"):
        assert words in problem
    assert "--" not in problem


def test_it_is_refused_until_the_crs_is_right_or_the_place_is_confirmed(local_service) -> None:
    upload = sent(local_service, las_bytes(crs=WRONG))
    refused = submitted(local_service, upload)
    assert refused.status_code == 422
    assert refused.json()["type"].endswith(":outside-area-of-use")
    assert "delft.laz: in EPSG:2193" in refused.json()["detail"]
    assert submitted(local_service, upload, crs="EPSG:28992").status_code == 201
    allowed = submitted(local_service, upload, allowOutsideAreaOfUse=True)
    assert local_service.request_of(allowed).allow_outside_area_of_use
    job = local_service.client.get(f"/jobs/{allowed.json()['jobID']}").json()
    assert job["request"]["inputs"]["allowOutsideAreaOfUse"] is True


@pytest.mark.parametrize("content", [las_bytes(), las_bytes(crs=None), POINTS])
def test_a_wrong_crs_of_the_request_is_refused_by_the_bounds_of_the_upload(local_service, content: bytes) -> None:
    upload = sent(local_service, content, "delft.xyz" if content is POINTS else "delft.laz")
    refused = submitted(local_service, upload, crs=WRONG)
    assert refused.status_code == 422
    assert "75.98° S" in refused.json()["detail"]
    assert submitted(local_service, upload, crs=WRONG, allowOutsideAreaOfUse=True).status_code == 201
    assert local_service.client.get("/jobs").json()["jobs"] != []


def test_a_form_refuses_and_allows_in_the_same_way(local_service) -> None:
    files = {"tile": ("delft.laz", las_bytes(crs=WRONG))}
    assert local_service.client.post("/jobs", files=files).status_code == 422
    made = local_service.client.post("/jobs", files=files, data={"allowOutsideAreaOfUse": "true"})
    assert local_service.request_of(made).allow_outside_area_of_use


def test_messages_of_the_engine_name_inputs_in_place_of_options() -> None:
    fault = CrsError("/srv/a.laz", "no CRS", "Give --crs EPSG:n, or check --bbox and --aoi")
    assert Scrubber()(str(fault)).endswith("a.laz: no CRS. Give the input crs, or check the input bbox")
    assert as_inputs("start it with --crs-file") == "start it with --crs-file"
    for option, words in as_inputs.names.items():
        assert as_inputs(f"give {option} if") == f"give {words} if"


def test_a_tile_without_crs_is_warned_about_in_words_of_the_service(local_service) -> None:
    known = sent(local_service, las_bytes(crs=None))["preflight"]
    (warning,) = known["warnings"]
    assert warning.endswith("give the input crs")
