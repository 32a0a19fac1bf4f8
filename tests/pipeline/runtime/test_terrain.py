"""The terrain of a run: around its models, the same for any order and any files, and never in the way of a run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.extras.terrain_tin import terrain_output as terrain
from pipeline.extras.terrain_tin.terrain_files import TerrainTriangles, read_terrain
from pipeline.runtime.manifest import RunManifest, RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import RunSummary

Reconstruct = Callable[..., RunSummary]

pytestmark = pytest.mark.slow

PLAIN = {"tile_size_m": 40.0, "lattice_x_m": 3.21, "lattice_y_m": -7.5}
"""Several tiles, whose borders cut cells and houses."""
SETTINGS = {**PLAIN, "terrain": "tin"}


@pytest.fixture(scope="module")
def out(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with terrain, in several tiles."""
    from pipeline.runtime.request import RunRequest
    from pipeline.runtime.run import run
    from pipeline.settings import RunSettings

    folder = tmp_path_factory.mktemp("terrain") / "run"
    settings = RunSettings.from_mapping(SETTINGS)
    run(RunRequest(inputs=(str(suburb),), out=str(folder), settings=settings, resources=SERIAL))
    return folder


def files(run_dir: Path | str) -> dict[str, bytes]:
    folder = Path(run_dir, "terrain")
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def tiles(run_dir: Path) -> dict[str, TerrainTriangles]:
    found = sorted(run_dir.glob("terrain/*/*.city.jsonl"))
    return {path.parent.name: read_terrain(path.read_text().splitlines()) for path in found}


def edges(run_dir: Path) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """All directed edges of the terrain, in millimetres."""
    found = []
    for one in tiles(run_dir).values():
        places = [tuple(place) for place in np.rint(one.vertices * 1000).astype(int).tolist()]
        for a, b, c in one.triangles.tolist():
            found.extend(((places[a], places[b]), (places[b], places[c]), (places[c], places[a])))
    return found


def counts(manifest: RunManifest) -> dict[str, int]:
    return {name: n for name, n in manifest.counts.items() if name.startswith("terrain_")}


def test_the_terrain_of_all_tiles_is_one_surface_that_meets_the_floors_of_the_models(out: Path) -> None:
    found = edges(out)
    known = set(found)
    assert len(known) == len(found)
    free = {edge for edge in known if edge[::-1] not in known}
    side, x0, y0 = (read_manifest(out).lattice[name] for name in ("tile_size_m", "origin_x_m", "origin_y_m"))
    whole, divided = 0, 0
    for path in sorted(out.glob("meshes/*/*.obj")):
        for a, b in floor_edges(path):
            if len({((p[0] / 1000 - x0) // side, (p[1] / 1000 - y0) // side) for p in (a, b)}) > 1:
                divided += 1  # where it crosses a border
                continue
            # the terrain takes the place of the floor: its edge is that of the floor, and runs against that of the wall
            assert (a, b) in free
            whole += 1
    assert (whole, divided) > (12, 0)


def floor_edges(path: Path) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """The directed edges of the floors in a building's OBJ, in millimetres."""
    vertices, group, found = [], "", []
    for line in map(str.split, path.read_text().splitlines()):
        if line[0] == "v":
            vertices.append(tuple(round(float(v) * 1000) for v in line[1:]))
        elif line[0] == "g":
            group = line[1]
        elif line[0] == "f" and group == "ground":
            ring = [vertices[int(k) - 1] for k in line[1:]]
            found.extend(zip(ring, ring[1:] + ring[:1], strict=True))
    return found


def test_borders_between_tiles_are_closed(out: Path) -> None:
    manifest = read_manifest(out)
    side, x0, y0 = (round(manifest.lattice[name] * 1000) for name in ("tile_size_m", "origin_x_m", "origin_y_m"))
    found = set(edges(out))
    tried = 0
    for axis, origin in ((0, x0), (1, y0)):
        levels = [place[axis] for edge in found for place in edge]
        for a, b in found:
            on_border = a[axis] == b[axis] and (a[axis] - origin) % side == 0
            if on_border and min(levels) < a[axis] < max(levels):
                tried += 1
                assert (b, a) in found
    assert tried > 40


def test_both_files_hold_the_same_and_the_manifest_counts_it(out: Path) -> None:
    manifest = read_manifest(out)
    found = tiles(out)
    assert len(found) == len(list(out.glob("terrain/*/*.obj"))) > 3
    for name, one in found.items():
        lines = [line.split() for line in (out / "terrain" / name / "part-0.obj").read_text().splitlines()]
        vertices = [[float(v) for v in line[1:]] for line in lines if line[0] == "v"]
        assert np.array_equal(vertices, one.vertices)
        assert np.array_equal([[int(v) - 1 for v in line[1:]] for line in lines if line[0] == "f"], one.triangles)
    counted = counts(manifest)
    assert counted["terrain_triangles"] == sum(len(one.triangles) for one in found.values())
    assert 0 < counted["terrain_rms_error_mm"] < counted["terrain_max_error_mm"] <= 100
    assert counted["terrain_cells"] > 2000
    assert "terrain" in manifest.timings_s


def test_the_content_of_a_run_does_not_change_by_its_terrain(out: Path, suburb: Path, reconstruct: Reconstruct) -> None:
    plain = reconstruct(suburb, settings=PLAIN)
    manifest = read_manifest(out)
    assert plain.digest == manifest.content_sha256
    assert read_manifest(plain.run_dir).settings_hash == manifest.settings_hash
    assert not Path(plain.run_dir, "terrain").exists()
    assert not counts(read_manifest(plain.run_dir))


def test_files_do_not_depend_on_the_order_of_tasks_or_on_the_files(
    out: Path, halves: tuple[Path, Path], reconstruct: Reconstruct, shuffled: Any
) -> None:
    parts = reconstruct(*halves, settings=SETTINGS, executor=shuffled(7))
    assert files(parts.run_dir) == files(out)


def test_without_meshes_there_is_no_obj(out: Path, suburb: Path, reconstruct: Reconstruct) -> None:
    summary = reconstruct(suburb, settings=SETTINGS, meshes="none")
    expected = {name: content for name, content in files(out).items() if not name.endswith(".obj")}
    assert files(summary.run_dir) == expected


def test_a_coarser_tolerance_needs_fewer_triangles(out: Path, suburb: Path, reconstruct: Reconstruct) -> None:
    summary = reconstruct(suburb, settings={**SETTINGS, "terrain_tolerance_m": 0.5}, meshes="none")
    assert summary.counts["terrain_triangles"] < 0.8 * counts(read_manifest(out))["terrain_triangles"]
    assert summary.counts["terrain_max_error_mm"] > 100


def test_a_tile_that_fails_costs_only_its_own_terrain_and_a_rerun_removes_all(
    out: Path, suburb: Path, reconstruct: Reconstruct, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = sorted(read_manifest(out).tiles)
    written = terrain._written

    def fails(task: terrain.TerrainTask) -> terrain.TileTerrain:
        if task.tile.key == keys[1]:
            raise OSError("the disk is on fire")
        return written(task)

    monkeypatch.setattr(terrain, "_written", fails)
    summary = reconstruct(suburb, settings=SETTINGS)
    manifest = read_manifest(summary.run_dir)
    for one in (summary, manifest):
        assert (one.failed_tiles, one.tiles_without_terrain) == ((), (keys[1],))
    assert any(keys[1] in text and "the disk is on fire" in text for text in summary.warnings)
    assert (manifest.status, summary.is_complete) == (RunStatus.FINISHED, False)
    assert files(summary.run_dir) == {n: data for n, data in files(out).items() if f"tile={keys[1]}/" not in n}
    name = next(Path(summary.run_dir).glob("meshes/*/*.obj")).stem
    again = rerun(RerunRequest(run_dir=summary.run_dir, only=(name,), resources=SERIAL))
    assert again.digest == summary.digest
    manifest = read_manifest(summary.run_dir)
    assert not files(summary.run_dir)
    assert (manifest.tiles_without_terrain, counts(manifest)) == ((), {})
    assert any("run again with --terrain tin" in text for text in manifest.warnings)
    assert manifest.settings["general"]["terrain"] == "none"


def test_a_tile_that_fails_keeps_no_terrain_of_an_earlier_run(
    out: Path, suburb: Path, reconstruct: Reconstruct, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = {"out": str(tmp_path / "run"), "work": str(tmp_path / "work")}
    reconstruct(suburb, settings={**SETTINGS, "terrain_tolerance_m": 0.5}, **place)
    key = sorted(read_manifest(out).tiles)[1]
    written = terrain._written

    def fails(task: terrain.TerrainTask) -> terrain.TileTerrain:
        if task.tile.key == key:
            raise OSError("the disk is on fire")
        return written(task)

    monkeypatch.setattr(terrain, "_written", fails)
    summary = reconstruct(suburb, settings=SETTINGS, **place)
    assert summary.tiles_without_terrain == (key,)
    assert files(summary.run_dir) == {n: data for n, data in files(out).items() if f"tile={key}/" not in n}


def test_no_terrain_lies_within_the_floor_of_a_building_wider_than_its_tile(
    suburb: Path, reconstruct: Reconstruct
) -> None:
    summary = reconstruct(suburb, settings={**SETTINGS, "tile_size_m": 6.0})
    run_dir = Path(summary.run_dir)
    triangles = np.concatenate([one.vertices[one.triangles][:, :, :2] for one in tiles(run_dir).values()])
    middles = shapely.points(triangles.mean(axis=1))
    wide = 0
    for path in sorted(run_dir.glob("meshes/*/*.obj")):
        lines = shapely.linestrings([[a[:2], b[:2]] for a, b in floor_edges(path)])
        floor = shapely.transform(shapely.polygonize(lines), lambda xy: xy / 1000.0)
        west, _, east, _ = shapely.bounds(floor)
        wide += east - west > 12.0
        assert not shapely.contains_properly(shapely.buffer(floor, -0.002), middles).any()
    assert wide > 0


def test_in_a_work_folder_terrain_is_written_once_and_follows_the_settings(
    out: Path, suburb: Path, reconstruct: Reconstruct, tmp_path: Path
) -> None:
    place = {"out": str(tmp_path / "run"), "work": str(tmp_path / "work")}
    folder = tmp_path / "run" / "terrain"
    first = reconstruct(suburb, settings=SETTINGS, **place)
    assert files(first.run_dir) == files(out)
    gone, stays, *_ = sorted(folder.glob("*/part-0.obj"))
    gone.unlink()  # a user removes a file: only its tile is written again
    before = stays.stat().st_mtime_ns
    (folder / "tile=x9_y9").mkdir()
    (folder / "tile=x9_y9" / "part-0.obj").write_bytes(b"of an earlier run")
    again = reconstruct(suburb, settings=SETTINGS, **place)
    assert files(first.run_dir) == files(out)
    assert stays.stat().st_mtime_ns == before
    assert again.counts["terrain_triangles"] == first.counts["terrain_triangles"]
    reconstruct(suburb, settings=PLAIN, **place)
    assert not folder.exists()
