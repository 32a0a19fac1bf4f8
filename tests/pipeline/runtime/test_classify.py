"""`classify`: every input written back as it was but for its classes, whatever the tiles, the order and the workers."""

import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest

from pipeline.errors import InconsistentInputError, RunCancelledError, RunError, SettingsError, UnreadableInputError
from pipeline.extras.classify.classify import ClassifyRequest, ClassifySummary, classify
from pipeline.extras.classify.las_frame import read_frame
from pipeline.io import open_source
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.scratch.abandoned import locked_folder, remove_abandoned

Classify = Callable[..., ClassifySummary]
NAMES = {1: "other", 2: "ground", 5: "vegetation", 6: "building", 7: "noise"}


def classes_in(summary: ClassifySummary, number: int = 0) -> np.ndarray[Any, Any]:
    return np.asarray(laspy.read(summary.files[number].path).classification)


@pytest.fixture(scope="session")
def true_suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb with its true classes."""
    from pipeline.ruler.simulation.dataset import Output, simulate

    folder = tmp_path_factory.mktemp("true")
    simulate("suburb", folder, 3, size_m=(90.0, 90.0), density_per_m2=6.0, output=Output(with_classes=True))
    return folder / "suburb.laz"


@pytest.fixture(scope="session")
def rich(true_suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb in point format 8 with every dimension filled, withheld points, noise and extra bytes."""
    source = laspy.read(true_suburb)
    rng = np.random.default_rng(4)
    header = laspy.LasHeader(version="1.4", point_format=8)
    header.scales, header.offsets = source.header.scales, source.header.offsets
    header.add_extra_dims([laspy.ExtraBytesParams(name="amplitude", type=np.float64)])
    header.add_crs(pyproj.CRS.from_epsg(5555))
    header.vlrs.append(laspy.VLR("someone", 42, "theirs", b"\1\2\3"))
    las = laspy.LasData(header)
    n = len(source.points)
    for name in ("X", "Y", "Z", "return_number", "number_of_returns", "gps_time", "point_source_id"):
        las[name] = np.asarray(source[name])
    las.intensity, las.user_data = rng.integers(0, 2**16, n), rng.integers(0, 256, n)
    las.scan_angle, las.scanner_channel = rng.integers(-9000, 9000, n), rng.integers(0, 4, n)
    for name in ("red", "green", "blue", "nir"):
        las[name] = rng.integers(0, 2**16, n)
    for name in ("scan_direction_flag", "edge_of_flight_line", "synthetic", "key_point", "overlap"):
        las[name] = rng.integers(0, 2, n)
    las["amplitude"] = rng.normal(size=n)
    las.classification = np.where(rng.random(n) < 0.01, 18, rng.integers(0, 7, n))
    las.withheld = rng.random(n) < 0.01
    path = tmp_path_factory.mktemp("rich") / "rich.laz"
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("someone", 43, "long", b"x" * 100_000)])
    las.write(path)
    return path


def test_the_classes_are_those_of_the_truth(true_suburb: Path, run_classify: Classify) -> None:
    summary = run_classify(true_suburb)
    truth, found = np.asarray(laspy.read(true_suburb).classification), classes_in(summary)
    for code, share in ((2, 0.99), (5, 0.95), (6, 0.97)):
        assert (found[truth == code] == code).mean() > share, NAMES[code]
        assert (truth[found == code] == code).mean() > 0.95, NAMES[code]
    assert summary.buildings > 3
    assert summary.classes == {code: int((found == code).sum()) for code in np.unique(found).tolist()}


def test_only_the_class_of_a_point_changes(rich: Path, run_classify: Classify) -> None:
    old, new = laspy.read(rich), laspy.read(run_classify(rich).files[0].path)
    assert new.header.version == "1.4"
    assert new.point_format.id == 8
    names = list(old.point_format.dimension_names)
    assert names == list(new.point_format.dimension_names)
    for name in names:
        if name != "classification":
            assert (np.asarray(new[name]) == np.asarray(old[name])).all(), name
    dropped = (np.asarray(old.withheld) == 1) | (np.asarray(old.classification) == 18)
    assert 10 < dropped.sum() < len(dropped) / 10
    assert (np.asarray(new.classification)[dropped] == np.asarray(old.classification)[dropped]).all()
    assert np.isin(np.asarray(new.classification)[~dropped], list(NAMES)).all()
    assert new.header.parse_crs() == pyproj.CRS.from_epsg(5555)


def test_every_record_of_the_header_is_kept_byte_for_byte(rich: Path, run_classify: Classify) -> None:
    path = run_classify(rich).files[0].path
    kept = {(r.user_id, r.record_id): r.data for r in read_frame(rich).records if r.user_id != b"laszip encoded"}
    found = {(r.user_id, r.record_id): r.data for r in read_frame(Path(path)).records}
    assert {(b"someone", 42), (b"LASF_Spec", 4), (b"LASF_Projection", 2112)} == set(kept)
    assert {key: found[key] for key in kept} == kept
    (extended,) = laspy.read(path).evlrs
    assert (extended.user_id, extended.record_id) == ("someone", 43)
    assert extended.record_data_bytes() == b"x" * 100_000


@pytest.mark.parametrize("size_m", [pytest.param(33.0, marks=pytest.mark.slow), 61.5])
def test_tiles_order_and_files_do_not_change_a_class(
    size_m: float, true_suburb: Path, run_classify: Classify, shuffled: Any, tmp_path: Path
) -> None:
    whole = classes_in(run_classify(true_suburb, settings={"tile_size_m": 1000.0}))
    cut = run_classify(
        true_suburb,
        settings={"tile_size_m": size_m, "lattice_x_m": 7.3, "lattice_y_m": -11.9},
        executor=shuffled(3),
    )
    assert (classes_in(cut) == whole).all()
    # two files, out of order and overlapping
    las = laspy.read(true_suburb)
    order = np.random.default_rng(8).permutation(len(las.points))
    half = len(order) // 2
    parts = order[: half + 700], order[half - 700 :]
    for name, chosen in zip("ab", parts, strict=True):
        part = laspy.LasData(las.header)
        part.points = las.points[chosen]
        part.write(tmp_path / f"{name}.laz")
    both = run_classify(tmp_path / "a.laz", tmp_path / "b.laz", settings={"tile_size_m": size_m})
    for number, chosen in enumerate(parts):
        assert (classes_in(both, number) == whole[chosen]).all()


@pytest.mark.slow
def test_delft_in_two_grids_gets_the_same_classes(shared_data: Path, run_classify: Classify) -> None:
    tiles = [shared_data / "ahn3" / name for name in ("delft_west.laz", "delft_east.laz")]
    grids = {"tile_size_m": 1000.0}, {"tile_size_m": 83.7, "lattice_x_m": 31.4, "lattice_y_m": -15.9}
    runs = [run_classify(*tiles, crs="EPSG:7415", settings=grid) for grid in grids]
    for number, tile in enumerate(sorted(tiles)):
        old, (one, two) = laspy.read(tile), (classes_in(run, number) for run in runs)
        assert (one == two).all()
        truth = np.asarray(old.classification)
        assert (one[truth == 2] == 2).mean() > 0.995
        assert (truth[one == 6] == 6).mean() > 0.9


@pytest.mark.slow
def test_two_dask_workers_write_the_bytes_of_a_serial_run(true_suburb: Path, run_classify: Classify) -> None:
    tiles = {"tile_size_m": 40.0}
    serial, cluster = run_classify(true_suburb, settings=tiles), run_classify(true_suburb, settings=tiles, workers=2)
    assert Path(serial.files[0].path).read_bytes() == Path(cluster.files[0].path).read_bytes()


def test_nothing_but_the_files_is_left_in_the_folder(true_suburb: Path, run_classify: Classify, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_classify(true_suburb, out=str(out))
    assert [path.name for path in out.iterdir()] == ["suburb.laz"]
    with pytest.raises(RunError, match=r"holds suburb\.laz already"):
        run_classify(true_suburb, out=str(out))
    run_classify(true_suburb, out=str(out), overwrite=True)
    assert [path.name for path in out.iterdir()] == ["suburb.laz"]


def test_an_input_is_never_replaced(true_suburb: Path, run_classify: Classify) -> None:
    before = true_suburb.read_bytes()
    with pytest.raises(RunError, match="replaced by its own outcome"):
        run_classify(true_suburb, out=str(true_suburb.parent), overwrite=True)
    assert true_suburb.read_bytes() == before


def test_two_inputs_of_one_name_are_refused(true_suburb: Path, run_classify: Classify, tmp_path: Path) -> None:
    (tmp_path / "suburb.las").write_bytes(b"")
    laspy.read(true_suburb).write(tmp_path / "suburb.las")
    with pytest.raises(RunError, match=r"both be written as suburb\.laz"):
        run_classify(true_suburb, tmp_path / "suburb.las")


def test_what_stands_in_the_way_is_named_before_any_work(
    true_suburb: Path, run_classify: Classify, tmp_path: Path
) -> None:
    (tmp_path / "a" / "suburb.laz").mkdir(parents=True)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "scratch").touch()
    for folder, name in (("a", "suburb.laz"), ("b", "scratch")):
        with pytest.raises(RunError, match=rf"{name} stands in the way"):
            run_classify(true_suburb, out=str(tmp_path / folder), overwrite=True)
        assert [path.name for path in (tmp_path / folder).iterdir()] == [name]


def test_waveforms_are_refused_by_format(true_suburb: Path, run_classify: Classify, tmp_path: Path) -> None:
    las = laspy.convert(laspy.read(true_suburb), point_format_id=4, file_version="1.4")
    las.write(tmp_path / "waves.las")
    with pytest.raises(UnreadableInputError, match=r"point format 4 carries waveforms.*Convert"):
        run_classify(tmp_path / "waves.las")


def test_text_becomes_laz(true_suburb: Path, run_classify: Classify, tmp_path: Path) -> None:
    las = laspy.read(true_suburb)
    columns = [np.asarray(las[name]) for name in ("x", "y", "z", "return_number", "number_of_returns", "gps_time")]
    names = "x y z return_number number_of_returns gps_time"
    np.savetxt(tmp_path / "points.txt", np.column_stack(columns), "%.6f", header=names, comments="")
    summary = run_classify(tmp_path / "points.txt", crs="EPSG:5555")
    new = laspy.read(summary.files[0].path)
    for name, values in zip(names.split(), columns, strict=True):
        assert np.abs(np.asarray(new[name]) - values).max() <= (0.00051 if name in "xyz" else 1e-6), name
    assert new.header.parse_crs() == pyproj.CRS.from_epsg(5555)
    assert any("convert the file to LAZ first" in warning for warning in summary.warnings)
    assert (np.asarray(new.classification) == classes_in(run_classify(true_suburb))).mean() > 0.999


def test_geotiff_keys_become_wkt_and_a_given_crs_stands_above(
    true_suburb: Path, run_classify: Classify, tmp_path: Path
) -> None:
    source = laspy.read(true_suburb)
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.scales, header.offsets = source.header.scales, source.header.offsets
    header.add_crs(pyproj.CRS.from_epsg(25832))
    las = laspy.LasData(header)
    for name in ("X", "Y", "Z", "return_number", "number_of_returns", "gps_time", "classification"):
        las[name] = np.asarray(source[name])
    las.write(tmp_path / "old.laz")
    plain = run_classify(tmp_path / "old.laz").files[0].path
    assert read_frame(Path(plain)).block.flags & 16
    with laspy.open(plain) as reader:
        (record,) = reader.header.vlrs.get("WktCoordinateSystemVlr")
        assert pyproj.CRS.from_wkt(record.string).to_epsg() == 25832
        assert len(reader.header.vlrs.get("GeoKeyDirectoryVlr")) == 1
    given = run_classify(tmp_path / "old.laz", crs="EPSG:5555").files[0].path
    with laspy.open(given) as reader:
        (record,) = reader.header.vlrs.get("WktCoordinateSystemVlr")
        assert pyproj.CRS.from_wkt(record.string) == pyproj.CRS.from_epsg(5555)
        assert reader.header.vlrs.get("GeoKeyDirectoryVlr") == []


def test_the_classes_of_the_file_stand_where_they_are_trusted(true_suburb: Path, run_classify: Classify) -> None:
    truth = np.asarray(laspy.read(true_suburb).classification)
    found = classes_in(run_classify(true_suburb, settings={"classes": "trust"}))
    assert ((found == 2) == (truth == 2)).all()
    assert (found[truth == 6] == 6).all()
    assert not (found[(truth >= 3) & (truth <= 5)] == 6).any()


@pytest.mark.parametrize(
    ("change", "fault"), [(1000, r"more points in tile .* than when it was first read"), (-1000, r"points are left")]
)
def test_a_file_that_changes_meanwhile_is_reported(
    change: int, fault: str, true_suburb: Path, run_classify: Classify, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "changing.laz"
    las = laspy.read(true_suburb)
    las.write(path)
    from pipeline.extras.classify import classify as module

    label_all = module._label_all

    def then_change(*arguments: Any, **options: Any) -> None:
        label_all(*arguments, **options)
        other = laspy.LasData(las.header)
        n = len(las.points)
        other.points = las.points[np.arange(n + change) % n]
        other.write(path)

    monkeypatch.setattr(module, "_label_all", then_change)
    with pytest.raises(InconsistentInputError, match=fault):
        run_classify(path, out=str(tmp_path / "out"))
    assert list((tmp_path / "out").iterdir()) == []


def test_a_cell_of_rasters_without_a_request_is_an_error(true_suburb: Path, tmp_path: Path) -> None:
    request = ClassifyRequest(inputs=(str(true_suburb),), out=str(tmp_path / "out"), raster_cell=2.0, resources=SERIAL)
    with pytest.raises(SettingsError, match=r"raster_cell is 2 where no rasters are asked for: give --rasters too"):
        classify(request)
    assert not (tmp_path / "out").exists()


def test_a_classification_that_is_cancelled_leaves_no_file(true_suburb: Path, tmp_path: Path) -> None:
    request = ClassifyRequest(inputs=(str(true_suburb),), out=str(tmp_path / "out"), resources=SERIAL)
    with pytest.raises(RunCancelledError):
        classify(request, cancelled=lambda: True)
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(("stage", "left"), [("classify", []), ("write", []), ("mosaics", ["suburb.laz"])])
def test_an_interruption_leaves_whole_files_and_no_scratch(
    stage: str, left: list[str], true_suburb: Path, tmp_path: Path
) -> None:
    def interrupt(event: Event) -> None:
        if (event.kind, event.stage) == ("stage", stage):
            raise KeyboardInterrupt

    request = ClassifyRequest(inputs=(str(true_suburb),), out=str(tmp_path / "out"), resources=SERIAL, rasters=True)
    with pytest.raises(KeyboardInterrupt):
        classify(request, interrupt)
    assert [path.name for path in (tmp_path / "out").iterdir()] == left


def write_copc(source: Path, target: Path) -> Path:
    """A LAZ file made to look like COPC: the info record first, and a hierarchy page of one node as extended record."""
    las = laspy.read(source)
    modern = laspy.convert(las, point_format_id=6, file_version="1.4")
    modern.header.add_crs(pyproj.CRS.from_epsg(5555))
    low, high = np.array(las.header.mins), np.array(las.header.maxs)
    center, half = (low + high) / 2.0, float((high - low).max()) / 2.0 + 0.01
    plain = target.with_name("plain.laz")
    modern.write(plain)
    size = plain.stat().st_size + 54 + 160
    page = struct.pack("<iiiiQii", 0, 0, 0, 0, 0, 0, 0)
    info = struct.pack("<5dQQ2d", *center, half, 1.0, size + 60, len(page), 0.0, 0.0) + b"\0" * 88
    modern.header.vlrs.insert(0, laspy.VLR("copc", 1, "", info))
    modern.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("copc", 1000, "", page)])
    modern.write(target)
    return target


def test_a_copc_file_becomes_plain_laz(true_suburb: Path, run_classify: Classify, tmp_path: Path) -> None:
    path = write_copc(true_suburb, tmp_path / "suburb.copc.laz")
    assert open_source(path).info.format == "copc"
    summary = run_classify(path)
    assert Path(summary.files[0].path).name == "suburb.laz"
    frame = read_frame(Path(summary.files[0].path))
    assert [r.user_id for r in frame.records if r.user_id == b"copc"] == []
    assert frame.extended == ()
    old, new = laspy.read(path), laspy.read(summary.files[0].path)
    assert (np.asarray(new.X) == np.asarray(old.X)).all()


def test_what_a_killed_command_left_is_removed_and_reported_by_the_next_into_the_same_folder(
    true_suburb: Path, run_classify: Classify, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    code = (
        "import os, signal, sys; from pathlib import Path; from pipeline.extras.classify.classify import *; "
        "listen = lambda event: event.stage == 'ingest' and os.kill(os.getpid(), signal.SIGKILL); "
        "classify(ClassifyRequest(inputs=(sys.argv[1],), out=sys.argv[2], resources=Resources(workers=0)), listen)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(true_suburb), str(out)], check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = (out / "scratch").iterdir()
    (out / "scratch" / "notes").mkdir()
    with locked_folder(out / "scratch") as in_use:
        summary = run_classify(true_suburb, out=str(out))
        assert {path.name for path in (out / "scratch").iterdir()} == {"notes", in_use.name}
    assert summary.warnings[-1] == f"removed {left}: an earlier command was cut off and left it"
    assert [path.name for path in (out / "scratch").iterdir()] == ["notes"]


def test_a_folder_that_is_held_no_more_is_removed_and_an_empty_parent_with_it(tmp_path: Path) -> None:
    with locked_folder(tmp_path / "scratch") as folder:
        assert remove_abandoned(tmp_path / "scratch") == []
        (folder / "points").mkdir()
    assert not (tmp_path / "scratch").exists()
    assert remove_abandoned(tmp_path / "scratch") == []
