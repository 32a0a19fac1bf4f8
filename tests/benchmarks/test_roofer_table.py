"""The table beside roofer: how surveys are thinned, who is valid, and the table itself."""

import json
import math
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.entries import Entry, run_settings
from benchmarks.roofer_table import Figures, main, roofer_table, surveys
from benchmarks.run_scores import RunScore, valid_by_val3dity
from benchmarks.survey_runs import Seconds, candidates_of, run_survey
from benchmarks.thinned_surveys import kept, place_hash, thinned, write_changed
from pipeline.export.geoparquet import read_table
from pipeline.extras.compare.compare import Variant

FUZZY = Variant(method="fuzzy-sart")


def lattice(side: int, spacing_mm: int) -> np.ndarray:
    """Places on a regular lattice, (side^2, 3) int64 millimetres."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    return np.column_stack((85_000_000 + x * spacing_mm, 447_000_000 + y * spacing_mm, np.full(len(x), 5000)))


def survey(path: Path, n: int = 4000) -> np.ndarray:
    """Write a file of points of classes 2 and 6, in an old point format; the places in millimetres come back."""
    las = laspy.create(point_format=1, file_version="1.2")
    las.header.scales, las.header.offsets = [0.01, 0.01, 0.001], [85_000.0, 447_000.0, 0.0]
    rng = np.random.default_rng(5)
    las.x, las.y, las.z = 85_000.0 + 100.0 * rng.random(n), 447_000.0 + 100.0 * rng.random(n), 10.0 * rng.random(n)
    las.classification = np.where(np.arange(n) % 3 == 0, 6, 2).astype(np.uint8)
    las.intensity, las.gps_time = np.arange(n) % 60_000, np.arange(n) / 7.0
    las.write(path)
    return np.rint(np.asarray(las.xyz) * 1e3).astype(np.int64)


def score(within: float = 0.75) -> RunScore:
    return RunScore(
        candidates=5,
        lod2=4,
        reasons={"no_plane": 1},
        valid=3,
        val3dity=None,
        models=5,
        models_valid=4,
        models_val3dity=None,
        roof_faces=7,
        points=40,
        coverage=1.0,
        within=within,
        within_top=0.5,
        rmse_median_m=0.7,
        rmse_top_median_m=0.25,
    )


# ---------------------------------------------------------------------------------------------------------- thinning


@pytest.mark.parametrize("spacing_mm", [1, 10, 250, 1000, 1024])
@pytest.mark.parametrize("share", [0.5, 0.1])
def test_a_lattice_is_thinned_to_the_share_and_evenly_at_any_spacing(spacing_mm, share) -> None:
    stays = kept(lattice(200, spacing_mm), share).reshape(200, 200)
    blocks = stays.reshape(10, 20, 10, 20).sum(axis=(1, 3))
    expected, deviation = 400 * share, math.sqrt(400 * share * (1.0 - share))
    assert stays.sum() == pytest.approx(40_000 * share, abs=4.0 * 10.0 * deviation)
    assert (np.abs(blocks - expected) < 5.0 * deviation).all()
    chi_squared = ((blocks - expected) ** 2).sum() / deviation**2
    assert 50.0 < chi_squared < 160.0  # 100 blocks drawn independently: 100 +- 14
    # rows and columns are no pattern either
    assert (np.abs(stays.sum(axis=0) - 200 * share) < 5.0 * math.sqrt(200 * share)).all()


@given(st.permutations(range(60)), st.floats(0.05, 0.95), st.floats(0.05, 0.95))
def test_what_stays_depends_on_the_place_alone_and_sparse_surveys_are_part_of_dense_ones(order, one, other) -> None:
    places = np.random.default_rng(1).integers(-(10**9), 10**9, (60, 3))
    np.testing.assert_array_equal(kept(places, one)[order], kept(places[order], one))
    sparse, dense = kept(places, min(one, other)), kept(places, max(one, other))
    assert not (sparse & ~dense).any()


def test_a_full_share_keeps_all_points_and_different_places_have_different_hashes() -> None:
    places = lattice(100, 1)
    assert kept(places, 1.0).all()
    assert len(np.unique(place_hash(places))) == len(places)
    for axis in range(3):
        moved = places.copy()
        moved[:, axis] += 1
        assert (place_hash(moved) != place_hash(places)).all()


def test_a_thinned_file_has_the_same_points_with_all_that_is_reported_of_them(tmp_path) -> None:
    places = survey(tmp_path / "a.laz")
    (written,) = write_changed([tmp_path / "a.laz"], tmp_path / "thin", thinned(0.3))
    whole, thin = laspy.read(tmp_path / "a.laz"), laspy.read(written)
    stays = kept(places, 0.3)
    assert 1000 < stays.sum() < 1400
    for name in whole.point_format.dimension_names:
        np.testing.assert_array_equal(np.asarray(thin[name]), np.asarray(whole[name])[stays])


# ---------------------------------------------------------------------------------------------------------- val3dity

PROGRAM = """
import json, pathlib, sys
cityjson, option, report = sys.argv[1:]
assert option == "--report"
lines = pathlib.Path(cityjson).read_text().splitlines()
faults = [{"code": 901}] if lines == ["broken"] else []
features = [{"id": line, "validity": line != "wrong", "errors": []} for line in lines]
if features:
    pathlib.Path(report).write_text(json.dumps({"dataset_errors": faults, "features": features}))
print("nothing to read")
"""


def test_all_files_of_a_run_are_given_to_val3dity_and_a_missing_report_is_a_fault(tmp_path) -> None:
    program = tmp_path / "program"
    program.write_text(f"#!{sys.executable}\n{PROGRAM}")
    program.chmod(0o755)
    for tile, lines in (("tile=x0_y0", "one\nwrong"), ("tile=x0_y1", "two")):
        (tmp_path / "cityjson" / tile).mkdir(parents=True)
        (tmp_path / "cityjson" / tile / "part-0.city.jsonl").write_text(lines)
    assert valid_by_val3dity(tmp_path, str(program)) == {"one", "two"}
    (tmp_path / "cityjson" / "tile=x0_y1" / "part-0.city.jsonl").write_text("broken")
    with pytest.raises(RuntimeError, match="901"):
        valid_by_val3dity(tmp_path, str(program))
    (tmp_path / "cityjson" / "tile=x0_y1" / "part-0.city.jsonl").write_text("")
    with pytest.raises(RuntimeError, match="nothing to read"):
        valid_by_val3dity(tmp_path, str(program))


# ------------------------------------------------------------------------------------------------------- the table


def test_only_what_was_measured_has_a_line_and_roofer_stands_beside_delft_alone() -> None:
    whole = score()
    bare = roofer_table({"kmeans": Figures(whole=whole)}, with_roofer=False)
    assert "roofer" not in bare
    assert "| LoD2.2 | 4 of 5 |" in bare
    assert "| valid of these, own checker / val3dity | 3 / not run of 4 |" in bare
    assert "CPU" not in bare
    assert "a m2" not in bare
    found = Figures(
        whole=whole,
        warm=Seconds(processor=2.52, clock=3.0),
        mean_ms=4.0,
        median_ms=2.0,
        thinned={"2": score()},
    )
    text = roofer_table({"arrangement": found, "kmeans": Figures(whole=whole)}, with_roofer=True)
    heads, *lines = text.splitlines()
    assert heads == "|  | roofer 1.1.0-beta.1 | arrangement | kmeans |"
    for line in (
        "| CPU seconds in all, warm |  | 2.5 |  |",
        "| reconstruction of a building, ms, mean / median |  | 4.0 / 2.0 |  |",
        "| 2 class-6 points per m2: within 0.2 m of the full cloud | .53 | 0.750 |  |",
        "| 2 class-6 points per m2: reasons of the others |  | 1 no_plane |  |",
    ):
        assert line in lines


def test_a_run_that_fails_is_reported_with_its_message(tmp_path) -> None:
    entry = Entry(name="missing", tiles=(tmp_path / "not_there.laz",))
    with pytest.raises(RuntimeError, match="no such file"):
        run_survey(entry, FUZZY, tmp_path / "run")


@pytest.mark.slow
def test_candidates_with_footprints_are_those_of_a_run(shared_data: Path, tmp_path) -> None:
    entry = surveys(shared_data)["delft"]
    found = candidates_of(entry, run_settings(entry))
    assert all(candidate.footprint is not None for candidate in found)
    spent = run_survey(entry, FUZZY, tmp_path / "run")
    assert spent.processor > 0.0
    rows = read_table(str(tmp_path / "run"), "buildings").to_pylist()
    known = {(candidate.building_id, len(candidate.points)) for candidate in found}
    assert {(row["building_id"], row["n_points"]) for row in rows} == known
    given_area = sum(shapely.area(candidate.footprint) for candidate in found)
    assert sum(row["footprint_area_m2"] for row in rows) == pytest.approx(given_area, rel=0.05)


@pytest.mark.slow
def test_the_table_of_a_small_survey_is_written_with_all_parts(shared_data: Path, tmp_path, capsys) -> None:
    words = ["--out", str(tmp_path), "--data", str(shared_data), "--survey", "hdf_870000", "--repeat", "1"]
    words += ["--skip", "seconds"]
    assert main(words) == 0
    text = (tmp_path / "roofer_table_hdf_870000.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out
    figures = json.loads((tmp_path / "roofer_table_hdf_870000.json").read_text(encoding="utf-8"))["fuzzy-sart"]
    assert figures["whole"]["valid"] == figures["whole"]["lod2"] > 0
    assert figures["warm"] is None
    assert figures["median_ms"] > 0.0
    assert list(figures["thinned"]) == ["4", "2", "1", "0.5"]
    assert figures["thinned"]["0.5"]["within"] < figures["thinned"]["4"]["within"] <= figures["whole"]["within"] + 0.02
