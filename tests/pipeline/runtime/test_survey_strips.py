"""Flight strips that lie above one another: named with their offset, and the houses on them are found."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import invoke
from plain_houses import AREAS_M2, SIDE_M, houses, write_houses
from run_tables import rows

from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.model import Reason
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import run


def two_strips(path: Path, lift_m: float, tilt_m: float = 0.0) -> Path:
    """The houses in two strips that cover all; the second lies higher, and rises from west to east."""
    found = houses(per_m2=8.0)
    strips = np.random.default_rng(6).integers(11, 13, len(found.house))
    share = (found.xyz[:, 0] - 400_000.0) / SIDE_M - 0.5
    return write_houses(path, found, strips=strips, lift_m=(strips == 12) * (lift_m + tilt_m * share))


def two_passes(path: Path, lift_m: float, source: int = 0, gap_s: float = 40.0) -> Path:
    """The same in two passes of one id: the second higher, and a turn later; without a gap there are no times."""
    found = houses(per_m2=8.0)
    late = np.random.default_rng(6).integers(0, 2, len(found.house))
    along_s = (found.xyz[:, 0] - 400_000.0) / 60.0
    times_s = 230_407.0 + late * gap_s + along_s if gap_s else 0.0
    return write_houses(path, found, strips=source, lift_m=late * lift_m, times_s=times_s)


def warning_of(summary: Any) -> str:
    """The warning about strips; empty without one."""
    return next((warning for warning in summary.warnings if "flight strips" in warning), "")


@pytest.mark.parametrize("lift_m", [0.3, 0.45, 0.6, 1.5])
def test_houses_in_strips_that_disagree_are_found_and_the_strips_named(
    lift_m: float, tmp_path: Path, reconstruct: Any
) -> None:
    summary = reconstruct(two_strips(tmp_path / "tile.laz", lift_m))
    assert summary.statuses == {"ok": 3}
    found = rows(summary.run_dir)
    assert sorted(row["footprint_area_m2"] for row in found) == pytest.approx(AREAS_M2, rel=0.06)
    assert f"strip 11 lies {lift_m:.2f} m below strip 12" in warning_of(summary)
    # a house stays at the mean of the strips, its height stays true
    assert min(row["ridge_z"] for row in found) == pytest.approx(55.0 + lift_m / 2, abs=0.06)
    assert max(row["height_m"] for row in found) == pytest.approx(10.0, abs=0.25)


@pytest.mark.parametrize("survey", [two_strips, two_passes])
def test_strips_that_fit_are_not_named_and_not_moved(survey: Any, tmp_path: Path, reconstruct: Any) -> None:
    summary = reconstruct(survey(tmp_path / "tile.laz", 0.03))
    assert summary.statuses == {"ok": 3}
    assert warning_of(summary) == ""
    assert read_manifest(summary.run_dir).strip_moves_m == {}


@pytest.mark.parametrize(
    ("survey", "said"),
    [(two_strips, "strip 11 lies 0.60 m below strip 12"), (two_passes, "strip 0 at GPS time 230400 to")],
)
def test_inspect_names_the_strips(survey: Any, said: str, tmp_path: Path) -> None:
    code, out, _ = invoke("inspect", str(survey(tmp_path / "tile.laz", 0.6)), "--json")
    assert code == 0
    assert any(said in warning for warning in json.loads(out)["warnings"])


@pytest.mark.parametrize("survey", [two_strips, two_passes])
def test_an_object_that_its_strips_keep_from_being_a_building_says_so(
    survey: Any, tmp_path: Path, reconstruct: Any
) -> None:
    summary = reconstruct(survey(tmp_path / "tile.laz", 0.8), settings={"strips": {"align_m": 10.0}})
    said = [row for row in rows(summary.run_dir, "rejected") if row["reason"] == Reason.STRIPS_DISAGREE]
    assert said
    assert all(row["reason_detail"].startswith("strips lie 0.80 m apart, at most 0.1; vegetation: ") for row in said)


def test_houses_in_a_tilted_strip_are_found_and_the_strips_named_with_their_range(
    tmp_path: Path, reconstruct: Any
) -> None:
    summary = reconstruct(two_strips(tmp_path / "tile.laz", 0.0, tilt_m=1.2))
    assert summary.statuses == {"ok": 3}
    assert "strip 11 lies -0.3" in warning_of(summary)


def test_the_moves_of_strips_are_a_setting(tmp_path: Path, reconstruct: Any) -> None:
    path = two_strips(tmp_path / "tile.laz", 0.6)
    summary = reconstruct(path, settings={"strips": {"align_m": 1.0}})
    assert read_manifest(summary.run_dir).strip_moves_m == {}
    assert "aligned one by one" in warning_of(summary)
    assert read_manifest(reconstruct(path).run_dir).strip_moves_m == {"11": 0.3, "12": -0.3}


def test_moved_strips_are_read_again_in_words_and_once_in_a_work_folder(tmp_path: Path, reconstruct: Any) -> None:
    events: list[Event] = []
    place = {"work": str(tmp_path / "work"), "out": str(tmp_path / "run"), "on_event": events.append}
    path = two_strips(tmp_path / "tile.laz", 0.6)
    first = reconstruct(path, **place)
    # each reading is a stage of its own: an attempt is judged by the stage that runs
    assert [event.stage for event in events if event.kind == "stage"][:4] == 2 * ["ingest", "cells"]
    events.clear()
    again = reconstruct(path, **place)
    assert (again.digest, warning_of(again)) == (first.digest, warning_of(first))
    reading = [event for event in events if event.stage in {"ingest", "cells"}]
    assert [event.stage for event in reading if event.kind == "stage"] == ["ingest", "cells"]
    done = [(event.done, event.kept) for event in reading if event.kind == "progress"]
    assert done
    assert all(count == kept for count, kept in done), "something was read again"


def test_strips_of_another_file_are_compared_again(tmp_path: Path, reconstruct: Any) -> None:
    place = {"work": str(tmp_path / "work"), "out": str(tmp_path / "run")}
    path = tmp_path / "tile.laz"
    for lift_m, move_m in ((0.6, 0.3), (0.8, 0.4), (0.03, 0.0)):
        found = read_manifest(reconstruct(two_strips(path, lift_m), **place).run_dir).strip_moves_m
        assert found == ({"11": move_m, "12": -move_m} if move_m else {})


@pytest.mark.slow
def test_moved_strips_depend_on_neither_tiles_nor_workers_nor_files(tmp_path: Path, reconstruct: Any) -> None:
    path = two_strips(tmp_path / "tile.laz", 0.6)
    whole = reconstruct(path)
    tiled = reconstruct(path, settings={"tile_size_m": 23.0, "lattice_x_m": 3.0})
    request = RunRequest(inputs=(str(path),), out=str(tmp_path / "workers"), resources=Resources(workers=2))
    assert {whole.digest, tiled.digest, run(request).digest} == {whole.digest}


@pytest.mark.slow
def test_a_rerun_moves_the_strips_as_the_run_did(tmp_path: Path, reconstruct: Any) -> None:
    summary = reconstruct(two_strips(tmp_path / "tile.laz", 0.6), out=str(tmp_path / "run"))
    before = {row["building_id"]: row["ridge_z"] for row in rows(summary.run_dir)}
    one = min(before)
    again = rerun(RerunRequest(run_dir=summary.run_dir, only=(one,), resources=Resources(workers=0)))
    assert again.digest == summary.digest
    assert {row["building_id"]: row["ridge_z"] for row in rows(summary.run_dir)} == before


# --- strips that no id separates


@pytest.mark.parametrize("lift_m", [0.3, 0.45, 0.6, 1.5])
@pytest.mark.parametrize("source", [0, 31])
def test_houses_in_strips_of_one_id_are_found_by_gps_times_which_name_the_strips(
    source: int, lift_m: float, tmp_path: Path, reconstruct: Any
) -> None:
    summary = reconstruct(two_passes(tmp_path / "tile.laz", lift_m, source))
    assert summary.statuses == {"ok": 3}
    assert sorted(row["footprint_area_m2"] for row in rows(summary.run_dir)) == pytest.approx(AREAS_M2, rel=0.06)
    first, second = (f"strip {source} at GPS time {times}" for times in ("230400 to 230416", "230440 to 230456"))
    assert f"{first} lies {lift_m:.2f} m below {second}" in warning_of(summary)


def test_strips_without_ids_in_files_of_their_own_are_found(tmp_path: Path, reconstruct: Any) -> None:
    whole = houses(per_m2=8.0)
    late = np.random.default_rng(6).random(len(whole.house)) < 0.5
    paths = []
    for number, own in enumerate((~late, late)):
        one = dataclasses.replace(whole, xyz=whole.xyz[own], house=whole.house[own])
        path = tmp_path / f"strip-{number}.laz"
        paths.append(write_houses(path, one, strips=0, lift_m=0.6 * number, times_s=5000.0 + 100.0 * number))
    summary = reconstruct(*paths)
    assert summary.statuses == {"ok": 3}
    assert "lies 0.60 m below strip 0 at GPS time" in warning_of(summary)


@pytest.mark.parametrize("kind", ["random", "row", "milliseconds"])
def test_houses_in_strips_with_ids_are_found_whatever_their_gps_times(
    kind: str, tmp_path: Path, reconstruct: Any
) -> None:
    found = houses(per_m2=8.0)
    random, n = np.random.default_rng(6), len(found.house)
    strips = random.integers(11, 13, n)
    passes_ms = 1.6e12 + strips * 6e5 + (found.xyz[:, 0] - 400_000.0) * 200.0
    times_s = {"random": random.uniform(0.0, 1e5, n), "row": np.arange(n), "milliseconds": passes_ms}[kind]
    lift_m = (strips == 12) * 0.6
    summary = reconstruct(write_houses(tmp_path / "t.laz", found, strips=strips, lift_m=lift_m, times_s=times_s))
    assert summary.statuses == {"ok": 3}
    assert read_manifest(summary.run_dir).strip_moves_m == {"11": 0.3, "12": -0.3}


def test_ids_of_other_strips_do_not_change_what_is_found_in_separated_passes(tmp_path: Path, reconstruct: Any) -> None:
    found = houses(per_m2=9.0)
    number = np.random.default_rng(6).integers(0, 3, len(found.house))
    content = {"lift_m": (number > 0) * 0.3, "times_s": 1000.0 + 500.0 * number}
    digests = set()
    # the ids of separated passes count down from 65535
    for other in (9, 65535):
        path = write_houses(tmp_path / f"{other}.laz", found, strips=np.array([7, 7, other])[number], **content)
        digests.add(reconstruct(path).digest)
    assert len(digests) == 1


@pytest.mark.parametrize("lift_m", [0.3, 0.6])
def test_strips_that_nothing_separates_are_named_as_two_surfaces(
    lift_m: float, tmp_path: Path, reconstruct: Any
) -> None:
    path = two_passes(tmp_path / "tile.laz", lift_m, gap_s=0.0)
    said = f"two surfaces {lift_m:.2f} m apart"
    assert any(said in warning for warning in reconstruct(path).warnings)
    _, out, _ = invoke("inspect", str(path), "--json")
    assert any(said in warning for warning in json.loads(out)["warnings"])


@pytest.mark.slow
def test_passes_depend_on_neither_tiles_nor_workers_and_a_rerun_moves_them_alike(
    tmp_path: Path, reconstruct: Any
) -> None:
    path = two_passes(tmp_path / "tile.laz", 0.6)
    whole = reconstruct(path, out=str(tmp_path / "run"))
    tiled = reconstruct(path, settings={"tile_size_m": 23.0, "lattice_x_m": 3.0})
    request = RunRequest(inputs=(str(path),), out=str(tmp_path / "workers"), resources=Resources(workers=2))
    assert {whole.digest, tiled.digest, run(request).digest} == {whole.digest}
    named = {"0 at GPS time 230400 to 230416": 0.3, "0 at GPS time 230440 to 230456": -0.3}
    assert read_manifest(whole.run_dir).strip_moves_m == named
    one = min(row["building_id"] for row in rows(whole.run_dir))
    again = rerun(RerunRequest(run_dir=whole.run_dir, only=(one,), resources=Resources(workers=0)))
    assert again.digest == whole.digest
