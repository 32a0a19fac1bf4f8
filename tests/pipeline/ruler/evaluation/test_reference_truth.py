"""A simulated data set read back as a reference: models, labels and points belong together."""

import json
import shutil
from collections import Counter
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from pipeline.errors import InconsistentInputError, InputError
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.evaluation.residual_scores import building_residuals
from pipeline.ruler.simulation.dataset import simulate


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("town")
    simulate("town", out, size_m=(120.0, 100.0), density_per_m2=4.0)
    return out / "truth"


@pytest.fixture(scope="module")
def reference(town: Path) -> Reference:
    return read_truth_reference(town)


def changed(truth: Path, out: Path) -> Path:
    shutil.copytree(truth.parent, out)
    return out / "truth"


def test_labels_and_points_stand_side_by_side(town: Path, reference: Reference) -> None:
    labels = pq.read_table(town / "labels.parquet").to_pylist()
    las = laspy.read(town.parent / "town.laz")
    (points,) = reference.points()
    assert len(points.xyz) == len(labels) == len(las.x)
    assert points.xyz == pytest.approx(np.column_stack((las.x, las.y, las.z)), abs=1e-6)
    names = [building.building_id for building in reference.buildings]
    for i in range(0, len(labels), 97):
        row = labels[i]
        assert points.classification[i] == row["class"]
        assert points.face[i] == row["face"]
        assert (names[points.building[i]] if points.building[i] >= 0 else None) == row["building_id"]
        assert bool(points.last[i]) == (las.return_number[i] == las.number_of_returns[i])


def test_roof_points_hit_a_roof_and_lie_inside_its_footprint(reference: Reference) -> None:
    (points,) = reference.points()
    on_roof = np.flatnonzero((points.building >= 0) & (points.face >= 0))
    inside = [
        reference.buildings[points.building[i]].footprint.contains(shapely.Point(points.xyz[i, :2])) for i in on_roof
    ]
    assert 0.9 < np.mean(inside) < 1.0
    # on the very border the two may differ: none is so exact that more than a few do
    assert np.sum(points.is_roof[on_roof] != inside) <= 3
    assert points.is_roof.sum() == points.is_roof[on_roof].sum()
    above = []
    for number, building in enumerate(reference.buildings):
        x, y, z = points.xyz[points.is_roof & (points.building == number)].T
        above += (z - building.top(x, y)).tolist()
    assert len(above) == points.is_roof.sum()
    assert np.nanmedian(np.abs(above)) < 0.05


def test_points_of_faces_are_counted_over_all_labels(town: Path, reference: Reference) -> None:
    labels = pq.read_table(town / "labels.parquet").to_pylist()
    counted = Counter((row["building_id"], row["face"]) for row in labels if row["building_id"] and row["face"] >= 0)
    assert dict(reference.face_points) == dict(counted)


def test_conditions_and_extent_come_with_it(town: Path, reference: Reference) -> None:
    assert reference.kind == "truth"
    assert reference.has_faces
    assert reference.has_ground
    assert reference.extent is not None
    assert reference.extent.area == pytest.approx(120.0 * 100.0)
    assert {building.building_id for building in reference.buildings} == set(reference.conditions)
    assert any(building.touches_data_edge for building in reference.buildings)
    rows = {row["building_id"]: row for row in pq.read_table(town / "conditions.parquet").to_pylist()}
    for building in reference.buildings:
        row = rows[building.building_id]
        assert reference.conditions[building.building_id].good == row["good"]
        for surface in building.surfaces:
            assert surface.group == row["groups"][surface.plane_id]


def test_a_data_set_of_two_tiles_is_the_same_reference(town: Path, reference: Reference, tmp_path: Path) -> None:
    """The points of the one tile dealt to two files, as scene.json of a city lists them."""
    truth = changed(town, tmp_path / "city")
    las, labels = laspy.read(truth.parent / "town.laz"), pq.read_table(truth / "labels.parquet")
    west = np.asarray(las.x) < np.median(las.x)
    (truth.parent / "tiles").mkdir()
    (truth / "labels").mkdir()
    tiles = []
    for key, side in (("x0", west), ("x1", ~west)):
        part = laspy.LasData(las.header)
        part.points = las.points[side]
        part.write(truth.parent / "tiles" / f"{key}.laz")
        pq.write_table(labels.filter(pa.array(side)), truth / "labels" / f"{key}.parquet")
        tiles.append({"laz": f"../tiles/{key}.laz", "labels": f"labels/{key}.parquet", "points": int(side.sum())})
    scene = json.loads((truth / "scene.json").read_text())
    (truth / "scene.json").write_text(json.dumps({**scene, "tiles": tiles}))
    (truth.parent / "town.laz").unlink()
    (truth / "labels.parquet").unlink()
    split = read_truth_reference(truth)
    assert len(split.tiles) == 2
    assert split.bounds[0][2] < split.bounds[1][0] + 0.001
    assert split.face_points == reference.face_points
    models = read_models(truth).models[::2]
    one, two = building_residuals(models, reference), building_residuals(models, split)
    assert (one.all_points.counts == two.all_points.counts).all()
    assert (one.top_visible.histogram == two.top_visible.histogram).all()


def test_what_does_not_belong_together_is_refused(town: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"scene\.json"):
        read_truth_reference(tmp_path)
    short = changed(town, tmp_path / "short")
    pq.write_table(pq.read_table(short / "labels.parquet").slice(1), short / "labels.parquet")
    with pytest.raises(InconsistentInputError, match="labels for the"):
        next(read_truth_reference(short).points())
    strange = changed(town, tmp_path / "strange")
    table = pq.read_table(strange / "labels.parquet")
    ids = pa.array([name and f"other-{name}" for name in table["building_id"].to_pylist()]).dictionary_encode()
    place = table.column_names.index("building_id")
    pq.write_table(table.set_column(place, "building_id", ids), strange / "labels.parquet")
    with pytest.raises(InconsistentInputError, match="have no true model, 'other-"):
        next(read_truth_reference(strange).points())
    gone = changed(town, tmp_path / "gone")
    (gone / "labels.parquet").unlink()
    with pytest.raises(InputError, match="labels"):
        read_truth_reference(gone)
    bare = changed(town, tmp_path / "bare")
    (bare.parent / "town.laz").unlink()
    scene = json.loads((bare / "scene.json").read_text())
    (bare / "scene.json").write_text(json.dumps({**scene, "tiles": None}))
    with pytest.raises(InputError, match="0 LAZ files"):
        read_truth_reference(bare)
