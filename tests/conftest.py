"""Fixtures that every layer shares."""

from __future__ import annotations

import functools
import gc
import os
import shutil
import signal
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest
import typer.testing
from examples import PROFILE, examples

if TYPE_CHECKING:
    from object_store import FaultyProxy

    from pipeline.model import BoolArray
    from pipeline.terrain.filter_settings import MorphologicalFilterSettings
    from pipeline.terrain.lattice import Elevations, Part

pytest.register_assert_rewrite(
    "schedule_contract",
    "schedule_store_contract",
    "store_contract",
    "webhook_store_contract",
)

# The same examples in every run: a change fails by what it changed, not by the draw. To search for new ones:
# HYPOTHESIS_PROFILE=search make unit
hypothesis.settings.register_profile("repeatable", derandomize=True)
hypothesis.settings.register_profile("quick", derandomize=True, max_examples=examples(100))
hypothesis.settings.register_profile("search", print_blob=True)
hypothesis.settings.load_profile(PROFILE)

SHARED_DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"

REQUIRED = "GABLEWORK_REQUIRE_SHARED_DATA"
"""Environment variable of .ci/run: 1 makes a test that needs the real data fail where it would skip."""

REQUIRED_PROGRAMS = "GABLEWORK_REQUIRE_PROGRAMS"
"""Environment variable of .ci/run: 1 makes a test that needs PostgreSQL or Chromium fail where it would skip."""

LONGEST_FIRST = (
    "service/viewer",
    "pipeline/runtime/cluster/test_batch_faults.py",
    "pipeline/runtime/cluster/test_faults.py",
    "pipeline/compiler/test_wheel.py",
    "pipeline/runtime/cluster/test_batch_store_faults.py",
    "pipeline/runtime/cluster/test_workers.py",
    "service/driver/test_driver_processes.py",
    "service/openapi/test_schemathesis.py",
    "pipeline/runtime/cluster/test_tls_cluster.py",
    "pipeline/runtime/test_work.py",
    "pipeline/runtime/test_overrides.py",
    "pipeline/runtime/test_tile_independence.py",
    "pipeline/runtime/test_object_store_runs.py",
    "benchmarks/test_city_scale.py",
    "benchmarks/test_entries.py",
    "pipeline/runtime/test_isolation.py",
    "pipeline/runtime/test_classify.py",
    "pipeline/ruler/simulation/test_solids.py",
    "service/postgres/test_schedules.py",
    "service/postgres/test_store.py",
    "pipeline/report/test_evaluation_page.py",
    "pipeline/roof/test_arrangement_parts.py",
    "service/test_buildings_api.py",
    "pipeline/export/test_tile_update.py",
    "pipeline/runtime/test_replay.py",
    "pipeline/runtime/test_run.py",
)
"""Tests that take longest. They begin first, so that no process works on one of them alone at the end."""

TOGETHER = ("tests/service/viewer",)
"""Folders whose tests share one process: a browser without a graphics card leaves little time for a second one."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Bring the longest tests to the front; pytest-xdist hands them out in this order."""
    places = {Path(__file__).parent / name: place for place, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: min(places.get(path, len(places)) for path in (item.path, item.path.parent)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Give each process whole files, and those that belong `TOGETHER` to one."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = str(super()._split_scope(nodeid))
            return next((folder for folder in TOGETHER if file.startswith(f"{folder}/")), file)

    return Scheduling(config, log)


def pytest_configure() -> None:
    """Look for cycles more rarely, as `start_own_process` has it; have Ctrl-C reach what the tests start.

    A shell has the commands that it starts in the background ignore Ctrl-C, and their children inherit that.
    """
    gc.set_threshold(100_000, *gc.get_threshold()[1:])
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Look for no cycles among modules and tests, which all stay."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def computed_once() -> Generator[None]:
    """Keep what pure functions gave for the same input, where tests would compute it hundreds of times.

    The ground of the few scenes that most runs of the tests are of takes a third of such a run, and the command line's
    options are built anew by each call. The tests of both call the functions themselves.
    """
    import pipeline.terrain.morphological as morphological

    filtered = morphological.morphological_ground
    command = functools.cache(typer.testing._get_command)
    masks: dict[object, tuple[BoolArray, BoolArray]] = {}

    def kept(
        lowest: Elevations, corner: tuple[int, int], settings: MorphologicalFilterSettings, wanted: tuple[Part, int]
    ) -> tuple[BoolArray, BoolArray]:
        # slices have no hash before Python 3.12
        key = (lowest.shape, lowest.tobytes(), corner, settings, repr(wanted))
        if key not in masks:
            masks[key] = filtered(lowest, corner, settings, wanted)
        ground, steady = masks[key]
        return ground.copy(), steady.copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(morphological, "morphological_ground", kept)
        patch.setattr(typer.testing, "_get_command", command)
        yield


@pytest.fixture(scope="session")
def needs_program() -> Callable[..., str]:
    """The path of the first of some programs that is there; a test without any of them skips with their names."""

    def find(*candidates: str) -> str:
        for name in candidates:
            found = shutil.which(name)
            if found is not None:
                return found
        reported = f"none of the programs {', '.join(candidates)} is installed"
        if os.environ.get(REQUIRED_PROGRAMS) == "1":
            pytest.fail(f"{reported}, but {REQUIRED_PROGRAMS}=1")
        pytest.skip(reported)

    return find


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data beside the checkout; tests that need it skip where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real data not found at ../shared/data ({SHARED_DATA})")
    return SHARED_DATA


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turn the skip of a test that needs the real data into a failure, where the environment requires the data."""
    report = yield
    needs_data = "shared_data" in getattr(item, "fixturenames", ())
    if report.skipped and needs_data and not hasattr(report, "wasxfail") and os.environ.get(REQUIRED) == "1":
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} needs ../shared/data and was skipped, but {REQUIRED}=1: {report.longrepr}"
    return report


@pytest.fixture(scope="session")
def s3_proxy() -> Generator[FaultyProxy]:
    """An S3 server behind a proxy, for as long as the tests last."""
    pytest.importorskip("s3fs", reason="the extra s3 is not installed")
    from object_store import FaultyProxy, moto_server

    with moto_server() as url, FaultyProxy(url) as proxy:
        yield proxy


@pytest.fixture
def s3(s3_proxy: FaultyProxy, monkeypatch: pytest.MonkeyPatch) -> FaultyProxy:
    """An object store as the environment of this process names it, behind a proxy that a test may make faulty."""
    from object_store import environment

    for name, value in environment(s3_proxy.endpoint).items():
        monkeypatch.setenv(name, value)
    s3_proxy.reset()
    return s3_proxy


@pytest.fixture
def bucket(s3: FaultyProxy) -> str:
    """The URL of a bucket of its own."""
    from uuid import uuid4

    from pipeline.extras.remote.urls import filesystem_of

    url = f"s3://tests-{uuid4().hex[:12]}"
    filesystem_of(url).mkdir(url)
    s3.reset()
    return url
