"""Round roofs, glass, roofs without their ground and half-seen ones, from a file to the tables."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from las_files import write_las
from run_tables import rows, write_footprints

from pipeline.model import FloatArray

CRS = "EPSG:25832"
CORNER = np.array([400_000.0, 5_000_000.0, 100.0])
SIDE_M = 60.0


def ground(density: float, seed: int, noise_m: float = 0.02) -> FloatArray:
    """Level ground of 60 m by 60 m about the middle."""
    rng = np.random.default_rng(seed)
    n = round(density * SIDE_M**2)
    return np.column_stack((rng.uniform(-SIDE_M / 2, SIDE_M / 2, (n, 2)), rng.normal(0.0, noise_m, n)))


def written(path: Path, xyz: FloatArray, **fields: Any) -> Path:
    return write_las(path, np.round(xyz + np.array([SIDE_M / 2, SIDE_M / 2, 0.0]) + CORNER, 3), CRS, **fields)


def modelled(reconstruct: Any, file: Path, out: Path, **options: Any) -> list[dict[str, Any]]:
    reconstruct(file, out=str(out), **options)
    return rows(str(out))


def dome(xyz: FloatArray, radius_m: float, rise_m: float, drum_m: float) -> FloatArray:
    """The points with a dome on a drum in their middle."""
    sphere_m = (radius_m**2 + rise_m**2) / (2.0 * rise_m)
    square = xyz[:, 0] ** 2 + xyz[:, 1] ** 2
    height = drum_m + np.sqrt(np.maximum(sphere_m**2 - square, 0.0)) - (sphere_m - rise_m)
    return np.column_stack((xyz[:, :2], xyz[:, 2] + np.where(square < radius_m**2, height, 0.0)))


@pytest.mark.parametrize(
    ("radius_m", "rise_m", "drum_m", "density"),
    [(10.0, 10.0, 0.0, 8.0), (6.0, 6.0, 0.0, 8.0), (14.0, 9.0, 4.0, 4.0), (7.0, 4.0, 5.0, 12.0)],
)
def test_a_dome_is_one_building(
    radius_m: float, rise_m: float, drum_m: float, density: float, tmp_path: Path, reconstruct: Any
) -> None:
    file = written(tmp_path / "dome.las", dome(ground(density, 3), radius_m, rise_m, drum_m))
    (row,) = modelled(reconstruct, file, tmp_path / "run")
    assert row["height_m"] == pytest.approx(drum_m + rise_m, abs=0.4)
    assert 0.75 * math.pi * radius_m**2 < row["footprint_area_m2"] < 1.1 * math.pi * radius_m**2
    assert row["is_curved"]


def greenhouse(xyz: FloatArray, through: float, turn_deg: float, seed: int) -> FloatArray:
    """The points with a gable of glass of 30 m by 10 m in their middle, which a share of the pulses goes through."""
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    along, across = xyz[:, 0] * cos + xyz[:, 1] * sin, xyz[:, 1] * cos - xyz[:, 0] * sin
    inside = (np.abs(along) < 15.0) & (np.abs(across) < 5.0)
    stopped = np.random.default_rng(seed).random(len(xyz)) >= through
    roof = 3.0 + 0.4 * (5.0 - np.abs(across))
    return np.column_stack((xyz[:, :2], xyz[:, 2] + np.where(inside & stopped, roof, 0.0)))


@pytest.mark.parametrize("with_classes", [False, True])
@pytest.mark.parametrize(
    ("through", "density", "turn_deg"), [(0.5, 8.0, 0.0), (0.55, 16.0, 27.0), (0.5, 4.0, 70.0), (0.4, 5.0, 45.0)]
)
def test_a_greenhouse_that_half_of_the_pulses_go_through_is_one_building(
    through: float, density: float, turn_deg: float, with_classes: bool, tmp_path: Path, reconstruct: Any
) -> None:
    xyz = greenhouse(ground(density, 5), through, turn_deg, 6)
    classes = np.where(xyz[:, 2] > 1.0, 6, 2) if with_classes else 0
    file = written(tmp_path / "glass.las", xyz, classification=classes)
    (row,) = modelled(reconstruct, file, tmp_path / "run")
    assert row["footprint_area_m2"] == pytest.approx(300.0, rel=0.06)
    assert row["height_m"] == pytest.approx(5.0, abs=0.2)


def bays(xyz: FloatArray, through: float, count: int, plants_m: float, seed: int) -> FloatArray:
    """The points with `count` gables of glass side by side, each 8 m wide and 30 m long, and plants below them."""
    rng = np.random.default_rng(seed)
    along, across = xyz[:, 0] * 0.8 + xyz[:, 1] * 0.6, xyz[:, 1] * 0.8 - xyz[:, 0] * 0.6
    inside = (np.abs(along) < 15.0) & (np.abs(across) < 4.0 * count)
    roof = 3.0 + 0.4 * (4.0 - np.abs((across + 4.0 * count) % 8.0 - 4.0))
    below = plants_m * rng.random(len(xyz))
    height = np.where(rng.random(len(xyz)) >= through, roof, below)
    return np.column_stack((xyz[:, :2], xyz[:, 2] + np.where(inside, height, 0.0)))


@pytest.mark.parametrize("plants_m", [0.0, 1.5])
@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize(("through", "density"), [(0.3, 1.0), (0.5, 2.0), (0.7, 2.0), (0.5, 4.0)])
def test_a_greenhouse_is_one_building_where_few_points_lie_whatever_its_bays(
    through: float, density: float, count: int, plants_m: float, tmp_path: Path, reconstruct: Any
) -> None:
    xyz = bays(ground(density, 11), through, count, plants_m, 12)
    (row,) = modelled(reconstruct, written(tmp_path / "glass.las", xyz), tmp_path / "run")
    assert row["footprint_area_m2"] == pytest.approx(240.0 * count, rel=0.15)
    assert row["height_m"] == pytest.approx(4.6, abs=0.3)


def test_houses_of_several_bays_that_are_not_of_glass_are_divided_at_their_gutters(
    tmp_path: Path, reconstruct: Any
) -> None:
    xyz = bays(ground(4.0, 11), 0.0, 3, 0.0, 12)
    assert len(modelled(reconstruct, written(tmp_path / "rows.las", xyz), tmp_path / "run")) == 3


@pytest.mark.parametrize("density", [1.5, 3.0])
def test_sparse_glass_of_several_bays_is_found_whatever_the_tiles(
    density: float, tmp_path: Path, reconstruct: Any
) -> None:
    file = written(tmp_path / "glass.las", bays(ground(density, 13), 0.5, 3, 1.2, 14))
    sizes = enumerate((1000.0, 23.0, 31.7))
    runs = [reconstruct(file, settings={"tile_size_m": size, "lattice_x_m": 3.1 * k}) for k, size in sizes]
    assert len({one.digest for one in runs}) == 1
    assert runs[0].statuses == {"ok": 1}


def test_glass_is_found_whatever_the_tiles(tmp_path: Path, reconstruct: Any) -> None:
    file = written(tmp_path / "glass.las", greenhouse(ground(6.0, 7), 0.5, 33.0, 8))
    sizes = enumerate((1000.0, 23.0, 31.7))
    runs = [reconstruct(file, settings={"tile_size_m": size, "lattice_x_m": 3.1 * k}) for k, size in sizes]
    assert len({one.digest for one in runs}) == 1
    assert runs[0].statuses == {"ok": 1}


def gable(density: float, seed: int) -> FloatArray:
    """A gable of 12 m by 8 m in the middle, the eaves 5 m and the ridge 8 m up."""
    rng = np.random.default_rng(seed)
    n = round(density * 96)
    x, y = rng.uniform(-6.0, 6.0, n), rng.uniform(-4.0, 4.0, n)
    return np.column_stack((x, y, 5.0 + 0.75 * (4.0 - np.abs(y)) + rng.normal(0.0, 0.02, n)))


def outline(path: Path, shift: tuple[float, float] = (0.0, 0.0)) -> str:
    west, south = CORNER[:2] + SIDE_M / 2 + shift
    return str(write_footprints(path, {"A": shapely.box(west - 6.0, south - 4.0, west + 6.0, south + 4.0)}))


@pytest.mark.parametrize("density", [2.0, 8.0, 20.0])
def test_points_of_class_6_alone_are_not_ground(density: float, tmp_path: Path, reconstruct: Any) -> None:
    file = written(tmp_path / "roof.las", gable(density, 1), classification=6)
    (row,) = modelled(reconstruct, file, tmp_path / "run", footprints=outline(tmp_path / "a.geojson"))
    assert (row["status"], row["roof_type"], row["ground_source"]) == ("ok", "gable", "assumed")
    assert row["ridge_z"] == pytest.approx(108.0, abs=0.1)
    assert row["ground_z"] == pytest.approx(102.5, abs=0.2)


def test_unclassified_ground_beside_points_of_class_6_is_found(tmp_path: Path, reconstruct: Any) -> None:
    around = ground(6.0, 2)
    around = around[(np.abs(around[:, 0]) > 6.5) | (np.abs(around[:, 1]) > 4.5)]
    roof = gable(8.0, 1)
    classes = np.repeat([6, 1], [len(roof), len(around)])
    file = written(tmp_path / "roof.las", np.concatenate((roof, around)), classification=classes)
    (row,) = modelled(reconstruct, file, tmp_path / "run", footprints=outline(tmp_path / "a.geojson"))
    assert (row["status"], row["ground_source"]) == ("ok", "terrain")
    assert row["ground_z"] == pytest.approx(100.0, abs=0.1)


def half_seen(*, yard: bool, shift: tuple[float, float]) -> tuple[FloatArray, Any]:
    """The southern slope of the gable, with classes; beside it ground, also in place of the other slope if `yard`."""
    roof = gable(8.0, 4)
    roof = roof[roof[:, 1] < -0.05] + (*shift, 0.0)
    around = ground(6.0, 2)
    along, across = (around[:, :2] - shift).T
    beside = (np.abs(along) > 6.0) | (np.abs(across) > 4.0)
    around = around[beside | (yard & (across > 0.3))]
    return np.concatenate((roof, around)), np.repeat([6, 2], [len(roof), len(around)])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, 0.61)])
def test_a_slope_in_a_footprint_goes_on_where_nothing_was_seen_and_ends_at_a_yard(
    shift: tuple[float, float], tmp_path: Path, reconstruct: Any
) -> None:
    """The ground reaches the walls, which may lie anywhere on the lattice."""
    footprints = outline(tmp_path / "a.geojson", shift)
    found = {}
    for yard in (False, True):
        xyz, classes = half_seen(yard=yard, shift=shift)
        file = written(tmp_path / f"half{yard}.las", xyz, classification=classes)
        (found[yard],) = modelled(reconstruct, file, tmp_path / f"run{yard}", footprints=footprints)
    whole, ended = found[False], found[True]
    assert (whole["status"], whole["roof_type"]) == ("ok", "gable")
    assert whole["height_m"] == pytest.approx(8.0, abs=0.15)
    assert 0.3 < whole["extrapolated_share"] < 0.5
    assert [plane["extrapolated"] for plane in rows(str(tmp_path / "runFalse"), "planes")].count(True) == 1
    assert ended["roof_type"] == "pent"
    assert ended["height_m"] <= 8.3
    assert ended["footprint_share"] < 0.75


def house(density: float, wet: Any, seed: int) -> FloatArray:
    """The ground with a gable in it; where it is wet, no pulse comes back."""
    floor, roof = ground(density, seed), gable(density, seed + 1)
    floor = floor[(np.abs(floor[:, 0]) > 6.0) | (np.abs(floor[:, 1]) > 4.0)]
    return np.concatenate((floor, roof[~wet(roof[:, 0], roof[:, 1])]))


@pytest.mark.parametrize("density", [2.5, 8.0, 20.0])
@pytest.mark.parametrize(
    ("wet", "place"),
    [(lambda x, y: y - 0.0 * x > 0.3, "beyond the ridge"), (lambda x, y: x - 0.3 * y > 1.0, "across the ridge")],
)
def test_half_a_house_beside_a_place_without_points_is_doubtful(
    wet: Any, place: str, density: float, tmp_path: Path, reconstruct: Any
) -> None:
    file = written(tmp_path / "wet.las", house(density, wet, 11))
    (row,) = modelled(reconstruct, file, tmp_path / "run")
    assert (row["status"], row["reason"]) == ("doubtful", "not_seen"), place
    assert "lies beside the model, without any point" in row["reason_detail"]


def test_a_puddle_and_the_shadow_of_a_wall_raise_no_doubt(tmp_path: Path, reconstruct: Any) -> None:
    xyz = house(8.0, lambda x, y: (np.abs(x - 3.0) < 1.0) & (np.abs(y - 2.0) < 1.0), 13)
    xyz = xyz[(xyz[:, 1] < 4.0) | (xyz[:, 1] > 7.0) | (np.abs(xyz[:, 0]) > 6.0)]
    (row,) = modelled(reconstruct, written(tmp_path / "dry.las", xyz), tmp_path / "run")
    assert (row["status"], row["roof_type"]) == ("ok", "gable")


def on_slope(lift_m: float) -> FloatArray:
    """A level surface of 10 m by 8 m in a slope of 1 in 2.5, so far above the ground at its upper side."""
    xyz = ground(8.0, 17)
    terrain = 0.4 * xyz[:, 0]
    inside = (np.abs(xyz[:, 0]) < 5.0) & (np.abs(xyz[:, 1]) < 4.0)
    return np.column_stack((xyz[:, :2], xyz[:, 2] + np.where(inside, 2.0 + lift_m, terrain)))


@pytest.mark.parametrize(("lift_m", "found"), [(0.0, ("doubtful", "uncertain")), (2.5, ("ok", None))])
def test_a_terrace_that_is_level_with_the_slope_is_doubtful_and_a_house_there_is_not(
    lift_m: float, found: tuple[str, str | None], tmp_path: Path, reconstruct: Any
) -> None:
    file = written(tmp_path / "slope.las", on_slope(lift_m))
    (row,) = modelled(reconstruct, file, tmp_path / "run")
    assert (row["status"], row["reason"]) == found
    if lift_m == 0.0:
        assert "it may be a deck or a terrace" in row["reason_detail"]
