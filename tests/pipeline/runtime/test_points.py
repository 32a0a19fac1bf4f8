"""Points of a run as 3D Tiles: each once, with the classes of `classify` and the distances of the records."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow.dataset as ds
import pyproj
import pytest
import scipy.spatial
from points_glb import read_points_glb

from pipeline.extras.classify.classify import ClassifySummary
from pipeline.extras.octree import tile_points
from pipeline.extras.octree.building_points import building_points
from pipeline.extras.octree.point_glb import NO_BUILDING, NO_PLANE, NO_RESIDUAL, ModelledPoints
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.quality.residuals import summarise
from pipeline.quality.roof_returns import roof_returns
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL, Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.settings import RunSettings
from pipeline.tiling import MM

Reconstruct = Callable[..., RunSummary]

pytestmark = pytest.mark.slow

SETTINGS = {"tile_size_m": 40.0}
"""Several tiles."""


@pytest.fixture(scope="module")
def source(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb with some of its points twice."""
    las = laspy.read(suburb)
    path = tmp_path_factory.mktemp("doubled") / "suburb.laz"
    twice = laspy.LasData(las.header)
    twice.points = las.points[np.concatenate((np.arange(len(las.points)), np.arange(200)))]
    twice.write(path)
    return path


@pytest.fixture(scope="module")
def out(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with points, in several tiles."""
    folder = tmp_path_factory.mktemp("points") / "run"
    settings = RunSettings.from_mapping(SETTINGS)
    run(RunRequest(inputs=(str(source),), out=str(folder), settings=settings, resources=SERIAL, points=True))
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def document(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "tileset.json").read_bytes())
    return found


def nodes(folder: Path, name: str = "tileset.json") -> Iterator[tuple[dict[str, Any], np.ndarray, Path | None]]:
    """Each node with its transform to the coordinates of the root and its GLB file, also those of other tilesets."""
    waiting = [(json.loads((folder / name).read_bytes())["root"], np.eye(4), folder)]
    for node, parent, place in waiting:
        matrix = parent @ np.array(node.get("transform", np.eye(4).reshape(-1))).reshape(4, 4).T
        path = place / node["content"]["uri"] if "content" in node else None
        if path is not None and path.suffix == ".json":
            waiting.append((json.loads(path.read_bytes())["root"], matrix, path.parent))
            path = None
        yield node, matrix, path
        waiting.extend((child, matrix, place) for child in node.get("children", ()))


def local(points: ModelledPoints) -> np.ndarray:
    return np.column_stack((points.xyz_mm / MM, np.ones(len(points))))


def all_points(folder: Path) -> tuple[np.ndarray, list[ModelledPoints]]:
    """Places of all points in millimetres of the CRS, and the points themselves, node after node."""
    origin = np.array(document(folder)["extras"]["origin_m"]) * MM
    places, found = [], []
    for _, matrix, path in nodes(folder):
        if path is not None:
            points, _ = read_points_glb(path.read_bytes())
            found.append(points)
            places.append(np.rint((local(points) @ matrix.T)[:, :3] * MM).astype(np.int64) + origin)
    return np.concatenate(places), found


def nearest(places: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Which of some others each place is; tiles of 40 m keep millimetres, a node above them rounds to 2 mm."""
    away, index = scipy.spatial.KDTree(to).query(places)
    assert away.max() <= np.sqrt(3.0)
    return np.asarray(index)


def test_every_point_of_the_source_is_there_once(out: Path, source: Path) -> None:
    las = laspy.read(source)
    expected = np.unique(np.rint(np.column_stack((las.x, las.y, las.z)) * MM).astype(np.int64), axis=0)
    places, found = all_points(out / "points")
    assert len(places) == document(out / "points")["extras"]["n_points"] == len(expected)
    assert len(found) > 4
    assert sorted(nearest(places, expected).tolist()) == list(range(len(expected)))


def test_the_terrain_lies_beneath_the_points_of_the_ground(out: Path) -> None:
    terrain = json.loads((out / "points" / document(out / "points")["extras"]["terrain"]).read_bytes())
    elevations = np.array(terrain["elevations"], float) * terrain["elevation_unit_m"]
    places, found = all_points(out / "points")
    ground = places[np.concatenate([points.point_class for points in found]) == 2] / MM
    # the node of the cell of each point
    column, row = (np.floor(ground[:, :2]) + 0.5 - terrain["origin_m"]).astype(int).T
    assert terrain["spacing_m"] == 1
    above = ground[:, 2] - elevations[row, column]
    assert len(ground) > 1000
    assert np.median(np.abs(above)) < 0.1
    assert np.quantile(np.abs(above), 0.99) < 0.5


def test_boxes_hold_all_points_beneath_them(out: Path) -> None:
    for name in ("tileset.json", "tileset-ecef.json"):
        boxes: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for node, matrix, path in nodes(out / "points", name):
            middle, *half = np.array(node["boundingVolume"]["box"]).reshape(4, 3)
            boxes.append((np.linalg.inv(matrix), middle, np.diag(np.array(half))))
            if path is not None:
                points, _ = read_points_glb(path.read_bytes())
                at = (np.linalg.inv(matrix) @ (matrix @ local(points).T)).T[:, :3]
                assert (np.abs(at - middle) <= boxes[-1][2] + 1e-6).all()
        # the root holds everything
        inverse, middle, half_m = boxes[0]
        for _, matrix, path in nodes(out / "points", name):
            if path is not None:
                at = (inverse @ matrix @ local(read_points_glb(path.read_bytes())[0]).T).T[:, :3]
                assert (np.abs(at - middle) <= half_m + 0.01).all()


def test_children_are_finer_than_their_parents(out: Path) -> None:
    def check(node: dict[str, Any]) -> None:
        for child in node.get("children", ()):
            assert child["geometricError"] <= node["geometricError"]
            check(child)

    for path in (out / "points").rglob("tileset*.json"):
        tileset = json.loads(path.read_bytes())
        assert tileset["asset"] == {"version": "1.1"}
        assert tileset["root"]["refine"] == "ADD"
        assert tileset["geometricError"] >= tileset["root"]["geometricError"]
        check(tileset["root"])


def test_classes_are_those_of_classify(out: Path, source: Path, run_classify: Callable[..., ClassifySummary]) -> None:
    summary = run_classify(source, settings={**SETTINGS, "classes": "trust"})
    las = laspy.read(summary.files[0].path)
    xyz = np.rint(np.column_stack((las.x, las.y, las.z)) * MM).astype(np.int64)
    unique, first = np.unique(xyz, axis=0, return_index=True)
    places, found = all_points(out / "points")
    classes = np.concatenate([points.point_class for points in found])
    assert (classes == np.asarray(las.classification)[first][nearest(places, unique)]).all()
    counted = {str(code): int((classes == code).sum()) for code in np.unique(classes).tolist()}
    assert document(out / "points")["extras"]["classes"] == counted
    assert {"2", "5", "6"} <= counted.keys()


def records(out: Path) -> list[dict[str, Any]]:
    table = ds.dataset(out / "buildings", partitioning="hive").to_table()
    return table.drop_columns(["geometry", "solids"] if "solids" in table.column_names else ["geometry"]).to_pylist()


def test_residuals_and_planes_are_those_of_the_records(out: Path) -> None:
    """Residuals in the points, those of the roof returns, give the figures of the table of buildings."""
    places, found = all_points(out / "points")
    residuals: dict[str, list[np.ndarray]] = {}
    own_places: dict[str, list[np.ndarray]] = {}
    starts = np.cumsum([0, *map(len, found)]).tolist()
    for points, start, stop in zip(found, starts[:-1], starts[1:], strict=True):
        assert ((points.plane == NO_PLANE) == (points.residual_mm == NO_RESIDUAL)).all()
        assert (points.plane[points.building == NO_BUILDING] == NO_PLANE).all()
        for k, name in enumerate(points.buildings):
            residuals.setdefault(name, []).append(points.residual_mm[points.building == k])
            own_places.setdefault(name, []).append(places[start:stop][points.building == k])
    compared = 0
    for record in records(out):
        own = np.concatenate(residuals.pop(record["building_id"], [np.empty(0, np.int16)]))
        assert len(own) == record["n_points"]
        if record["rmse_m"] is not None and record["strip_offset_m"] is None:
            xyz = np.concatenate(own_places[record["building_id"]])
            distances = np.where(own == NO_RESIDUAL, np.nan, own / MM)
            returns = roof_returns((xyz - xyz.min(axis=0)) / MM, distances, record["point_spacing_m"])
            assert 1.0 - returns.mean() == pytest.approx(record["share_below_roof"], abs=2.5 / len(own))
            summary = summarise(distances[returns])
            assert summary.coverage == pytest.approx(record["coverage"], abs=2.5 / len(own))
            assert summary.rmse_m == pytest.approx(record["rmse_m"], abs=1e-3)
            compared += 1
    assert compared > 2
    assert not residuals


def test_planes_are_those_of_the_table_of_planes(out: Path) -> None:
    table = ds.dataset(out / "planes", partitioning="hive").to_table(["building_id", "plane_id"])
    known = {(row["building_id"], row["plane_id"]) for row in table.to_pylist()}
    found = set()
    for points in all_points(out / "points")[1]:
        at = points.plane != NO_PLANE
        found |= {
            (points.buildings[k], plane)
            for k, plane in zip(points.building[at].tolist(), points.plane[at].tolist(), strict=True)
        }
    assert found <= known
    assert len(found) > 0.9 * len(known)


def test_the_points_of_one_building_are_all_of_its_points(out: Path) -> None:
    folder = out / "points"
    shared = 0
    for record in records(out):
        content = building_points(lambda name: (folder / name).read_bytes(), record["tile"], record["building_id"])
        assert content is not None
        size = int.from_bytes(content[12:16], "little")
        found = json.loads(content[20 : 20 + size])
        assert sum(mesh["extras"]["points"] for mesh in found["meshes"]) == record["n_points"]
        index = json.loads((folder / record["tile"] / "buildings.json").read_bytes())
        shared += len(index[record["building_id"]]["tiles"]) > 1
    assert shared > 0


def test_on_the_globe_points_lie_where_proj_puts_them(out: Path) -> None:
    manifest = read_manifest(out)
    crs = pyproj.CRS.from_wkt(str(manifest.crs["wkt"])).to_3d()
    transformer = pyproj.Transformer.from_crs(crs, 4978, always_xy=True)
    origin = np.array(document(out / "points")["extras"]["origin_m"])
    here, there = list(nodes(out / "points")), list(nodes(out / "points", "tileset-ecef.json"))
    compared = 0
    for (_, local_matrix, path), (_, globe_matrix, same) in zip(here, there, strict=True):
        assert path == same
        if path is None:
            continue
        points = local(read_points_glb(path.read_bytes())[0])
        e, n, z = ((points @ local_matrix.T)[:, :3] + origin).T
        expected = np.column_stack(transformer.transform(e, n, z))
        assert np.abs((points @ globe_matrix.T)[:, :3] - expected).max() < 0.01
        compared += 1
    assert compared > 4


def test_the_content_of_a_run_does_not_change_by_its_points(out: Path, source: Path, reconstruct: Reconstruct) -> None:
    plain = reconstruct(source, settings=SETTINGS)
    assert plain.digest == read_manifest(out).content_sha256
    assert not Path(plain.run_dir, "points").exists()


def test_files_do_not_depend_on_the_order_of_tasks_or_on_the_files(
    out: Path, halves: tuple[Path, Path], suburb: Path, reconstruct: Reconstruct, shuffled: Any
) -> None:
    whole = reconstruct(suburb, settings=SETTINGS, points=True)
    parts = reconstruct(*halves, settings=SETTINGS, points=True, executor=shuffled(7))
    expected = files(Path(whole.run_dir, "points"))
    assert files(Path(parts.run_dir, "points")) == expected
    assert files(out / "points") == expected


def test_one_tile_needs_no_nodes_above_it(suburb: Path, reconstruct: Reconstruct) -> None:
    summary = reconstruct(suburb, settings={"tile_size_m": 1_000.0}, points=True)
    folder = Path(summary.run_dir, "points")
    assert len([path for path in folder.iterdir() if path.is_dir()]) == 1
    assert not (folder / "upper").exists()
    places, _ = all_points(folder)
    assert len(places) == document(folder)["extras"]["n_points"]


def test_a_tile_that_fails_costs_only_its_own_points(
    suburb: Path, reconstruct: Reconstruct, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = reconstruct(suburb, settings=SETTINGS, points=True)
    tiles = sorted(path.name for path in Path(whole.run_dir, "points").glob("x*"))
    written = tile_points._written

    def fails(task: Any, storage: Any) -> Any:
        if task.label.tile.key == tiles[1]:
            raise OSError("the disk is on fire")
        return written(task, storage)

    monkeypatch.setattr(tile_points, "_written", fails)
    summary = reconstruct(suburb, settings=SETTINGS, points=True)
    # its buildings are there, so the run is finished and the tile has not failed
    manifest = read_manifest(summary.run_dir)
    for one in (summary, manifest):
        assert (one.failed_tiles, one.tiles_without_points) == ((), (tiles[1],))
    assert any(tiles[1] in text and "the disk is on fire" in text for text in summary.warnings)
    assert (manifest.status, summary.is_complete, whole.is_complete) == (RunStatus.FINISHED, False, True)
    assert summary.digest == whole.digest
    folder = Path(summary.run_dir, "points")
    places, _ = all_points(folder)
    assert (
        len(places)
        == document(folder)["extras"]["n_points"]
        < document(Path(whole.run_dir, "points"))["extras"]["n_points"]
    )
    # a rerun needs the buildings alone; it removes all points, so none are missing
    name = records(Path(summary.run_dir))[0]["building_id"]
    rerun(RerunRequest(run_dir=summary.run_dir, only=(name,), resources=SERIAL))
    assert read_manifest(summary.run_dir).tiles_without_points == ()


def test_in_a_work_folder_points_are_written_once_and_follow_the_request(
    suburb: Path, reconstruct: Reconstruct, tmp_path: Path
) -> None:
    place = {"out": str(tmp_path / "run"), "work": str(tmp_path / "work")}
    folder = tmp_path / "run" / "points"
    reconstruct(suburb, settings=SETTINGS, points=True, **place)
    first = files(folder)
    tile = next(path for path in sorted(folder.glob("x*")))
    shutil.rmtree(tile)  # a user removes a tile: only this one is written again
    stays = next(path for path in sorted(folder.glob("x*")) if path != tile) / "buildings.json"
    before = stays.stat().st_mtime_ns
    (folder / "x9_y9").mkdir()
    (folder / "x9_y9" / "r.glb").write_bytes(b"of an earlier run")
    reconstruct(suburb, settings=SETTINGS, points=True, **place)
    assert files(folder) == first
    assert stays.stat().st_mtime_ns == before
    reconstruct(suburb, settings=SETTINGS, **place)
    assert not folder.exists()
    reconstruct(suburb, settings=SETTINGS, points=True, **place)
    assert files(folder) == first


def test_a_rerun_removes_points_that_show_the_models_before_it(
    suburb: Path, reconstruct: Reconstruct, tmp_path: Path
) -> None:
    summary = reconstruct(suburb, settings=SETTINGS, points=True)
    name = records(Path(summary.run_dir))[0]["building_id"]
    again = rerun(RerunRequest(run_dir=summary.run_dir, only=(name,), resources=Resources(workers=0)))
    assert again.digest == summary.digest
    assert not Path(summary.run_dir, "points").exists()
    manifest = read_manifest(summary.run_dir)
    assert manifest.request["points"] is False
    assert any("run again with --points" in text for text in manifest.warnings)


def test_points_in_a_bucket_are_those_in_a_folder(out: Path, suburb: Path, bucket: str, s3: Any) -> None:
    from pipeline.io import storage_at

    del s3
    settings = RunSettings.from_mapping(SETTINGS)
    run(RunRequest(inputs=(str(suburb),), out=f"{bucket}/run", settings=settings, resources=SERIAL, points=True))
    storage = storage_at(f"{bucket}/run")
    stored = {key.removeprefix("points/"): storage.get(key) for key in storage.keys("points")}
    assert stored == files(out / "points")
