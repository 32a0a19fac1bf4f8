"""LAZ 1.4: every dimension of every older format survives, as laspy, an independent reader and writer, has it."""

import io
from typing import Any

import laspy
import numpy as np
import pytest

from pipeline.extras.classify.laz_writing import (
    KEEP,
    NEWER_FORMAT,
    SCAN_ANGLE_UNIT_DEG,
    LazWriter,
    classified,
    header_of,
    new_records,
    record_dtype,
    to_newer_format,
)

N = 500
SUBFIELDS = ("scan_direction_flag", "edge_of_flight_line", "synthetic", "key_point", "withheld")
PLAIN = ("X", "Y", "Z", "intensity", "return_number", "number_of_returns", "user_data", "point_source_id")
COLOURS = ("red", "green", "blue", "nir")


def full_cloud(point_format: int, seed: int = 1) -> laspy.LasData:
    """A cloud of which every dimension of its format is random, with extra bytes of three types."""
    rng = np.random.default_rng(seed)
    version = "1.4" if point_format >= 6 else "1.2"
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.array([0.01, 0.02, 0.005]), np.array([84_000.0, -12.5, 3.25])
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name="reflectance", type=np.float32, description="dB"),
            laspy.ExtraBytesParams(name="pulse", type="3u1"),
            laspy.ExtraBytesParams(name="deviation", type=np.int16, scales=np.array([0.1]), offsets=np.array([2.0])),
        ]
    )
    las = laspy.LasData(header)
    most = 15 if point_format >= 6 else 7
    las.X = rng.integers(-(2**31), 2**31 - 1, N).astype(np.int32)
    las.Y = rng.integers(-(2**31), 2**31 - 1, N).astype(np.int32)
    las.Z = rng.integers(-(2**31), 2**31 - 1, N).astype(np.int32)
    las.intensity = rng.integers(0, 2**16, N)
    las.return_number = rng.integers(0, most + 1, N)
    las.number_of_returns = rng.integers(0, most + 1, N)
    for name in SUBFIELDS:
        las[name] = rng.integers(0, 2, N)
    las.user_data, las.point_source_id = rng.integers(0, 256, N), rng.integers(0, 2**16, N)
    las.classification = rng.integers(0, 256 if point_format >= 6 else 32, N)
    if point_format >= 6:
        las.overlap, las.scanner_channel = rng.integers(0, 2, N), rng.integers(0, 4, N)
        las.scan_angle = rng.integers(-30_000, 30_001, N)
    else:
        las.scan_angle_rank = rng.integers(-90, 91, N).astype(np.int8)
    if "gps_time" in las.point_format.dimension_names:
        las.gps_time = rng.uniform(-1e9, 1e9, N)
    for name in COLOURS:
        if name in las.point_format.dimension_names:
            las[name] = rng.integers(0, 2**16, N)
    las["reflectance"] = rng.normal(size=N).astype(np.float32)
    las["pulse"] = rng.integers(0, 256, (N, 3)).astype(np.uint8)
    las["deviation"] = las["deviation"] * 0 + rng.integers(-100, 100, N) * 0.1
    return las


def written(las: laspy.LasData, classes: np.ndarray[Any, Any] | None = None) -> laspy.LasData:
    """The cloud as the product writes it, read back by laspy."""
    old = las.point_format.id
    raw = np.frombuffer(las.points.array.tobytes(), np.uint8)
    records = to_newer_format(raw, old, las.points.array.dtype.itemsize)
    if classes is not None:
        records = classified(records, classes)
    extra = [v for v in las.header.vlrs if isinstance(v, laspy.vlrs.known.ExtraBytesVlr)]
    stream = io.BytesIO()
    writer = LazWriter(
        stream,
        header_of(
            point_format=NEWER_FORMAT[old],
            size=records.dtype.itemsize,
            scales=tuple(las.header.scales),
            offsets=tuple(las.header.offsets),
            software="test",
        ),
        [(b"LASF_Spec", 4, b"extra", v.record_data_bytes()) for v in extra],
    )
    for begin in range(0, N, 123):
        writer.write(records[begin : begin + 123])
    writer.close([(b"mine", 7, b"long", 70_000, iter((b"a" * 30_000, b"b" * 40_000)))])
    stream.seek(0)
    with laspy.open(stream, read_evlrs=True) as reader:
        return reader.read()


@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_every_dimension_survives_but_the_class(point_format: int) -> None:
    las = full_cloud(point_format)
    classes = np.random.default_rng(2).choice(np.array([1, 2, 5, 6, 7, KEEP], np.uint8), N)
    new = written(las, classes)
    assert new.header.version == "1.4"
    assert new.point_format.id == NEWER_FORMAT[point_format]
    reported = set(las.point_format.dimension_names) - {"classification", "scan_angle_rank", "scan_angle"}
    assert reported >= {*PLAIN, *SUBFIELDS, "reflectance", "pulse", "deviation"}
    for name in sorted(reported):
        assert (np.asarray(new[name]) == np.asarray(las[name])).all(), name
    if point_format >= 6:
        assert (new.scan_angle == las.scan_angle).all()
    else:
        # whole degrees come back as whole degrees
        assert (np.rint(np.asarray(new.scan_angle) * SCAN_ANGLE_UNIT_DEG) == np.asarray(las.scan_angle_rank)).all()
        assert np.abs(np.asarray(new.scan_angle) * SCAN_ANGLE_UNIT_DEG - las.scan_angle_rank).max() <= 0.003
    own = np.asarray(las.classification)
    assert (np.asarray(new.classification) == np.where(classes == KEEP, own, classes)).all()
    if "gps_time" not in las.point_format.dimension_names:
        assert (new.gps_time == 0).all()


@pytest.mark.parametrize("point_format", [1, 3])
def test_the_old_overlap_class_becomes_the_overlap_flag(point_format: int) -> None:
    las = full_cloud(point_format)
    new = written(las, np.full(N, 2, np.uint8))
    assert (np.asarray(new.overlap) == (np.asarray(las.classification) == 12)).all()
    assert np.asarray(new.overlap).any()


def test_the_header_says_bounds_and_counts_as_laspy_would(tmp_path: Any) -> None:
    las = full_cloud(7)
    new = written(las)
    path = tmp_path / "twin.laz"
    las.write(path)
    twin = laspy.read(path).header
    assert (new.header.mins == twin.mins).all()
    assert (new.header.maxs == twin.maxs).all()
    assert (new.header.number_of_points_by_return == twin.number_of_points_by_return).all()
    assert new.header.point_count == N
    assert (new.header.scales == las.header.scales).all()
    assert (new.header.offsets == las.header.offsets).all()
    assert new.header.global_encoding.wkt


def test_an_extended_record_is_written_from_its_pieces() -> None:
    (record,) = written(full_cloud(6)).header.evlrs
    assert (record.user_id, record.record_id) == ("mine", 7)
    assert record.record_data_bytes() == b"a" * 30_000 + b"b" * 40_000


def test_records_of_a_newer_format_are_not_copied() -> None:
    raw = np.zeros(36 * 4, np.uint8)
    assert np.shares_memory(to_newer_format(raw, 7, 36), raw)
    with pytest.raises(KeyError):
        record_dtype(4, 57)


def test_an_empty_file_has_no_bounds() -> None:
    stream = io.BytesIO()
    writer = LazWriter(
        stream, header_of(point_format=6, size=30, scales=(1.0,) * 3, offsets=(5.0,) * 3, software="test")
    )
    writer.write(new_records(0))
    writer.close()
    stream.seek(0)
    header = laspy.open(stream).header
    assert header.point_count == 0
    assert header.mins.tolist() == header.maxs.tolist() == [0.0, 0.0, 0.0]
