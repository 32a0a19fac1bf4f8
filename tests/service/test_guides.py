"""Guides as an input of jobs: what an upload can hold, and a job that uses them."""

import json
from pathlib import Path
from typing import Any

import geopandas as gpd
import pytest
import shapely
from driver_bench import Bench
from live_service import las_bytes

from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from service.driver.attempt import compare_request, run_request
from service.fetching import Fetched, JobFiles
from service.jobs import InputReference, JobRequest, JobStatus
from service.preflight import examine
from service.settings import ServiceSettings

LINE = shapely.LineString([(84_010.0, 447_010.0), (84_030.0, 447_010.0)])
SQUARE = shapely.box(84_010.0, 447_010.0, 84_020.0, 447_020.0)


def write(path: Path, *geometries: Any, layer: str | None = None) -> Path:
    """Write features of kind ridge in RD."""
    frame = gpd.GeoDataFrame({"kind": ["ridge"] * len(geometries)}, geometry=list(geometries), crs="EPSG:28992")
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_file(path, **({} if layer is None else {"layer": layer}))
    return path


@pytest.mark.parametrize("suffix", [".gpkg", ".geojson", ".parquet"])
def test_an_upload_says_whether_it_holds_polygons_or_lines(tmp_path: Path, suffix: str) -> None:
    lines, polygons = (
        examine(write(tmp_path / f"{one.geom_type}{suffix}", one), max_points=1) for one in (LINE, SQUARE)
    )
    assert (lines["kind"], lines["shapes"], lines["usable"]) == ("guides", ["lines"], True)
    assert (polygons["kind"], polygons["shapes"], polygons["usable"]) == ("footprints", ["polygons"], True)
    assert (lines["crs"]["epsg"], lines["featureCount"]) == (28992, 1)


@pytest.mark.parametrize("suffix", [".geojson", ".parquet"])
def test_a_file_may_hold_both(tmp_path: Path, suffix: str) -> None:
    found = examine(write(tmp_path / f"a{suffix}", SQUARE, LINE), max_points=1)
    assert (found["kind"], found["shapes"]) == ("footprints", ["polygons", "lines"])


def test_a_geopackage_may_hold_both_and_one_with_two_layers_of_lines_is_ambiguous(tmp_path: Path) -> None:
    write(tmp_path / "a.gpkg", SQUARE, layer="outlines")
    path = write(tmp_path / "a.gpkg", LINE, layer="lines")
    assert examine(path, max_points=1)["shapes"] == ["polygons", "lines"]
    write(tmp_path / "b.gpkg", LINE, layer="one")
    found = examine(write(tmp_path / "b.gpkg", LINE, layer="other"), max_points=1)
    assert found["problems"] == ["2 layers could be the guides: give a file with one of them"]


def test_requests_of_both_processes_carry_the_guides(tmp_path: Path) -> None:
    guides = Fetched(
        reference=InputReference(kind="upload", value="g"), path=tmp_path / "a.gpkg", points=0, sha256=None
    )
    files, settings = JobFiles(tiles=[], guides=guides), ServiceSettings(state=tmp_path)
    request = JobRequest(tiles=(), methods=("arrangement", "kmeans"))
    alone = run_request(request, files, tmp_path / "out", settings)
    compared = compare_request(request, files, tmp_path / "out", settings)
    assert alone.guides == compared.run.guides == str(tmp_path / "a.gpkg")
    assert alone.footprints is None


@pytest.fixture
def driven(bench: Bench) -> Bench:
    """A driver that runs the engine in its own process, on one tile and the guides of the job."""

    def gather(request: JobRequest, *, target: Path, **_others: Any) -> JobFiles:
        target.mkdir(parents=True)
        (target / "tile.laz").write_bytes(las_bytes(2_000))
        tile = Fetched(reference=request.tiles[0], path=target / "tile.laz", points=2_000, sha256=None)
        assert request.guides is not None
        lines = Fetched(reference=request.guides, path=Path(request.guides.value), points=0, sha256=None)
        return JobFiles(tiles=[tile], guides=lines)

    def run_here(request: RunRequest, on_event: Any, executor: Any, cancelled: Any) -> RunSummary:
        del executor
        return run(RunRequest(**{**vars(request), "resources": Resources(workers=0)}), on_event, None, cancelled)

    bench.tools |= {"gather": gather, "run": run_here}
    return bench


def test_a_driver_gives_the_guides_to_the_run(driven: Bench, tmp_path: Path) -> None:
    guides = InputReference(kind="path", value=str(write(tmp_path / "lines.gpkg", LINE)))
    job = driven.submit({"guides": guides})
    driven.driver()
    done = driven.over(job)
    assert done.status is JobStatus.SUCCESSFUL, done.failure
    report = json.loads((driven.folder.run(job.job_id, 1) / "guides.json").read_text())
    assert report["used"] == 1


def test_guides_that_a_run_cannot_use_end_the_job_with_the_fix(driven: Bench, tmp_path: Path) -> None:
    guides = InputReference(kind="path", value=str(write(tmp_path / "points.gpkg", shapely.Point(84_000.0, 447_000.0))))
    job = driven.submit({"guides": guides})
    driven.driver()
    done = driven.over(job)
    assert done.status is JobStatus.FAILED
    assert done.failure is not None
    assert "none of the 1 features is a line that can be used. Give lines" in done.failure.detail
    assert str(tmp_path) not in done.failure.detail
