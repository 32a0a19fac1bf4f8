"""Finished runs of several tiles, written by the program's own export, and a service that holds them as jobs."""

import base64
import contextlib
import dataclasses
import datetime as dt
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import small_buildings as small
from markupsafe import escape
from starlette.testclient import TestClient

from pipeline.export.record_rows import RecordContext, RejectedObject
from pipeline.export.tile import write_tile
from pipeline.extras.octree.octree_tileset import TilesetNode, root_tileset, tile_tileset
from pipeline.extras.octree.point_glb import NO_BUILDING, NO_PLANE, NO_RESIDUAL, ModelledPoints, points_glb
from pipeline.extras.octree.point_octree import OctreeNode
from pipeline.model import BuildingResult, Reason
from pipeline.runtime.manifest import InputFile, PointFileFacts, RunManifest, RunStatus, write_manifest
from service.app import create_app
from service.files import StateFolder
from service.jobs import InputReference, Job, JobFailure, JobRequest
from service.keys import Scope, new_key
from service.outputs import write_comparison_outputs, write_outputs
from service.outputs.published_forms import publish
from service.settings import ServiceSettings
from service.store import JobStore

TILE_M = 100.0
BOUNDS_M = (85_000.0, 447_000.0, 85_200.0, 447_200.0)
SERVER_FOLDER = "/srv/the city's/uploads/0f0f"
"""Where the inputs of the runs lay: no answer may tell it. A page writes its apostrophe another way."""
LINKED_FOLDER = "/mnt/disk7/0f0f"
"""Where a link to the footprints led: no answer may tell that either."""

Tiles = Mapping[str, Sequence[BuildingResult]]


def ident(name: str) -> str:
    """An id as the program makes them.

    >>> ident("gable")
    'l3sszh52dfv4652trj3l3k2l'
    """
    return base64.b32encode(hashlib.sha256(name.encode()).digest()[:15]).decode().lower()


def placed(result: BuildingResult, name: str, east_m: float, north_m: float, up_m: float = 0.0) -> BuildingResult:
    """A building with an id of its own, moved."""
    x, y, z = small.ORIGIN
    return dataclasses.replace(result, building_id=ident(name), origin=(x + east_m, y + north_m, z + up_m))


def four_tiles() -> Tiles:
    """Models, a fallback, a failure without outline, a building of two solids; one tile owns no building."""
    return {
        "x850_y4470": [
            placed(small.gable(), "gable", 0.0, 0.0),
            placed(small.courtyard(), "courtyard", 20.0, 40.0),
            placed(small.failed(), "failed", 50.0, 50.0),
        ],
        "x851_y4470": [placed(small.two_parts(), "two_parts", 130.0, 20.0, 7.0)],
        "x850_y4471": [placed(small.pent(), "pent", 10.0, 150.0, -3.0), placed(small.gable(), "far", 80.0, 190.0)],
        "x851_y4471": [],
    }


def nine_tiles(n: int) -> Tiles:
    """So many buildings in each of nine tiles, some without outline."""
    makers = (small.gable, small.pent, small.courtyard, small.failed)
    return {
        f"x{850 + column}_y{4470 + row}": [
            placed(makers[k % 4](), f"{column} {row} {k}", column * 100.0 + k * 8.0, row * 100.0 + k * 7.0)
            for k in range(n)
        ]
        for column in range(3)
        for row in range(3)
    }


def reference(epsg: int | None) -> small.Reference:
    """A CRS as the exports see it; None for an unknown one."""
    if epsg is None:
        return small.Reference()
    crs = pyproj.CRS.from_epsg(epsg)
    unit_m = crs.axis_info[0].unit_conversion_factor
    return small.Reference(epsg=epsg, projjson=crs.to_json_dict(), horizontal_unit_m=unit_m, vertical_unit_m=unit_m)


def crs_facts(epsg: int | None) -> dict[str, Any]:
    """The entry of run.json."""
    crs = None if epsg is None else pyproj.CRS.from_epsg(epsg)
    unit_m = reference(epsg).horizontal_unit_m
    return {
        "epsg": epsg,
        "name": None if crs is None else crs.name,
        "wkt": None if crs is None else crs.to_wkt(),
        "horizontal_unit_m": unit_m,
        "vertical_unit_m": unit_m,
    }


LOCAL_CRS = 'ENGCRS["site",EDATUM["mark"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'


def with_local_crs(run_dir: Path) -> Path:
    """A run whose coordinates are those of a building site."""
    manifest = json.loads((run_dir / "run.json").read_text())
    crs = {**manifest["crs"], "name": "site", "wkt": LOCAL_CRS, "epsg": None}
    (run_dir / "run.json").write_text(json.dumps(manifest | {"crs": crs}))
    return run_dir


def write_run(
    run_dir: Path,
    tiles: Tiles | None = None,
    *,
    epsg: int | None = 7415,
    meshes: str = "building",
    failed_tile: str | None = None,
    status: RunStatus = RunStatus.FINISHED,
    further_lods: tuple[str, ...] = (),
    points: bool = True,
    tiles_without_points: tuple[str, ...] = (),
) -> Path:
    """A run directory with these buildings a tile, a rejected object in every tile, and the points of one building."""
    tiles = four_tiles() if tiles is None else tiles
    context = RecordContext(
        reference=reference(epsg),
        settings_hash="0f" * 32,
        engine_version="0.1.0",
        acquired_from=dt.datetime(2014, 3, 1, 10, tzinfo=dt.UTC),
        acquired_to=dt.datetime(2014, 3, 1, 11, tzinfo=dt.UTC),
        further_lods=further_lods,
    )
    (run_dir / "state").mkdir(parents=True)
    for key, buildings in tiles.items():
        shed = RejectedObject(
            object_id=ident(f"shed of {key}"),
            origin=buildings[0].origin if buildings else small.ORIGIN,
            reason=Reason.TOO_SMALL,
            reason_detail="4 m2, at least 10",
            outline=small.Polygon([(50, 0), (52, 0), (52, 2), (50, 2)]),
            area_m2=4.0,
            height_m=2.5,
            n_points=9,
        )
        files = write_tile(run_dir, key, buildings, [shed], context, meshes=meshes)
        state = {"tile": key, "state": "done", "error": "", "files": dict(files.digests)}
        (run_dir / "state" / f"{key}.json").write_text(json.dumps(state))
    for key, found in [entry for entry in tiles.items() if entry[1] and points][:1]:
        write_points(run_dir / "points", key, found[0])
    if failed_tile is not None:
        state = {"tile": failed_tile, "state": "failed", "error": f"OSError: {run_dir}/scratch/a is gone", "files": {}}
        (run_dir / "state" / f"{failed_tile}.json").write_text(json.dumps(state))
    manifest = RunManifest(
        status=status,
        engine_version="0.1.0",
        method="fuzzy-sart",
        settings={"general": {"method": "fuzzy-sart"}},
        settings_hash="0f" * 32,
        started_at=dt.datetime(2026, 3, 1, 9, tzinfo=dt.UTC),
        finished_at=dt.datetime(2026, 3, 1, 10, tzinfo=dt.UTC),
        crs=crs_facts(epsg),
        inputs=(
            InputFile(
                path=f"{SERVER_FOLDER}/tile.laz",
                sha256="ab" * 32,
                size_bytes=1000,
                n_points=640,
                bounds_m=BOUNDS_M,
                file=PointFileFacts(
                    format="laz",
                    n_points=700,
                    bounds_m=BOUNDS_M,
                    acquired=None,
                    dimensions={"X": "i4", "gps_time": "f8"},
                ),
            ),
            InputFile(path=f"{SERVER_FOLDER}/outlines.gpkg", sha256="cd" * 32, size_bytes=20),
        ),
        request={"footprints": f"{LINKED_FOLDER}/outlines.gpkg", "overrides": None, "aoi": None},
        source_licence="CC0",
        tiles=tuple(sorted(tiles)),
        failed_tiles=() if failed_tile is None else (failed_tile,),
        tiles_without_points=tiles_without_points,
        counts={"points": 640, "candidates": sum(map(len, tiles.values()))},
        timings_s={"split": 1.5, "total": 3.0},
        peak_memory_bytes={"node-7:99": 3_000_000, "node-8:1": 5_000_000},
        warnings=(f"{SERVER_FOLDER}/tile.laz: no GPS time", "something else"),
        content_sha256="ee" * 32,
    )
    write_manifest(run_dir, manifest)
    return run_dir


def write_points(folder: Path, tile: str, building: BuildingResult) -> None:
    """Four points of a building and one beside it, in one node of one tile."""
    origin_mm = tuple(round(value * 1000) for value in building.origin)
    points = ModelledPoints(
        xyz_mm=np.array(
            [[2_000, 3_000, 4_000], [2_500, 3_000, 4_100], [3_000, 3_100, 4_200], [9_000, 9_000, 10], [5, 6, 7]]
        ),
        point_class=np.array([6, 6, 6, 2, 6], np.uint8),
        building=np.array([0, 0, 0, NO_BUILDING, 0], np.uint16),
        plane=np.array([0, 0, 1, NO_PLANE, 1], np.uint16),
        residual_mm=np.array([12, -7, 0, NO_RESIDUAL, 33], np.int16),
        buildings=(building.building_id,),
    )
    place = {"origin_m": [value // 1000 for value in origin_mm]}
    low, high = points.xyz_mm.min(axis=0), points.xyz_mm.max(axis=0)
    node = OctreeNode(path="r", index=np.arange(5), low_mm=low, high_mm=high, spacing_m=0.0)
    root = TilesetNode(
        origin_mm=origin_mm,
        low_mm=tuple((low + origin_mm).tolist()),
        high_mm=tuple((high + origin_mm).tolist()),
        error_m=8.0,
        uri=f"{tile}/tileset.json",
        points=5,
    )
    extras = {**place, "horizontal_unit_m": 1.0, "vertical_unit_m": 1.0, "crs": None, "n_points": 5}
    index = {building.building_id: {"nodes": ["r"], "tiles": [tile]}}
    files = {
        f"{tile}/r.glb": points_glb(points, f"{tile}/r", place),
        f"{tile}/tileset.json": tile_tileset([node], place),
        f"{tile}/buildings.json": json.dumps(index).encode(),
        "tileset.json": root_tileset(root, extras) or b"",
    }
    (folder / tile).mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)


LABELS = ("fuzzy-sart", "fuzzy-sart-faithful")
"""The runs of the comparison."""


def write_comparison(folder: Path) -> Path:
    """A comparison of two runs that tell where their inputs lay in every way they can."""
    write_run(folder / "runs" / LABELS[0])
    # the second found the one building only
    write_run(
        folder / "runs" / LABELS[1], {"x850_y4470": [placed(small.gable(), "gable", 0.0, 0.0)]}, failed_tile="x9_y9"
    )
    quarantined = folder / "runs" / LABELS[1] / "quarantine"
    quarantined.mkdir()
    (quarantined / "b.bundle").write_bytes(b"points")
    facts = {"inputs": [f"{SERVER_FOLDER}/tile.laz"], "variants": [{"label": label} for label in LABELS], "share": 0.1}
    (folder / "compare.json").write_text(json.dumps(facts))
    script = "<script>document.title = 'compared'</script>"
    page = f"<!doctype html><title>Comparison</title><p>{escape(SERVER_FOLDER)}/tile.laz</p>{script}"
    (folder / "index.html").write_text(page)
    (folder / "compare.md").write_text(f"# Comparison\n{folder}/runs of {SERVER_FOLDER}/tile.laz\n")
    shutil.copy(folder / "runs" / LABELS[0] / "buildings/tile=x850_y4470/part-0.parquet", folder / "buildings.parquet")
    return folder


@dataclasses.dataclass(frozen=True, kw_only=True)
class Service:
    """A service on this process's own state folder."""

    client: TestClient
    store: JobStore
    folder: StateFolder

    def running(self, **request: Any) -> Job:
        """A job that a driver holds."""
        tiles = (InputReference(kind="path", value=f"{SERVER_FOLDER}/tile.laz"),)
        owner = request.pop("owner", None)
        self.store.create(JobRequest(tiles=tiles, **request), owner=owner)
        job = self.store.claim("a driver", lease_s=3600.0, max_attempts=3)
        assert job is not None
        return job

    def finished(
        self, write: Callable[[Path], object] = write_run, problems: dict[str, str] | None = None, **request: Any
    ) -> str:
        """The id of a job whose run is there; takes the problems of its formats, if it may have any."""
        job = self.running(**request)
        run_dir, out_dir = self.folder.run(job.job_id, job.attempt), self.folder.outputs(job.job_id, job.attempt)
        write(run_dir)
        found = publish(run_dir, out_dir, job.request.publish, name=job.job_id)
        assert problems is not None or not found, found
        (problems if problems is not None else {}).update({form: str(error) for form, error in found.items()})
        write_outputs(run_dir, out_dir, job.request.outputs)
        self.store.succeed(job, message="done", summary={})
        return job.job_id

    def keys(self, *names: str) -> list[tuple[str, dict[str, str]]]:
        """New keys that may submit: id and header of each."""
        made = [new_key(name, Scope.SUBMIT, now=self.store.now()) for name in names]
        for key, _ in made:
            self.store.add_key(key)
        return [(key.key_id, {"Authorization": f"Bearer {secret}"}) for key, secret in made]

    def compared(self, **request: Any) -> str:
        """The id of a comparison that is over."""
        job = self.running(process_id="compare", methods=("fuzzy-sart", "fuzzy-sart:faithful"), **request)
        folder = write_comparison(self.folder.comparison(job.job_id, job.attempt))
        out_dir = self.folder.outputs(job.job_id, job.attempt)
        write_comparison_outputs(folder, LABELS, out_dir, job.request.outputs)
        self.store.succeed(job, message="done", summary={})
        return job.job_id

    def failed(self, failure: JobFailure) -> str:
        """The id of a job that failed."""
        job = self.running()
        self.store.fail(job, failure)
        return job.job_id


@contextlib.contextmanager
def service(state: Path, database_url: str | None = None) -> Iterator[Service]:
    """A service without keys; its database is a SQLite file, unless another is named."""
    settings = ServiceSettings(state=state, database_url=database_url)
    with JobStore(settings.database) as store, TestClient(create_app(settings, store), "http://127.0.0.1") as client:
        # sizes and tags are those of the files themselves
        client.headers["Accept-Encoding"] = "identity"
        yield Service(client=client, store=store, folder=StateFolder(state))


def problem(response: Any, status: int, word: str) -> str:
    """The detail of an answer that must be this problem."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    reported = response.json()
    assert reported["status"] == status
    assert reported["type"].endswith(word), reported
    return str(reported["detail"])


def execute(service, process: str = "compare", outputs: dict | None = None, **inputs: object):
    tile = {"href": f"/uploads/{service.upload()}"}
    body: dict[str, Any] = {"inputs": {"tiles": tile, "crs": "EPSG:28992", **inputs}}
    if outputs is not None:
        body["outputs"] = outputs
    return service.client.post(f"/processes/{process}/execution", json=body)


def faults_of(answer) -> str:
    assert answer.status_code == 400, answer.text
    return "\n".join(answer.json()["errors"])
