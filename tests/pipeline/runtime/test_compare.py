"""Several methods over the same candidates: each as if it had run alone, the scene split once."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.errors import InputError, RunCancelledError, RunError, SettingsError
from pipeline.extras.compare.compare import (
    BUILDINGS,
    PAGE,
    REPORT,
    SUMMARY,
    CompareRequest,
    CompareSummary,
    Variant,
    compare,
    own_tables,
    parse_variants,
    settings_of,
)
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.stages import model_batch, rehearsal
from pipeline.runtime.stages.rehearsal import load_once
from pipeline.settings import RunSettings

BOTH = parse_variants(["fuzzy-sart,fuzzy-sart:faithful"])


def request(suburb: Path, out: Path, **fields: object) -> CompareRequest:
    run_request = RunRequest(inputs=(str(suburb),), out=str(out), resources=SERIAL)
    return CompareRequest(run=dataclasses.replace(run_request, **fields), variants=BOTH)


Compared = tuple[CompareSummary, list[Event]]


@pytest.fixture(scope="module")
def compared(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """Both presets of Fuzzy SART on the suburb, and the events meanwhile."""
    events: list[Event] = []
    return compare(request(suburb, tmp_path_factory.mktemp("compared") / "out"), events.append), events


@pytest.mark.parametrize("variant", BOTH, ids=lambda variant: variant.label)
def test_each_variant_has_the_content_of_a_run_of_its_own(
    suburb: Path, compared: Compared, variant: Variant, tmp_path: Path
) -> None:
    settings = RunSettings.from_mapping({"method": variant.method, "preset": variant.preset})
    alone = run(RunRequest(inputs=(str(suburb),), out=str(tmp_path / "alone"), settings=settings, resources=SERIAL))
    beside = compared[0].runs[variant.label]
    assert beside.digest == alone.digest
    assert beside.counts == alone.counts
    manifests = [json.loads((Path(found.run_dir) / "run.json").read_text()) for found in (alone, beside)]
    for name in ("status", "method", "settings", "settings_hash", "inputs", "tiles", "counts", "content_sha256"):
        assert manifests[0][name] == manifests[1][name], name


def test_the_presets_differ(compared: Compared) -> None:
    assert len({found.digest for found in compared[0].runs.values()}) == 2


def test_candidates_are_found_once_and_modelled_once_a_variant(compared: Compared) -> None:
    summary, events = compared
    stages = [event.stage for event in events if event.kind == "stage"]
    once = ["ingest", "cells", "ground", "split", "join", "outline"]
    assert stages == [*once, "reconstruct", "reconstruct", "publish", "publish"]
    candidates = summary.runs["fuzzy-sart"].counts["candidates"]
    modelled = [event for event in events if event.stage == "reconstruct"]
    counted = [(event.done, event.total) for event in modelled if event.kind == "progress"]
    assert counted == sorted(counted)
    assert counted[-1] == (2 * candidates, 2 * candidates)
    assert {event.total for event in modelled} == {2 * candidates}


def test_every_building_has_its_seconds(compared: Compared) -> None:
    summary, _ = compared
    first, second = summary.seconds.values()
    assert set(first) == set(second)
    assert len(first) == summary.runs["fuzzy-sart"].counts["candidates"]
    assert min(first.values()) > 0.0


def test_nothing_but_the_runs_is_left(compared: Compared) -> None:
    out = Path(compared[0].out)
    assert [entry.name for entry in out.iterdir()] == ["runs"]
    assert sorted(entry.name for entry in (out / "runs").iterdir()) == ["fuzzy-sart", "fuzzy-sart-faithful"]


def test_a_comparison_that_is_cancelled_says_so_in_every_run(suburb: Path, tmp_path: Path) -> None:
    seen: list[str] = []

    def listen(event: Event) -> None:
        seen.append(event.stage)
        if event.stage == "reconstruct" and event.done > 0:
            raise RunCancelledError("the listener calls it off")

    with pytest.raises(RunCancelledError):
        compare(request(suburb, tmp_path / "out"), listen)
    states = [json.loads(path.read_text())["status"] for path in sorted((tmp_path / "out").glob("runs/*/run.json"))]
    assert states == ["cancelled", "cancelled"]
    assert not (tmp_path / "out" / "scratch").exists()


def test_another_comparison_replaces_all_of_the_earlier_one_when_asked(suburb: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    stale = out / "runs" / "an-earlier-method"
    stale.mkdir(parents=True)
    (stale / "run.json").write_text("{}")
    with pytest.raises(RunError, match="is not empty"):
        compare(request(suburb, out))
    assert stale.exists()
    compare(request(suburb, out, overwrite=True))
    assert not stale.exists()


@pytest.mark.parametrize("files", [["thesis.docx"], ["thesis.docx", "runs/of-mine/run.json"]], ids=["other", "alike"])
def test_a_folder_of_something_else_is_never_replaced(suburb: Path, tmp_path: Path, files: list[str]) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("{}")
    with pytest.raises(RunError, match=r"holds thesis\.docx and is no comparison"):
        compare(request(suburb, tmp_path, overwrite=True))
    assert all((tmp_path / name).exists() for name in files)


def test_no_page_of_an_earlier_comparison_stands_beside_runs_that_were_cancelled(suburb: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "runs").mkdir(parents=True)
    for name in (SUMMARY, BUILDINGS, REPORT, PAGE):
        (out / name).write_text("of an earlier comparison")

    def listen(event: Event) -> None:
        if event.stage == "split":
            raise RunCancelledError("the listener calls it off")

    nowhere = request(tmp_path / "nowhere.laz", out, overwrite=True)
    with pytest.raises(InputError):
        compare(nowhere)
    assert (out / PAGE).exists()
    with pytest.raises(RunCancelledError):
        compare(request(suburb, out, overwrite=True), listen)
    assert [entry.name for entry in out.iterdir()] == ["runs"]
    with pytest.raises(RunCancelledError):
        compare(request(suburb, out, overwrite=True), listen)


def test_no_building_is_charged_for_loading_its_method(
    suburb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[str] = []
    # a clock that stands still but while a method is loaded
    monkeypatch.setattr(model_batch, "time", SimpleNamespace(perf_counter=lambda: 100.0 * len(loaded), time=float))
    monkeypatch.setattr(rehearsal, "load", loaded.append)
    load_once.cache_clear()
    try:
        variants = parse_variants(["fuzzy-sart,kmeans,fuzzy-sart:faithful"])
        summary = compare(dataclasses.replace(request(suburb, tmp_path / "out"), variants=variants))
    finally:
        load_once.cache_clear()  # nothing was loaded
    assert loaded == ["fuzzy-sart", "kmeans"]
    assert {seconds for each in summary.seconds.values() for seconds in each.values()} == {0.0}


def test_a_run_by_one_method_loads_nothing_ahead(suburb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(rehearsal, "load_once", loaded.append)
    run(RunRequest(inputs=(str(suburb),), out=str(tmp_path / "out"), resources=SERIAL))
    assert loaded == []


@pytest.mark.parametrize(
    ("texts", "fault"),
    [
        (["magic,fuzzy-sart"], "method is 'magic': use one of"),
        (["fuzzy-sart:bold,fuzzy-sart"], "preset is 'bold': use one of robust, faithful"),
        (["fuzzy-sart", "fuzzy-sart"], "methods holds fuzzy-sart twice"),
        (["fuzzy-sart"], "give two or more"),
        ([""], "method is ''"),
    ],
)
def test_senseless_variants_are_refused(texts: list[str], fault: str) -> None:
    with pytest.raises(SettingsError, match=fault):
        parse_variants(texts)


def test_a_methods_own_table_counts_for_all_its_variants() -> None:
    table = {"fuzzy-sart": {"vigilance": 0.8}, "roof": {"min_points": 12}}
    own = RunSettings.from_mapping(table)
    for variant in BOTH:
        chosen = settings_of(own, variant, own_tables(table))
        named = {"method": variant.method, "preset": variant.preset, **table}
        assert chosen.settings_hash == RunSettings.from_mapping(named).settings_hash
    with pytest.raises(SettingsError, match=r"\[fuzzy-sart\] vigilance is 9"):
        settings_of(own, BOTH[0], {"fuzzy-sart": {"vigilance": 9.0}})


def test_settings_that_name_a_method_or_a_preset_are_refused_and_not_passed_over() -> None:
    with pytest.raises(SettingsError, match=r"settings\.preset is 'faithful': name what is compared in methods"):
        own_tables({"preset": "faithful", "kmeans": {}})
    with pytest.raises(SettingsError, match=r"settings\.method is 'kmeans'"):
        own_tables({"method": "kmeans"})
