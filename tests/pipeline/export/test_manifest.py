"""run.json: written whole, read back as it was, honest about damage."""

import dataclasses
import datetime as dt
import json
from pathlib import Path

import pytest

from pipeline.errors import RunError
from pipeline.runtime.manifest import InputFile, PointFileFacts, RunManifest, RunStatus, write_manifest
from pipeline.runtime.manifest_reading import read_manifest

FILE = PointFileFacts(
    format="las",
    n_points=4,
    bounds_m=(0.0, 0.5, 2.0, 3.0),
    acquired=(dt.datetime(2025, 1, 2, tzinfo=dt.UTC), dt.datetime(2025, 1, 2, 3, tzinfo=dt.UTC)),
    dimensions={"X": "i4", "gps_time": "f8"},
)


@pytest.fixture
def manifest() -> RunManifest:
    """A finished run with a value in every field."""
    return RunManifest(
        status=RunStatus.INCOMPLETE,
        engine_version="0.1.0",
        method="fuzzy-sart",
        settings={"method": "fuzzy-sart", "vigilance": 0.9, "footprints": None, "ground": {"cell_size_m": 1.0}},
        settings_hash="ab" * 32,
        started_at=dt.datetime(2026, 1, 2, 3, 4, 5, tzinfo=dt.UTC),
        finished_at=dt.datetime(2026, 1, 2, 3, 5, 5, 250, tzinfo=dt.UTC),
        crs={"epsg": 7415, "name": "RD + NAP", "horizontal_unit_m": 1.0, "vertical_unit_m": 1.0},
        inputs=(
            InputFile(
                path="é.laz", sha256="cd" * 32, size_bytes=12, n_points=3, bounds_m=(0.0, 1.0, 2.0, 3.0), file=FILE
            ),
            InputFile(path="outlines.gpkg", sha256="ab" * 32, size_bytes=3),
        ),
        source_licence="CC0, Kadaster",
        tiles=("x85_y447", "x86_y447"),
        failed_tiles=("x86_y447",),
        tiles_without_points=("x85_y447",),
        counts={"candidates": 3, "ok": 2},
        timings_s={"ingest": 0.25},
        peak_memory_bytes={"driver": 1 << 30},
        warnings=("no vertical unit",),
        content_sha256="ef" * 32,
    )


def test_a_manifest_comes_back_as_it_was(tmp_path: Path, manifest: RunManifest) -> None:
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest


def test_the_end_replaces_the_start(tmp_path: Path, manifest: RunManifest) -> None:
    write_manifest(tmp_path, dataclasses.replace(manifest, status=RunStatus.RUNNING, finished_at=None))
    assert read_manifest(tmp_path).status is RunStatus.RUNNING
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path).status is RunStatus.INCOMPLETE
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_a_directory_without_manifest_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"run\.json does not exist: give the directory that a run wrote"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("{", "is no JSON"),
        ("[]", "has format 'list'"),
        ('{"format": 99}', "has format 99"),
        ('{"format": 1}', "is no manifest of a run"),
        ('{"format": 1, "status": "dreaming"}', "dreaming"),
    ],
)
def test_a_damaged_manifest_is_reported_with_what_is_wrong(tmp_path: Path, text: str, reported: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(RunError, match=reported):
        read_manifest(tmp_path)


def test_entries_of_a_later_version_are_left_out(tmp_path: Path, manifest: RunManifest) -> None:
    found = json.loads(manifest.to_json())
    (tmp_path / "run.json").write_text(json.dumps({**found, "colour": "red"}))
    assert read_manifest(tmp_path) == manifest


def test_a_time_without_zone_is_refused(manifest: RunManifest) -> None:
    with pytest.raises(RunError, match="give a time zone"):
        dataclasses.replace(manifest, started_at=manifest.started_at.replace(tzinfo=None))
