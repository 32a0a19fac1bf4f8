"""The buildings of a running job on the page, as outlines; the test is the driver that says how far the job is."""

from collections.abc import Callable
from pathlib import Path

import finished_runs as runs
import pytest
import small_buildings as small
from chromium import Visit
from playwright.sync_api import expect
from running_runs import RunningRun

from service.files import StateFolder
from service.jobs import InputReference, Job, JobEvent, JobRequest
from service.settings import ServiceSettings
from service.store import JobStore

pytestmark = pytest.mark.slow

GABLE = runs.placed(small.gable(), "gable", 0.0, 0.0)
COURTYARD = runs.placed(small.courtyard(), "courtyard", 20.0, 40.0)
FAILED = runs.placed(small.failed(), "failed", 50.0, 50.0)
TWO_PARTS = runs.placed(small.two_parts(), "two_parts", 130.0, 20.0, 7.0)


def claimed(store: JobStore) -> Job:
    job = store.claim("the test", lease_s=3600.0, max_attempts=3)
    assert job is not None
    return job


def models(store: JobStore, job: Job) -> None:
    """Say that the job models its buildings."""
    event = JobEvent(
        sequence=0, at=store.now(), kind="stage", stage="reconstruct", done=1, total=4, progress=60, message="modelled"
    )
    store.record(job, [event])


def test_a_first_job_shows_what_is_compiled_before_its_other_stages(
    driverless: tuple[str, Path], visit: Callable[..., Visit]
) -> None:
    url, state = driverless
    with JobStore(ServiceSettings(state=state).database) as store:
        request = JobRequest(tiles=(InputReference(kind="path", value="/srv/tile.laz"),), title="the first")
        store.create(request, owner=None)
        job = claimed(store)
        page = visit(url).page
        page.goto(f"{url}#/jobs/{job.job_id}")
        expect(page.get_by_role("progressbar", name="Progress of the job")).to_be_visible()
        stages = page.locator(".stages .stage")
        expect(stages.first).to_have_text("Prepare the inputs")

        def reported(stage: str, done: int, total: int, message: str) -> None:
            known = {"stage": stage, "done": done, "total": total, "message": message}
            store.record(job, [JobEvent(sequence=0, at=store.now(), kind="stage", **known)])  # type: ignore[arg-type]

        reported("compile", 3, 106, "compiling, once, about 27 s")
        expect(page.locator(".progress-words")).to_contain_text("compiling, once, about 27 s")
        expect(stages.first).to_have_text("Compile, once on this machine3 of 106 kernels")
        expect(stages.first).to_have_attribute("aria-current", "step")
        expect(page.locator(".stage-done")).to_have_count(0)
        reported("inputs", 0, 1, "inputs are prepared")
        expect(stages.nth(1)).to_have_attribute("aria-current", "step")
        expect(page.locator(".stage-done")).to_have_text(["Compile, once on this machine3 of 106 kernels"])


def test_outlines_come_as_buildings_are_modelled_and_begin_anew_with_an_attempt(
    driverless: tuple[str, Path], visit: Callable[..., Visit]
) -> None:
    url, state = driverless
    folder = StateFolder(state)
    with JobStore(ServiceSettings(state=state).database) as store:
        request = JobRequest(tiles=(InputReference(kind="path", value="/srv/tile.laz"),), title="a town")
        store.create(request, owner=None)
        job = claimed(store)
        folder.attempt(job.job_id, 1).mkdir(parents=True)
        running = RunningRun(folder.run(job.job_id, 1))
        page = visit(url).page
        page.goto(f"{url}#/jobs/{job.job_id}")
        plan = page.get_by_role("img", name="Outlines of the buildings so far, seen from above")
        expect(page.get_by_role("progressbar", name="Progress of the job")).to_be_visible()
        expect(plan).not_to_be_visible()
        models(store, job)
        running.models("x850_y4470", "a", COURTYARD, FAILED)
        with running.writer(folder.so_far(job.job_id, 1)) as shown:
            running.add_to(shown)
            shown.show()
            expect(plan).to_be_visible()
            # one of the two has no outline
            expect(plan.locator("path")).to_have_count(1)
            expect(page.locator(".so-far figcaption")).to_have_text("2 buildings so far")
            running.models("x851_y4470", "b", TWO_PARTS)
            running.models("x850_y4470", "c", GABLE)
            running.add_to(shown)
            shown.show()
        expect(page.locator(".so-far figcaption")).to_have_text("4 buildings so far")
        expect(plan.locator("path")).to_have_count(3)
        # the driver was lost, and another one began anew
        with store._database.write() as connection:
            connection.exec_driver_sql("UPDATE jobs SET attempt = 2")
        expect(plan).not_to_be_visible()
