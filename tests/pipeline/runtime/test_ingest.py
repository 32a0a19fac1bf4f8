"""Ingest: every point lands in its own tile, once, also when a task runs twice."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import chores
import laspy
import numpy as np
import pytest
from las_files import write_las

from pipeline.errors import InconsistentInputError, UnreadableInputError
from pipeline.io import ReadOptions
from pipeline.io.file_facts import PointRecords
from pipeline.io.las import LasFile
from pipeline.runtime.isolation.process_limits import IsolationLimits
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.ingest import IngestTask, ingest_file
from pipeline.runtime.stages.ingested import spread_m
from pipeline.tiling import TileGrid


def task(path: Path, folder: Path, part: str = "a") -> IngestTask:
    grid = TileGrid(size_mm=30_000, halo_mm=10_000)
    scratch = Scratch(str(folder))
    scratch.create()
    return IngestTask(part=part, path=str(path), options=ReadOptions(), grid=grid, scratch=scratch)


def stored(folder: Path) -> dict[str, np.ndarray]:
    return {path.parent.name: np.fromfile(path, POINT) for path in sorted(folder.glob("points/*/*.bin"))}


def test_points_land_in_their_own_tile(suburb: Path, tmp_path: Path) -> None:
    job = task(suburb, tmp_path)
    found = ingest_file(job)
    buckets = stored(tmp_path)
    assert sum(map(len, buckets.values())) == len(laspy.read(suburb).points)
    assert {tile.key: n for tile, n in found.points_by_tile.items()} == {key: len(p) for key, p in buckets.items()}
    for key, points in buckets.items():
        assert {job.grid.tile_of(int(x), int(y)).key for x, y in zip(points["x"], points["y"], strict=True)} == {key}


def test_coordinates_are_whole_millimetres_of_the_file(suburb: Path, tmp_path: Path) -> None:
    ingest_file(task(suburb, tmp_path))
    las = laspy.read(suburb)
    expected = np.rint(np.column_stack((las.x, las.y, las.z)) * 1000).astype(np.int64)
    points = np.concatenate(list(stored(tmp_path).values()))
    got = np.column_stack([points[name].astype(np.int64) for name in "xyz"])
    assert (got[np.lexsort(got.T)] == expected[np.lexsort(expected.T)]).all()


def test_a_task_that_runs_twice_leaves_every_point_once(suburb: Path, tmp_path: Path) -> None:
    first = ingest_file(task(suburb, tmp_path))
    before = stored(tmp_path)
    assert ingest_file(task(suburb, tmp_path)) == first
    after = stored(tmp_path)
    assert {key: len(p) for key, p in after.items()} == {key: len(p) for key, p in before.items()}
    assert not list(tmp_path.rglob("*.part"))


def test_a_line_has_no_spread_wherever_it_is_cut(tmp_path: Path) -> None:
    results = []
    for index, shift in enumerate((0.0, 400.0)):
        path = tmp_path / f"{index}.xyz"
        along = np.arange(300) + shift
        np.savetxt(path, np.column_stack((4e5 + 0.6 * along, 5e6 + 0.8 * along, along % 5)), fmt="%.3f")
        results.append(ingest_file(task(path, tmp_path / "scratch", index)))
    assert spread_m(results) < 0.01


def test_a_town_has_the_spread_that_numpy_finds(suburb: Path, tmp_path: Path) -> None:
    found = ingest_file(task(suburb, tmp_path))
    las = laspy.read(suburb)
    covariance = np.cov(np.column_stack((las.x, las.y)).T, bias=True)
    assert spread_m([found]) == pytest.approx(np.sqrt(np.linalg.eigvalsh(covariance)[0]), rel=1e-6)


def test_many_tiles_in_a_chunk_are_sorted_apart_as_few_are(
    suburb: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ingest_file(task(suburb, tmp_path / "few"))
    monkeypatch.setattr("pipeline.runtime.stages.ingest._TWO_BYTES", 1)
    many = ingest_file(task(suburb, tmp_path / "many"))
    assert many == few
    for key, bucket in stored(tmp_path / "few").items():
        assert (stored(tmp_path / "many")[key] == bucket).all()


def test_a_run_samples_each_file_once(suburb: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    sampled = []
    whole = LasFile._sample

    def counted(file: LasFile) -> PointRecords:
        sampled.append(file)
        return whole(file)

    monkeypatch.setattr(LasFile, "_sample", counted)
    reconstruct(suburb)
    assert len(sampled) == 1


@pytest.mark.parametrize("stray", [(1e12, 5_934_000.0, 90.0), (5e7, 5_934_000.0, 90.0), (565_010.0, 5_934_000.0, 1e12)])
@pytest.mark.parametrize("place", [0, 500])
def test_one_stray_point_does_not_put_all_points_on_one_line(
    tmp_path: Path, stray: tuple[float, float, float], place: int
) -> None:
    xyz = np.random.default_rng(2).uniform((565_000.0, 5_934_000.0, 60.0), (565_030.0, 5_934_030.0, 90.0), (2000, 3))
    np.savetxt(tmp_path / "a.xyz", np.insert(xyz, place, stray, axis=0), fmt="%.3f")
    found = ingest_file(task(tmp_path / "a.xyz", tmp_path / "scratch"))
    assert spread_m([found]) > 5.0
    assert sum(found.points_by_tile.values()) == 2000 + (stray[0] == 5e7)


LIMITS = IsolationLimits(timeout_s=120.0, memory_bytes=2**30)


@pytest.mark.slow
def test_a_file_read_in_a_process_of_its_own_is_the_same(suburb: Path, tmp_path: Path) -> None:
    here = ingest_file(task(suburb, tmp_path / "here"))
    there = ingest_file(dataclasses.replace(task(suburb, tmp_path / "there"), limits=LIMITS))
    assert there == here
    mine, others = stored(tmp_path / "here"), stored(tmp_path / "there")
    assert mine.keys() == others.keys()
    assert all((points == others[key]).all() for key, points in mine.items())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("chore", "limits", "words"),
    [
        (chores.never_end, dataclasses.replace(LIMITS, timeout_s=1.0), r"nothing more of it could be read for 1 s"),
        (
            chores.end_by_signal,
            LIMITS,
            r"it cannot be read: its process was ended by signal 11 \(SIGSEGV\), also alone",
        ),
        (
            chores.ask_for_too_much,
            LIMITS,
            r"it cannot be read: it asked for more than the 1 GiB that a reader may take",
        ),
    ],
)
def test_a_reader_that_hangs_crashes_or_takes_all_memory_refuses_its_file(
    chore: Callable[[object], None],
    limits: IsolationLimits,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(chores.__file__).parent), prepend=os.pathsep)
    monkeypatch.setattr("pipeline.runtime.stages.ingest._ingest_watched", chore)
    job = dataclasses.replace(task(tmp_path / "a.laz", tmp_path), limits=limits)
    with pytest.raises(UnreadableInputError, match=rf"a\.laz: {words}"):
        ingest_file(job)


@pytest.mark.parametrize(("alone", "refused"), [(300, True), (90, False)])
def test_points_scattered_over_the_earth_are_refused_before_each_tile_has_files(
    tmp_path: Path, alone: int, refused: bool
) -> None:
    draw = np.random.default_rng(2)
    house = draw.uniform(0.0, 30.0, (2000, 3))
    far = np.column_stack([draw.uniform(1e3, 2e6, (alone, 2)), np.zeros(alone)])
    job = task(write_las(tmp_path / "a.las", np.concatenate([house, far])), tmp_path)
    if not refused:
        assert sum(ingest_file(job).points_by_tile.values()) == 2000 + alone
        return
    with pytest.raises(
        InconsistentInputError, match=r"a\.las: 300 of the first 2300 points lie scattered over 300 tiles"
    ):
        ingest_file(job)
    assert not list(tmp_path.glob("points/*"))
