"""Traces: off by default and free then; spans of stages, tiles and slow buildings where they are on."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
from opentelemetry.trace import StatusCode
from trace_receiver import collecting
from traced import Spans, id_of, parent_of, spans, trace_of

from pipeline.model import Reason
from pipeline.runtime.monitoring import measurement, tracing
from pipeline.runtime.monitoring.measurement import Measured
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.monitoring.tracing import Parent
from pipeline.runtime.stages.batch_figures import Modelled
from pipeline.runtime.stages.reconstruct import _traced
from pipeline.tiling import Tile

__all__ = ["spans"]

ABOVE = Parent(trace_id=0xA, span_id=0xB, is_sampled=True)


@pytest.fixture
def fresh() -> Iterator[None]:
    """What was read from the environment is read again."""
    for cached in (tracing.is_on, measurement.slow_building_s):
        cached.cache_clear()
    yield
    for cached in (tracing.is_on, measurement.slow_building_s):
        cached.cache_clear()


def modelled(building_id: str, seconds: float, **values: object) -> Modelled:
    known = {"building_id": building_id, "owner": Tile(0, 0), "status": "ok", "reason": None, "roof_type": "gable"}
    known |= {"faces": 7, "points": 100, "seconds": seconds, "ended_s": 1000.0}
    return Modelled(**known | values)


@pytest.mark.slow
def test_nothing_that_makes_spans_is_imported_unless_a_collector_is_named() -> None:
    code = """
import os, sys
for name in [name for name in os.environ if name.startswith("OTEL_")]:
    del os.environ[name]
import service.app, service.driver, pipeline.runtime.run
from pipeline.runtime.monitoring import tracing
with tracing.span("a", b=1) as made:
    assert made is None and tracing.current() is None
# FastAPI itself imports the interface, not what makes and sends spans
loaded = [name for name in sys.modules if name.startswith(("opentelemetry.sdk", "opentelemetry.exporter"))]
assert not loaded, loaded
assert "pipeline.runtime.run" in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("variables", "on"),
    [
        ({}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://localhost:4318"}, True),
        ({"OTEL_EXPORTER_OTLP_TRACES_ENDPOINT": "http://localhost:4318/v1/traces"}, True),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://localhost:4318", "OTEL_SDK_DISABLED": "true"}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://localhost:4318", "OTEL_TRACES_EXPORTER": "none"}, False),
    ],
)
def test_the_variables_of_the_standard_turn_traces_on(
    fresh: None, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], on: bool
) -> None:
    for name in (*measurement.ENDPOINTS, "OTEL_SDK_DISABLED", "OTEL_TRACES_EXPORTER"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert tracing.is_on() is on


def test_without_the_library_the_log_says_what_to_install(
    fresh: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://localhost:4318")
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    assert tracing.is_on() is False
    assert "install gablework[otel]" in caplog.text


@pytest.mark.parametrize("text", [None, "", "00-abc", f"00-{0:032x}-{1:016x}-01", f"00-{1:032x}-{0:016x}-01"])
def test_a_header_that_names_no_span_is_ignored(text: str | None) -> None:
    assert Parent.of(text) is None


def test_a_header_comes_back_as_it_was() -> None:
    assert Parent.of(ABOVE.traceparent) == ABOVE


def test_a_stage_has_its_tiles_and_a_tile_its_parts(spans: Spans) -> None:
    progress = Progress(lambda _event: None)
    facts = {"building_id": "b"}
    part = measurement.Part(name="building", began_s=101.0, ended_s=102.5, error="timed_out", facts=facts)
    found = Measured(result=1, seconds=4.0, cpu_s=1.0, began_s=100.0, process="far:7", peak_bytes=5, tile="0_0")
    with tracing.span("attempt", parent=ABOVE), progress.stage("reconstruct", 3):
        progress.measured(found, lambda: [part])
        with progress.stage("quiet", 1, quiet=True):
            progress.measured(Measured(result=1, seconds=1.0, cpu_s=1.0, began_s=1.0, process="far:8", peak_bytes=5))
    attempt, stage, tile = (spans.one(name) for name in ("attempt", "stage reconstruct", "tile"))
    building, task = spans.one("building"), spans.one("task")
    assert [parent_of(one) for one in (attempt, stage, tile, building, task)] == [
        ABOVE.span_id,
        id_of(attempt),
        id_of(stage),
        id_of(tile),
        id_of(stage),
    ]
    assert {trace_of(one) for one in (attempt, stage, tile, building, task)} == {ABOVE.trace_id}
    assert (tile.start_time, tile.end_time) == (100 * 10**9, 104 * 10**9)
    assert (building.start_time, building.end_time) == (101 * 10**9, 1025 * 10**8)
    assert tile.attributes == {"gablework.tile": "0_0", "gablework.process": "far:7", "gablework.cpu_s": 1.0}
    assert (building.status.status_code, building.status.description) == (StatusCode.ERROR, "timed_out")


def test_a_block_that_fails_marks_its_span_without_the_message(spans: Spans) -> None:
    with pytest.raises(ZeroDivisionError), tracing.span("attempt"):
        raise ZeroDivisionError("a secret path")
    failed = spans.one("attempt")
    assert (failed.status.status_code, failed.status.description) == (StatusCode.ERROR, "ZeroDivisionError")
    assert not failed.events


def test_a_span_that_is_not_sampled_stays_away_with_all_below_it(spans: Spans) -> None:
    with tracing.span("attempt", parent=Parent(1, 2, is_sampled=False)), tracing.span("stage split"):
        tracing.finished("tile", 1.0, 2.0)
        below = tracing.current()
    assert below is not None
    assert below.is_sampled is False
    assert not [name for name in ("attempt", "stage split", "tile") if spans.named(name)]


def test_a_span_with_given_ids_is_the_one_under_which_others_were_made(spans: Spans) -> None:
    with tracing.span("attempt", parent=ABOVE):
        pass
    tracing.own_span("job", ABOVE, None, 5.0, error=None, status="successful")
    job = spans.one("job")
    assert (trace_of(job), id_of(job), parent_of(job)) == (ABOVE.trace_id, ABOVE.span_id, None)
    assert parent_of(spans.one("attempt")) == id_of(job)
    # the ids of others are random again
    with tracing.span("other"):
        pass
    assert id_of(spans.one("other")) != ABOVE.span_id


def test_only_slow_buildings_and_lost_ones_get_spans(fresh: None, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = modelled("lost", 0.1, status="failed", reason=Reason.TIMED_OUT.value)
    some = [modelled("quick", 0.4), modelled("slow", 2.0), modelled("kept", 9.0, reused=True), lost]
    assert [part.facts["building_id"] for part in _traced(some)] == ["slow", "lost"]
    slow, gone = _traced(some)
    assert (slow.began_s, slow.ended_s, slow.error) == (998.0, 1000.0, None)
    assert gone.error == "timed_out"
    monkeypatch.setenv("GABLEWORK_TRACE_BUILDING_S", "0.3")
    measurement.slow_building_s.cache_clear()
    assert [part.facts["building_id"] for part in _traced(some)] == ["quick", "slow", "lost"]


@pytest.mark.parametrize("text", ["soon", "nan", "-1"])
def test_a_limit_for_buildings_that_makes_no_sense_costs_a_warning(
    fresh: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    monkeypatch.setenv("GABLEWORK_TRACE_BUILDING_S", text)
    assert measurement.slow_building_s() == measurement.SLOW_BUILDING_S
    assert f"GABLEWORK_TRACE_BUILDING_S is {text!r}" in caplog.text


@pytest.mark.slow
def test_a_process_sends_its_last_spans_and_does_not_wait_for_a_dead_collector() -> None:
    code = """
from pipeline.runtime.monitoring import tracing
for _ in range(3000):
    with tracing.span("a"):
        pass
tracing.END_S = {end_s}
"""
    with collecting() as collector:
        environment = {**os.environ, "OTEL_EXPORTER_OTLP_ENDPOINT": collector.url, "OTEL_BSP_MAX_QUEUE_SIZE": "4000"}
        subprocess.run([sys.executable, "-c", code.format(end_s=60)], check=True, env=environment)
        assert len(collector.named("a")) == 3000
        dead = collector.url
    environment["OTEL_EXPORTER_OTLP_ENDPOINT"] = dead
    ended = subprocess.run(
        [sys.executable, "-c", code.format(end_s=0.01)], check=True, env=environment, capture_output=True, text=True
    )
    # the library alone would try each of its six batches for ten seconds
    assert ended.stderr.count("Failed to export") < 6
