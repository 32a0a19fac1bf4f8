"""Given footprints around which nothing was seen: their points are roof, and a margin of ground stays ground."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import shapely.affinity
from las_files import write_las
from run_tables import rows, write_footprints

from pipeline.model import FloatArray

CORNER = np.array([400_000.0, 5_000_000.0, 100.0])
SIDE_M = 120.0
Roof = Callable[[FloatArray, FloatArray], FloatArray]


def gable(x: FloatArray, y: FloatArray) -> FloatArray:
    """Eaves 5 m and the ridge 8 m up."""
    return 5.0 + 0.75 * (4.0 - np.abs(y))


def hip(x: FloatArray, y: FloatArray) -> FloatArray:
    """All eaves 3 m up, 45 degrees steep."""
    return 3.0 + np.minimum(4.0 - np.abs(y), 6.0 - np.abs(x))


def flat(x: FloatArray, y: FloatArray) -> FloatArray:
    """6 m up."""
    return np.full(len(x), 6.0)


def steep(x: FloatArray, y: FloatArray) -> FloatArray:
    """Eaves 3 m up, 65 degrees steep."""
    return 3.0 + 2.14 * (4.0 - np.abs(y))


def shed(x: FloatArray, y: FloatArray) -> FloatArray:
    """2.2 m up."""
    return np.full(len(x), 2.2)


def box(place: tuple[float, float], grow_m: float = 0.0) -> Any:
    """The outline of a house of 12 m by 8 m, turned by 20 degrees."""
    own = shapely.box(-6.0 - grow_m, -4.0 - grow_m, 6.0 + grow_m, 4.0 + grow_m)
    return shapely.affinity.translate(shapely.affinity.rotate(own, 20.0, origin=(0.0, 0.0)), *place)


def town(houses: dict[tuple[float, float], Roof], density: float = 8.0, eaves_m: float = 0.0) -> FloatArray:
    """Points on level ground and on houses at some places, whose eaves reach beyond their outlines."""
    rng = np.random.default_rng(7)
    n = round(density * SIDE_M**2)
    x, y = rng.uniform(0.0, SIDE_M, (2, n))
    z = np.zeros(n)
    cos, sin = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    for (east, north), roof in houses.items():
        u, v = (x - east) * cos + (y - north) * sin, (y - north) * cos - (x - east) * sin
        on = (np.abs(u) < 6.0 + eaves_m) & (np.abs(v) < 4.0 + eaves_m)
        z[on] = roof(u[on], v[on])
    return np.column_stack((x, y, z + rng.normal(0.0, 0.02, n)))


def clipped(xyz: FloatArray, *areas: Any) -> FloatArray:
    return xyz[shapely.contains_xy(shapely.union_all(areas), xyz[:, 0], xyz[:, 1])]


def written(folder: Path, xyz: FloatArray, outlines: dict[str, Any], code: int = 1) -> tuple[Path, str]:
    """A file of points and one of footprints."""
    moved = {name: shapely.affinity.translate(outline, *CORNER[:2]) for name, outline in outlines.items()}
    file = write_las(folder / "town.las", np.round(xyz + CORNER, 3), "EPSG:25832", classification=code)
    return file, str(write_footprints(folder / "outlines.geojson", moved))


def modelled(reconstruct: Any, file: Path, outlines: str, out: Path, **settings: Any) -> dict[str, dict[str, Any]]:
    """The buildings by the names of their footprints, and the warnings about roofs alone under `""`."""
    found = reconstruct(file, out=str(out), footprints=outlines, settings=settings)
    warnings = [text for text in found.warnings if "no points lie around given footprints" in text]
    return {row["source_id"]: row for row in rows(str(out))} | {"": {"warnings": warnings}}


@pytest.mark.parametrize(("code", "classes"), [(1, "trust"), (0, "trust"), (6, "ignore"), (200, "trust")])
def test_points_clipped_to_a_footprint_are_roof_whatever_their_class(
    code: int, classes: str, tmp_path: Path, reconstruct: Any
) -> None:
    place = (45.0, 45.0)
    file, outlines = written(tmp_path, clipped(town({place: gable}), box(place)), {"A": box(place)}, code)
    found = modelled(reconstruct, file, outlines, tmp_path / "run", classes=classes)
    row, (warning,) = found["A"], found[""]["warnings"]
    assert (row["status"], row["roof_type"], row["ground_source"]) == ("ok", "gable", "assumed")
    assert row["ridge_z"] == pytest.approx(108.0, abs=0.1)
    assert row["ground_z"] == pytest.approx(102.5, abs=0.15)
    assert "assumed" in warning
    assert "m2" in warning


@pytest.mark.parametrize("density", [2.0, 20.0])
@pytest.mark.parametrize(("roof", "name", "lowest_m"), [(gable, "gable", 5.0), (hip, "hip", 3.0), (flat, "flat", 6.0)])
def test_roofs_of_all_forms_stand_on_an_assumed_floor(
    roof: Roof, name: str, lowest_m: float, density: float, tmp_path: Path, reconstruct: Any
) -> None:
    place = (45.0, 45.0)
    file, outlines = written(tmp_path, clipped(town({place: roof}, density), box(place)), {"A": box(place)})
    row = modelled(reconstruct, file, outlines, tmp_path / "run")["A"]
    assert (row["status"], row["roof_type"], row["ground_source"]) == ("ok", name, "assumed")
    assert row["ground_z"] == pytest.approx(100.0 + lowest_m - 2.5, abs=0.3)


@pytest.mark.parametrize("margin_m", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("buffered", [False, True])
def test_ground_in_the_margin_of_a_clip_is_used(
    buffered: bool, margin_m: float, tmp_path: Path, reconstruct: Any
) -> None:
    place = (45.0, 45.0)
    xyz = clipped(town({place: gable}), box(place, margin_m))
    file, outlines = written(tmp_path, xyz, {"A": box(place, margin_m if buffered else 0.0)})
    found = modelled(reconstruct, file, outlines, tmp_path / "run")
    assert (found["A"]["status"], found["A"]["ground_source"]) == ("ok", "terrain")
    assert found["A"]["ground_z"] == pytest.approx(100.0, abs=0.2)
    assert found[""]["warnings"] == []


@pytest.mark.parametrize("density", [2.0, 6.0])
def test_steep_roofs_do_not_stand_on_their_eaves(density: float, tmp_path: Path, reconstruct: Any) -> None:
    places = {"A": (25.0, 25.0), "B": (90.0, 25.0), "C": (25.0, 90.0), "D": (90.0, 90.0)}
    outlines = {name: box(place) for name, place in places.items()}
    xyz = clipped(town(dict.fromkeys(places.values(), steep), density), *outlines.values())
    file, given = written(tmp_path, xyz, outlines)
    found = modelled(reconstruct, file, given, tmp_path / "run")
    for name in places:
        assert found[name]["ground_source"] == "assumed"
        assert found[name]["ground_z"] == pytest.approx(100.5, abs=0.6)


@pytest.mark.parametrize("margin_m", [1.0, 2.0])
@pytest.mark.parametrize("density", [2.0, 6.0])
def test_low_sheds_stand_on_the_ground_in_their_margin(
    density: float, margin_m: float, tmp_path: Path, reconstruct: Any
) -> None:
    place = (45.0, 45.0)
    xyz = clipped(town({place: shed}, density), box(place, margin_m))
    file, outlines = written(tmp_path, xyz, {"A": box(place)})
    found = modelled(reconstruct, file, outlines, tmp_path / "run")
    assert (found["A"]["status"], found["A"]["ground_source"]) == ("ok", "terrain")
    assert found["A"]["ground_z"] == pytest.approx(100.0, abs=0.2)
    assert found[""]["warnings"] == []


def test_eaves_beyond_a_footprint_of_walls_are_not_ground(tmp_path: Path, reconstruct: Any) -> None:
    place = (45.0, 45.0)
    xyz = clipped(town({place: gable}, eaves_m=0.7), box(place, 0.7))
    file, outlines = written(tmp_path, xyz, {"A": box(place)})
    row = modelled(reconstruct, file, outlines, tmp_path / "run")["A"]
    assert (row["status"], row["roof_type"], row["ground_source"]) == ("ok", "gable", "assumed")


def test_a_low_part_of_a_roof_is_not_the_ground_of_the_high_one(tmp_path: Path, reconstruct: Any) -> None:
    house, garage = shapely.box(40.0, 40.0, 52.0, 48.0), shapely.box(52.0, 41.0, 56.0, 47.0)
    xyz = clipped(town({}), house, garage)
    xyz[:, 2] += np.where(xyz[:, 0] < 52.0, 6.0, 2.6)
    file, outlines = written(tmp_path, xyz, {"house": house, "garage": garage})
    found = modelled(reconstruct, file, outlines, tmp_path / "run")
    for name, roof_m in (("house", 6.0), ("garage", 2.6)):
        assert (found[name]["status"], found[name]["ground_source"]) == ("ok", "assumed")
        assert found[name]["ridge_z"] == pytest.approx(100.0 + roof_m, abs=0.1)


def partly_clipped() -> tuple[FloatArray, dict[str, Any]]:
    """A house whose surroundings were seen, and another one clipped to its footprint, 60 m off these."""
    places = {"seen": (17.0, 45.0), "alone": (105.0, 45.0)}
    xyz = town(dict.fromkeys(places.values(), gable))
    west = shapely.box(0.0, 0.0, 35.0, SIDE_M)
    outlines = {name: box(place) for name, place in places.items()}
    return clipped(xyz, west, *outlines.values()), outlines


def test_each_footprint_is_judged_by_its_own_surroundings(tmp_path: Path, reconstruct: Any) -> None:
    file, outlines = written(tmp_path, *partly_clipped())
    found = modelled(reconstruct, file, outlines, tmp_path / "run")
    assert {name: found[name]["ground_source"] for name in ("seen", "alone")} == {"seen": "terrain", "alone": "assumed"}
    assert found["seen"]["ground_z"] == pytest.approx(100.0, abs=0.1)


@pytest.mark.slow
def test_roofs_alone_do_not_depend_on_tiles(tmp_path: Path, reconstruct: Any) -> None:
    file, outlines = written(tmp_path, *partly_clipped())
    shapes = [(1000.0, 0.0), (23.0, 3.1), (31.7, 6.2)]
    runs = [
        reconstruct(file, footprints=outlines, settings={"tile_size_m": size_m, "lattice_x_m": shift_m})
        for size_m, shift_m in shapes
    ]
    assert len({one.digest for one in runs}) == 1
    warned = [[text for text in one.warnings if "no points lie around" in text] for one in runs]
    assert warned[0]
    assert warned[0] == warned[1] == warned[2]


def test_a_footprint_on_seen_ground_stays_without_a_building(tmp_path: Path, reconstruct: Any) -> None:
    file, outlines = written(tmp_path, town({}), {"gone": box((45.0, 45.0))})
    found = modelled(reconstruct, file, outlines, tmp_path / "run")
    assert (found["gone"]["status"], found["gone"]["reason"]) == ("failed", "too_few_points")
    assert found[""]["warnings"] == []


def test_points_of_roofs_alone_are_classified_as_building(tmp_path: Path, run_classify: Any) -> None:
    place = (45.0, 45.0)
    file, outlines = written(tmp_path, clipped(town({place: gable}), box(place)), {"A": box(place)})
    found = run_classify(file, footprints=outlines)
    assert found.files[0].classes.get(2, 0) == 0
