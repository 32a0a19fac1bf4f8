"""Buildings of a job that runs: what its batches have put into scratch, as readers see it before the job is over."""

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cityjson_rules
import finished_runs as runs
import pytest
import small_buildings as small
from running_runs import RunningRun

from pipeline.runtime.models_so_far import ModelsSoFar
from service.driver.janitor import tidy_jobs
from service.driver.so_far_process import follow
from service.errors import StoreBusyError
from service.features.index import NAME, RowIndex
from service.features.pages import feature_texts, sorted_page
from service.jobs import JobStatus
from service.outputs import write_outputs
from service.outputs.single_building import building_cityjson, cityjson_so_far, stored_building

OGC = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
TILE, OTHER = "x850_y4470", "x851_y4470"
GABLE = runs.placed(small.gable(), "gable", 0.0, 0.0)
COURTYARD = runs.placed(small.courtyard(), "courtyard", 20.0, 40.0)
FAILED = runs.placed(small.failed(), "failed", 50.0, 50.0)
TWO_PARTS = runs.placed(small.two_parts(), "two_parts", 130.0, 20.0, 7.0)


@pytest.fixture
def running(tmp_path: Path) -> RunningRun:
    """A run that has modelled nothing yet."""
    return RunningRun(tmp_path / "run")


def features(folder: Path, *, native: bool = False) -> list[dict[str, Any]]:
    """The features that readers see, in the order in which they came."""
    index = RowIndex(folder / NAME)
    _, positions = sorted_page(index, [], by="position", limit=100, offset=0)
    return [
        json.loads(text) for text in feature_texts(index, "buildings", positions, (lambda s: s) if native else None)
    ]


def ids(folder: Path) -> list[str]:
    return [feature["id"] for feature in features(folder)]


def corners(document: dict[str, Any]) -> list[list[float]]:
    """The vertices of a CityJSON document in the units of its CRS."""
    scale, translate = document["transform"]["scale"], document["transform"]["translate"]
    return [[round(v[k] * scale[k] + translate[k], 6) for k in range(3)] for v in document["vertices"]]


def document_faults(document: dict[str, Any], building_id: str) -> list[str]:
    """The faults of a document of one building, by the rules for a sequence of one feature."""
    feature = {"type": "CityJSONFeature", "id": building_id}
    feature |= {part: document[part] for part in ("CityObjects", "vertices")}
    return cityjson_rules.faults([{**document, "CityObjects": {}, "vertices": []}, feature])


# --- the files


def test_buildings_so_far_are_those_of_the_outputs_but_for_their_meshes(running: RunningRun, tmp_path: Path) -> None:
    running.models(TILE, "a", COURTYARD, FAILED)
    running.models(OTHER, "b", TWO_PARTS)
    with running.writer(tmp_path / "so-far") as shown:
        running.add_to(shown)
        running.models(TILE, "c", GABLE)  # lower than the first ones of its tile
        running.add_to(shown)
        shown.show()
    whole = {TILE: [GABLE, COURTYARD, FAILED], OTHER: [TWO_PARTS]}
    finished = runs.write_run(tmp_path / "finished", whole)
    write_outputs(finished, tmp_path / "out")
    assert ids(tmp_path / "so-far") == [r.building_id for r in (COURTYARD, FAILED, TWO_PARTS, GABLE)]
    for native in (False, True):
        now = {feature["id"]: feature for feature in features(tmp_path / "so-far", native=native)}
        later = {feature["id"]: feature for feature in features(tmp_path / "out", native=native)}
        for name, feature in later.items():
            for column in ("mesh_path", "acquired_from", "acquired_to"):  # the last two come with facts of candidates
                feature["properties"][column] = now[name]["properties"][column]
        assert now == later
    for result in (COURTYARD, FAILED, TWO_PARTS, GABLE):
        so_far, end = (
            stored_building(RowIndex(folder / NAME), result.building_id)
            for folder in (tmp_path / "so-far", tmp_path / "out")
        )
        assert so_far.planes == end.planes
        document = cityjson_so_far(tmp_path / "so-far", so_far)
        assert document_faults(document, result.building_id) == []
        assert corners(document) == corners(building_cityjson(finished, end))


def test_a_rejected_candidate_is_not_shown(running: RunningRun, tmp_path: Path) -> None:
    running.models(TILE, "a", GABLE, FAILED, rejected=(FAILED.building_id,))
    with running.writer(tmp_path / "so-far") as shown:
        running.add_to(shown)
        shown.show()
    assert ids(tmp_path / "so-far") == [GABLE.building_id]


def test_a_writer_that_was_killed_shows_nothing_twice_and_loses_nothing(running: RunningRun, tmp_path: Path) -> None:
    folder = tmp_path / "so-far"
    running.models(TILE, "a", COURTYARD)
    first = running.writer(folder)
    with first:
        running.add_to(first)
        first.show()
        running.models(TILE, "b", GABLE)
        running.models(OTHER, "c", TWO_PARTS)
        running.add_to(first)
        # as a killed process leaves it: more in the files than the index knows
        first._city.flush()
        shutil.copytree(folder, tmp_path / "killed")
    assert ids(tmp_path / "killed") == [COURTYARD.building_id]
    city = tmp_path / "killed/city.jsonl"
    known = sum(map(len, city.read_bytes().splitlines(keepends=True)[:2]))
    assert city.stat().st_size > known
    with running.writer(tmp_path / "killed") as second:
        assert len(second.batches) == 1
        assert city.stat().st_size == known
        running.add_to(second)
        running.add_to(second)
        second.show()
    assert ids(tmp_path / "killed") == [r.building_id for r in (COURTYARD, GABLE, TWO_PARTS)]
    for result in (COURTYARD, GABLE, TWO_PARTS):
        found = stored_building(RowIndex(tmp_path / "killed" / NAME), result.building_id)
        assert cityjson_so_far(tmp_path / "killed", found)["CityObjects"][result.building_id]["type"] == "Building"


# --- the process that shows them


def test_the_process_shows_batches_as_they_are_done_until_no_client_reads(tmp_path: Path) -> None:
    folder, seen = tmp_path / "so-far", []
    run: list[RunningRun] = []

    def begins() -> None:
        run.append(RunningRun(tmp_path / "run"))

    def models_two() -> None:
        assert ids(folder) == []
        run[0].models(TILE, "a", COURTYARD)
        run[0].models(OTHER, "b", TWO_PARTS)

    def models_one() -> None:
        seen.append(ids(folder))
        run[0].models(TILE, "c", GABLE)

    def ends() -> None:
        seen.append(ids(folder))
        shutil.rmtree(run[0].run_dir / "scratch")

    def looks_again() -> None:
        seen.append(ids(folder))

    steps: list[Callable[[], None]] = [lambda: None, begins, lambda: None, models_two, models_one, ends, looks_again]

    def wait(_seconds: float) -> bool:
        if steps:
            steps.pop(0)()
            return False
        return True

    follow(tmp_path / "run", folder, wait)
    two = [COURTYARD.building_id, TWO_PARTS.building_id]
    assert seen == [two, [*two, GABLE.building_id], [*two, GABLE.building_id]]


def test_a_run_that_is_over_or_has_not_begun_has_no_models_so_far(tmp_path: Path) -> None:
    assert ModelsSoFar.of_run(tmp_path) is None
    assert ModelsSoFar.of_run(runs.write_run(tmp_path / "run")) is None


# --- by REST


def test_a_job_that_shows_nothing_yet_answers_with_an_empty_list_and_asks_its_driver(tmp_path: Path) -> None:
    with runs.service(tmp_path) as service:
        job = service.running()
        assert service.store.still_held(job).watched_at is None
        for query in ("", "?crs=CRS84", "?crs=native", "?bbox=4,52,5,53"):
            answer = service.client.get(f"/jobs/{job.job_id}/buildings{query}")
            assert answer.status_code == 200, answer.text
            found = answer.json()
            assert (found["complete"], found["numberMatched"], found["features"]) == (False, 0, [])
            assert (found["progress"], found["attempt"]) == (0, 1)
            assert answer.headers["cache-control"] == "no-store"
            assert "etag" not in answer.headers
        watched_at = service.store.still_held(job).watched_at
        assert watched_at is not None
        # one write is enough for many readers
        service.client.get(f"/jobs/{job.job_id}/buildings")
        assert service.store.still_held(job).watched_at == watched_at


def test_a_database_that_cannot_be_written_does_not_prevent_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_busy(_job_id: str) -> None:
        raise StoreBusyError("others hold the locks")

    with runs.service(tmp_path) as service:
        job = service.running()
        monkeypatch.setattr(service.store, "watch", is_busy)
        assert service.client.get(f"/jobs/{job.job_id}/buildings").status_code == 200


def test_a_client_reads_buildings_as_they_come_and_all_of_them_in_the_end(tmp_path: Path) -> None:
    with runs.service(tmp_path) as service:
        job = service.running()
        attempt = service.folder.attempt(job.job_id, 1)
        attempt.mkdir(parents=True)
        running = RunningRun(service.folder.run(job.job_id, 1))
        place = f"/jobs/{job.job_id}/buildings"
        links = service.client.get(f"/jobs/{job.job_id}").json()["links"]
        assert [link["href"] for link in links if link["rel"] == "items"] == [f"http://127.0.0.1{place}"]
        running.models(TILE, "a", COURTYARD, FAILED)
        with running.writer(service.folder.so_far(job.job_id, 1)) as shown:
            running.add_to(shown)
            shown.show()
            first = service.client.get(place).json()
            assert [f["id"] for f in first["features"]] == [COURTYARD.building_id, FAILED.building_id]
            running.models(OTHER, "b", TWO_PARTS)
            running.add_to(shown)
            shown.show()
        for query in ("bbox=85125,447015,85155,447030&bbox-crs=native", "status=ok&roof_type=gable,none&limit=1"):
            assert [f["id"] for f in service.client.get(f"{place}?{query}").json()["features"]] == [
                TWO_PARTS.building_id
            ]
        # what is new comes after what was there
        answer = service.client.get(f"{place}?offset=2")
        more = answer.json()
        assert [f["id"] for f in more["features"]] == [TWO_PARTS.building_id]
        assert (more["complete"], more["numberMatched"]) == (False, 3)
        assert answer.headers["cache-control"] == "no-store"
        one = service.client.get(f"{place}/{TWO_PARTS.building_id}")
        assert one.headers["cache-control"] == "no-store"
        assert one.json()["properties"]["planes"]
        assert [link["href"] for link in one.json()["links"] if "f=" in link["href"]] == [
            f"http://127.0.0.1{place}/{TWO_PARTS.building_id}?f=cityjson"
        ]
        document = service.client.get(f"{place}/{TWO_PARTS.building_id}?f=cityjson").json()
        assert document_faults(document, TWO_PARTS.building_id) == []
        for path in (f"{TWO_PARTS.building_id}?f=obj", f"{TWO_PARTS.building_id}?f=glb", GABLE.building_id):
            detail = runs.problem(service.client.get(f"{place}/{path}"), 404, f"{OGC}result-not-ready")
            assert str(tmp_path) not in detail
        assert "ran one method" in runs.problem(service.client.get(f"{place}?method=kmeans"), 400, "invalid-request")
        # the job is over: the whole list, in the order of the ids
        shutil.rmtree(running.run_dir)
        runs.write_run(running.run_dir, {TILE: [COURTYARD, FAILED, GABLE], OTHER: [TWO_PARTS]})
        write_outputs(running.run_dir, service.folder.outputs(job.job_id, 1))
        service.store.succeed(job, message="done", summary={})
        whole = service.client.get(place)
        assert whole.json()["complete"] is True
        assert [f["id"] for f in whole.json()["features"]] == sorted(
            r.building_id for r in (COURTYARD, FAILED, GABLE, TWO_PARTS)
        )
        assert "attempt" not in whole.json()
        assert whole.headers["cache-control"] == "private, no-cache"


def test_a_new_attempt_begins_with_an_empty_list(tmp_path: Path) -> None:
    with runs.service(tmp_path) as service:
        job = service.running()
        service.folder.attempt(job.job_id, 1).mkdir(parents=True)
        running = RunningRun(service.folder.run(job.job_id, 1))
        running.models(TILE, "a", COURTYARD)
        with running.writer(service.folder.so_far(job.job_id, 1)) as shown:
            running.add_to(shown)
            shown.show()
        place = f"/jobs/{job.job_id}/buildings"
        assert service.client.get(place).json()["numberMatched"] == 1
        service.store.give_up("a driver", max_attempts=3)
        waits = service.client.get(place)
        runs.problem(waits, 404, f"{OGC}result-not-ready")
        again = service.store.claim("another driver", lease_s=3600.0, max_attempts=3)
        assert again is not None
        found = service.client.get(place).json()
        assert (found["attempt"], found["numberMatched"], found["complete"]) == (2, 0, False)


def test_a_comparison_that_runs_has_no_buildings_so_far(tmp_path: Path) -> None:
    with runs.service(tmp_path) as service:
        job = service.running(process_id="compare", methods=("fuzzy-sart", "kmeans"))
        runs.problem(service.client.get(f"/jobs/{job.job_id}/buildings"), 404, f"{OGC}result-not-ready")


def test_what_was_shown_while_a_job_ran_goes_some_time_after_its_end(tmp_path: Path) -> None:
    with runs.service(tmp_path) as service:
        job_id = service.finished()
        so_far = service.folder.so_far(job_id, 1)
        so_far.mkdir()
        tidy_jobs(service.store, service.folder)
        # a client may still read it
        assert so_far.exists()
        an_hour_ago = time.time() - 3600.0
        os.utime(so_far, (an_hour_ago, an_hour_ago))
        assert tidy_jobs(service.store, service.folder) == [so_far]
        assert not so_far.exists()
        assert service.store.get(job_id).status is JobStatus.SUCCESSFUL
        assert service.client.get(f"/jobs/{job_id}/buildings").json()["complete"] is True
