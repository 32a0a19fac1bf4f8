"""Real drivers with real clusters over real jobs: killed, drained, several at once."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from faults import asked
from processes import Program, Programs, lives, program, wait_for

from service.features.index import NAME, RowIndex
from service.files import StateFolder
from service.jobs import InputReference, Job, JobRequest, JobStatus
from service.settings import ServiceSettings
from service.store import JobStore

pytestmark = pytest.mark.slow

DEADLINE_S = 300.0


class Site:
    """A state folder with its database, and drivers."""

    def __init__(self, folder: Path, tile: Path, programs: Programs, database_url: str | None) -> None:
        self.tile = tile
        self._gate = folder.with_name("gate")
        self._programs = programs
        self.settings = ServiceSettings(state=folder, database_url=database_url, input_roots=(tile.parent,))
        self.folder = StateFolder(folder)
        self.store = JobStore(self.settings.database)
        self.store.migrate()
        self.environment = {
            "GABLEWORK_STATE": str(folder),
            "GABLEWORK_DATABASE_URL": self.settings.database,
            "GABLEWORK_INPUT_ROOTS": f'["{tile.parent}"]',
            "GABLEWORK_WORKERS": "1",
            "GABLEWORK_DRIVER_JOBS": "1",
            "GABLEWORK_LEASE_S": "10",
            "GABLEWORK_POLL_S": "0.1",
            "OPENBLAS_NUM_THREADS": "1",
        }

    def driver(self, name: str, *, held: bool = False, stage: str = "split", **settings: str) -> Program:
        """A driver; its tasks are held at a stage, as long as `let_go` was not called, where that is wanted."""
        environment = {**self.environment, **{f"GABLEWORK_{key.upper()}": value for key, value in settings.items()}}
        if held:
            self._gate.mkdir()
            environment |= asked.environment(pause={stage: str(self._gate)})
        return self._programs.start(name, [str(program("gablework")), "driver", "--name", name], env=environment)

    def let_go(self) -> None:
        """Let the tasks go on that are held."""
        (self._gate / "go").touch()

    def submit(self) -> Job:
        request = JobRequest(tiles=(InputReference(kind="path", value=str(self.tile)),))
        return self.store.create(request, owner=None)

    def statuses(self, job: Job) -> list[JobStatus]:
        return [event.status for event in self.store.events(job.job_id) if event.status is not None]

    def over(self, job: Job, *drivers: Program) -> Job:
        def is_over() -> Job | None:
            assert any(driver.alive for driver in drivers), "no driver is left"
            found = self.store.get(job.job_id)
            return found if found.status.is_over else None

        return wait_for(is_over, f"the end of {self.store.get(job.job_id)}", DEADLINE_S)

    def held(self, driver: Program) -> None:
        """Wait until a task of the driver is held."""
        driver.wait_for(lambda: any(self._gate.glob("reached-*")), "a task that splits", DEADLINE_S)


@pytest.fixture(params=["sqlite", "postgres"])
def site(request: pytest.FixtureRequest, tmp_path: Path, tile: Path, programs: Programs) -> Iterator[Site]:
    """A site on SQLite, and one on PostgreSQL."""
    url = request.getfixturevalue("postgres_url") if request.param == "postgres" else None
    one = Site(tmp_path / "state", tile, programs, url)
    yield one
    one.store.close()


def test_a_killed_drivers_job_is_finished_once_by_another(site: Site) -> None:
    job = site.submit()
    first = site.driver("first", held=True)
    site.held(first)
    children = first.children()
    first.kill(group=False)
    # its workers do not outlive it
    wait_for(lambda: not [child for child in children if lives(child)], "the end of the workers")
    second = site.driver("second")
    done = site.over(job, second)
    assert (done.status, done.attempt, done.lost_attempts) == (JobStatus.SUCCESSFUL, 2, 1)
    expected = ["accepted", "running", "accepted", "running", "successful"]
    assert site.statuses(job) == expected
    messages = [event.message for event in site.store.events(job.job_id)]
    assert any("driver first was silent" in message for message in messages)
    wait_for(
        lambda: [path.name for path in site.folder.job(job.job_id).iterdir()] == ["attempt-2"], "one attempt's folder"
    )
    assert second.stop() == 0


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_a_driver_that_is_ended_gives_its_job_back_and_another_takes_it_at_once(site: Site) -> None:
    job = site.submit()
    first = site.driver("first", held=True, drain_s="0", lease_s="600")
    site.held(first)
    os.kill(first.pid, signal.SIGTERM)
    first.wait_for(lambda: "the job is given back" in first.text, "the job given back")
    site.let_go()
    assert first.ended() == 0
    waiting = site.store.get(job.job_id)
    assert (waiting.status, waiting.lost_attempts) == (JobStatus.ACCEPTED, 0)
    wait_for(lambda: not first.children(), "the end of the workers")
    second = site.driver("second", lease_s="600")
    done = site.over(job, second)
    assert (done.status, done.attempt, done.lost_attempts) == (JobStatus.SUCCESSFUL, 2, 0)


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_a_first_job_says_that_kernels_are_compiled_and_nothing_of_that_outlives_the_driver(
    site: Site, tmp_path: Path
) -> None:
    job = site.submit()
    site.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "no kernels yet")
    driver = site.driver("first")
    driver.wait_for(lambda: site.store.get(job.job_id).stage == "compile", "the stage of the job")
    assert "compiling, once, about " in site.store.get(job.job_id).message
    assert "compiling, once, about " in driver.text

    def compilers() -> list[psutil.Process]:
        found = []
        for child in driver.children():
            with contextlib.suppress(psutil.NoSuchProcess):
                found += [child] if any("spawn_main" in word for word in child.cmdline()) else []
        return found

    driver.wait_for(compilers, "the processes that compile")
    children = driver.children()
    driver.kill(group=False)
    wait_for(lambda: not [child for child in children if lives(child)], "the end of all that compile")


def shown(folder: Path) -> list[str]:
    """The buildings of an index."""
    with RowIndex(folder / NAME).opened() as connection:
        return [name for (name,) in connection.execute("SELECT id FROM buildings")]


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_buildings_are_read_while_their_job_runs_and_once_more_after_its_driver_was_killed(site: Site) -> None:
    job = site.submit()

    def read(attempt: int) -> list[str]:
        """The buildings that a reader sees."""
        site.store.watch(job.job_id)
        place = site.folder.so_far(job.job_id, attempt)
        if not (place / "outputs.json").exists():
            return []
        return shown(place)

    first = site.driver("first", held=True, stage="publish")
    site.held(first)
    before = first.wait_for(lambda: read(1), "buildings of the first attempt", DEADLINE_S)
    # modelled, but far from published
    assert not list(site.folder.run(job.job_id, 1).glob("state/*"))
    children = first.children()
    assert any("service.driver.so_far_process" in child.cmdline() for child in children)
    first.kill(group=False)
    wait_for(lambda: not [child for child in children if lives(child)], "the end of the workers and of the reader")
    site.let_go()
    second = site.driver("second")
    done = site.over(job, second)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 2)
    assert sorted(before) == sorted(shown(site.folder.outputs(job.job_id, 2)))
    assert len(set(before)) == len(before)
    assert second.stop() == 0


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_a_job_that_no_client_reads_has_no_process_for_readers(site: Site) -> None:
    job = site.submit()
    driver = site.driver("one", held=True, stage="publish")
    site.held(driver)
    assert not any("service.driver.so_far_process" in child.cmdline() for child in driver.children())
    site.let_go()
    assert site.over(job, driver).status is JobStatus.SUCCESSFUL
    assert not site.folder.so_far(job.job_id, 1).exists()


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_a_driver_that_drains_finishes_its_job_first(site: Site) -> None:
    job, waiting = site.submit(), site.submit()
    first = site.driver("first")
    claimed = first.wait_for(
        lambda: next((j for j in (job, waiting) if site.store.get(j.job_id).status is JobStatus.RUNNING), None),
        "a claim",
        DEADLINE_S,
    )
    first.process.terminate()
    assert first.ended(DEADLINE_S) == 0
    assert site.store.get(claimed.job_id).status is JobStatus.SUCCESSFUL
    other = waiting if claimed.job_id == job.job_id else job
    assert site.store.get(other.job_id).status is JobStatus.ACCEPTED


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_a_dismissed_job_stops_within_seconds_and_its_files_are_gone(site: Site) -> None:
    job = site.submit()
    driver = site.driver("one", held=True)
    site.held(driver)
    began = time.monotonic()
    assert site.store.dismiss(job.job_id).dismiss_requested
    assert site.over(job, driver).status is JobStatus.DISMISSED
    print(f"dismissed after {time.monotonic() - began:.2f} s")
    assert not site.folder.job(job.job_id).exists()
    site.let_go()
    following = site.submit()
    assert site.over(following, driver).status is JobStatus.SUCCESSFUL


@pytest.mark.parametrize("site", ["sqlite"], indirect=True)
def test_a_driver_ends_when_its_parent_is_gone(site: Site, tmp_path: Path) -> None:
    job = site.submit()
    script = tmp_path / "supervised.py"
    script.write_text(
        "import sys\n"
        "from service.driver import run_driver\n"
        "from service.settings import ServiceSettings\n"
        "if __name__ == '__main__':\n"
        "    raise SystemExit(run_driver(ServiceSettings(), name='child', parent_pipe=int(sys.argv[1])))\n"
    )
    ours, theirs = os.pipe()
    command = [sys.executable, str(script), str(ours)]
    gate = tmp_path / "gate"
    gate.mkdir()
    held = asked.environment(pause={"split": str(gate)})
    child = subprocess.Popen(
        command, env={**os.environ, **site.environment, **held, "GABLEWORK_LEASE_S": "600"}, pass_fds=[ours]
    )
    try:
        os.close(ours)
        wait_for(lambda: any(gate.glob("reached-*")) or child.poll() is not None, "a run", DEADLINE_S)
        grandchildren = psutil.Process(child.pid).children(recursive=True)
        os.close(theirs)
        (gate / "go").touch()
        assert child.wait(DEADLINE_S) == 0
    finally:
        child.kill()
        child.wait()
    assert site.store.get(job.job_id).status is JobStatus.ACCEPTED
    wait_for(lambda: not [one for one in grandchildren if lives(one)], "the end of the workers")


@pytest.mark.parametrize("site", ["postgres"], indirect=True)
def test_two_drivers_share_twenty_jobs_and_each_is_run_to_its_end_once(site: Site) -> None:
    jobs = [site.submit() for _ in range(20)]
    drivers = [site.driver(name, lease_s="60") for name in ("left", "right")]
    done = [site.over(job, *drivers) for job in jobs]
    assert {job.status for job in done} == {JobStatus.SUCCESSFUL}
    assert {job.attempt for job in done} == {1}
    digests = {job.summary["digest"] for job in done if job.summary is not None}
    assert len(digests) == 1
    for job in jobs:
        assert site.statuses(job) == ["accepted", "running", "successful"]
        assert (site.folder.outputs(job.job_id, 1) / "outputs.json").exists()
    by = Counter(name for driver in drivers for name in [driver.name] * driver.text.count("the job succeeded"))
    assert sum(by.values()) == 20
    assert min(by.values()) >= 1
    assert len(by) == 2
    assert [driver.stop() for driver in drivers] == [0, 0]
