"""Real processes are killed at every stage of a job: no job is lost or ends twice, and the content is the same.

Every test adds its rows to a table; the last test compares docs/reference/faults.md with it.
"""

import dataclasses
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from checkout import ROOT
from deployment import Deployment, Ended
from fault_table import FAULTS, Fault, Row, markdown, row, strike, without, without_seconds
from processes import Programs, program

pytestmark = pytest.mark.slow

PAGE = ROOT / "docs" / "reference" / "faults.md"

SETTINGS = {"tile_size_m": 60.0}
"""Several tiles, so that both workers have work in every stage."""

POISONS = {
    "crashed": "a building crashes its process",
    "timed_out": "a building never ends",
    "out_of_memory": "a building eats all memory",
}
"""What a building does, by the reason in its record."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Deployment]:
    """The service, for all faults one after the other."""
    folder = tmp_path_factory.mktemp("service")
    some = Programs(folder)
    try:
        deployment = Deployment(some, folder)
        deployment.start_all()
        yield deployment
    finally:
        some.end()


@pytest.fixture(scope="module")
def undisturbed(service: Deployment, town_tile: Path) -> Ended:
    """A job without faults; the second one, since the first also starts the children of the workers."""
    service.ended(service.submit(town_tile, SETTINGS, "first"))
    ended = service.ended(service.submit(town_tile, SETTINGS, "undisturbed"))
    assert (ended.job.status, ended.job.attempt, ended.ends) == ("successful", 1, 1)
    assert len(ended.buildings) >= 24
    assert len(list((ended.run / "state").iterdir())) >= 6
    return ended


@pytest.fixture(scope="module")
def table() -> list[Row]:
    """The rows so far."""
    return []


@pytest.mark.parametrize("fault", FAULTS, ids=[f"{fault.name}: {', '.join(fault.stages)}" for fault in FAULTS])
def test_a_job_outlives(
    fault: Fault, service: Deployment, undisturbed: Ended, town_tile: Path, table: list[Row]
) -> None:
    service.settle()
    outcome = row(fault.name, fault.stages, strike(service, fault, town_tile, SETTINGS), undisturbed)
    table.append(outcome)
    while service.replaced:
        silent = service.replaced.pop()
        assert silent.stop() == 0
        assert "held attempt 1; the job is" in silent.text, "it did not learn that its job has passed on"
    expected = ("successful", fault.begun, 1, "same", "")
    assert (outcome.status, outcome.begun, outcome.ended, outcome.content, outcome.marked) == expected


def test_no_job_is_lost_or_doubled_by_all_of_it(service: Deployment, undisturbed: Ended) -> None:
    service.settle()
    jobs = httpx.get(f"{service.url}/jobs", params={"limit": 1000}, timeout=60.0).json()["jobs"]
    assert sorted(job["jobID"] for job in jobs) == sorted(service.submitted)
    assert {job["status"] for job in jobs} == {"successful"}
    for job in jobs:
        assert sum(event.status == "successful" for event in service.events(job["jobID"])) == 1


def test_buildings_that_kill_their_process_harm_only_themselves(
    undisturbed: Ended, town_tile: Path, table: list[Row], tmp_path: Path, programs: Programs
) -> None:
    crashing, endless, eating = sorted(undisturbed.buildings)[3:24:8]
    expected = {crashing: "crashed", endless: "timed_out", eating: "out_of_memory"}
    variables = {"GABLEWORK_BUILDING_TIMEOUT_S": "15", "GABLEWORK_BUILDING_MEMORY_BYTES": str(2**30)}
    faults = {"crash": [crashing], "endless": [endless], "eat_memory": [eating]}
    service = Deployment(programs, tmp_path, faults=faults, variables=variables)
    service.start_all()
    ended = service.ended(service.submit(town_tile, SETTINGS, "poisonous buildings"))
    marked = {name: reason for name, (status, reason) in ended.buildings.items() if status == "failed"}
    assert marked == expected
    assert without(ended.buildings, expected) == without(undisturbed.buildings, expected)
    for name in service.workers:
        assert service.running[name].alive, "a building killed a worker"
    for name, reason in expected.items():
        bundle = ended.run / "quarantine" / f"{name}.bundle"
        command = [program("gablework"), "replay", bundle, "--json"]
        replayed = subprocess.run(command, capture_output=True, text=True, check=False)
        assert replayed.returncode == 0, replayed.stderr
        assert json.loads(replayed.stdout)["record"]["status"] == "ok"
        outcome = row(POISONS[reason], ("reconstruct",), ended, undisturbed)
        survived = ("successful", 1, 1, "same but for them")
        assert (outcome.status, outcome.begun, outcome.ended, outcome.content) == survived
        marked = f"it alone: `{reason}`; replayed: ok"
        table.append(dataclasses.replace(outcome, content="same but for it", marked=marked))


def test_the_page_says_what_happens(table: list[Row], tmp_path: Path) -> None:
    if len(table) != len(FAULTS) + len(POISONS):
        pytest.skip(f"needs all rows, has {len(table)} of {len(FAULTS) + len(POISONS)}: run the whole file")
    page = tmp_path / "faults.md"
    before, after = PAGE.read_text().split("| fault |")[0], PAGE.read_text().rpartition(" |\n")[2]
    page.write_text(before + markdown(table) + after)
    print(page.read_text())
    assert without_seconds(PAGE.read_text()) == without_seconds(page.read_text()), f"copy {page} to {PAGE}"
