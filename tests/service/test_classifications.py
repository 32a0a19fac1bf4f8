"""The process `classify`: what it takes, what a driver makes of it, and what its results answer."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import finished_runs as runs
import laspy
import numpy as np
import pytest
from driver_bench import Bench
from finished_runs import execute, faults_of
from live_service import las_bytes

from pipeline.extras.classify.classify import ClassifyRequest, ClassifySummary, classify
from pipeline.extras.classify.write_classified import ClassifiedFile
from pipeline.runtime.resources import Resources
from service.driver.attempt import classify_request
from service.driver.failure_words import Scrubber, classification_outcome
from service.fetching import Fetched, JobFiles
from service.jobs import JobRequest, JobStatus
from service.outputs import CLASSIFICATION_OUTPUTS, write_classification_outputs
from service.outputs.kinds import RASTERS
from service.settings import ServiceSettings


def summary_in(folder: Path) -> ClassifySummary:
    """A classification of two tiles, with files that only look like its own."""
    folder.mkdir(parents=True)
    files = []
    for name, count in (("a.laz", 3), ("b.laz", 1)):
        (folder / name).write_bytes(name.encode())
        source, counts = f"{runs.SERVER_FOLDER}/{name}", {2: count}
        files.append(
            ClassifiedFile(source=source, path=str(folder / name), points=count, classes=counts, kept=0, warnings=())
        )
    for name in RASTERS:
        (folder / f"{name}.tif").write_bytes(name.encode())
    return ClassifySummary(
        out=str(folder),
        files=tuple(files),
        rasters=tuple(str(folder / f"{name}.tif") for name in RASTERS),
        classes={2: 3, 6: 1},
        buildings=1,
        timings_s={"total": 1.25},
        peak_memory_bytes={"host:1": 5},
        warnings=(f"{runs.SERVER_FOLDER}/a.laz: odd",),
    )


def write_classification(run_dir: Path, out_dir: Path, wanted: Any) -> None:
    write_classification_outputs(summary_in(run_dir), out_dir, wanted, lambda *_: None, Scrubber())


def test_it_takes_what_all_processes_take_and_the_cell_of_its_rasters(local_service) -> None:
    reconstruct, described = (
        local_service.client.get(f"/processes/{name}").json() for name in ("reconstruct", "classify")
    )
    of_models = {"guides", "method", "preset", "lods", "bbox", "meshes", "points", "publish", "geoidHeight", "licence"}
    assert set(described["inputs"]) == set(reconstruct["inputs"]) - of_models | {"rasterCell"}
    assert set(described["outputs"]) == set(CLASSIFICATION_OUTPUTS)


def test_a_classification_waits_as_what_it_is_and_can_be_sent_again(local_service) -> None:
    first = execute(local_service, "classify", rasterCell=2.0, outputs={"terrain": {}}, classes="trust")
    assert first.status_code == 201, first.text
    reported = first.json()
    again = local_service.client.post("/processes/classify/execution", json=reported["request"]).json()
    one, other = (local_service.store.get(job["jobID"]).request for job in (reported, again))
    assert one == other
    assert (one.process_id, one.outputs, one.raster_cell) == ("classify", ("terrain",), 2.0)


@pytest.mark.parametrize(
    ("inputs", "words"),
    [
        ({"rasterCell": 0.0}, "rasterCell is 0.0"),
        ({"rasterCell": "1 m"}, "rasterCell is"),
        ({"meshes": "tile"}, '"meshes" is not an input'),
        ({"bbox": [0, 0, 1, 1]}, '"bbox" is not an input'),
    ],
)
def test_faults_of_a_classification_are_reported(local_service, inputs: dict[str, Any], words: str) -> None:
    assert words in faults_of(execute(local_service, "classify", **inputs))


@pytest.mark.parametrize(
    ("outputs", "drawn"), [(None, True), (("points",), False), (("points", "height"), True), (("classes",), False)]
)
def test_rasters_are_drawn_only_if_one_is_wanted(tmp_path: Path, outputs: Any, drawn: bool) -> None:
    asked = JobRequest(tiles=(), process_id="classify", outputs=outputs, raster_cell=2.0)
    request = classify_request(asked, JobFiles(tiles=[]), tmp_path / "out", ServiceSettings(state=tmp_path))
    assert (request.rasters, request.raster_cell) == (drawn, 2.0 if drawn else None)
    assert request.only_files


def finished(service: runs.Service, outputs: tuple[str, ...] | None = None) -> str:
    job = service.running(process_id="classify", outputs=outputs)
    place = service.folder.run(job.job_id, job.attempt)
    write_classification(place, service.folder.outputs(job.job_id, job.attempt), outputs)
    assert not place.exists()
    service.store.succeed(job, message="done", summary={})
    return job.job_id


def test_the_results_are_the_points_the_rasters_and_the_counts(service: runs.Service) -> None:
    place = f"/jobs/{finished(service)}/results"
    found = service.client.get(place).json()
    assert list(found) == list(CLASSIFICATION_OUTPUTS)
    for name in RASTERS:
        answer = service.client.get(found[name]["href"])
        assert (answer.content, answer.headers["content-type"]) == (name.encode(), "image/tiff")
    with zipfile.ZipFile(io.BytesIO(service.client.get(f"{place}/points").content)) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == {"a.laz": b"a.laz", "b.laz": b"b.laz"}
    counts = service.client.get(f"{place}/classes").json()
    assert counts["classes"] == {"2": 3, "6": 1}
    assert [file["name"] for file in counts["files"]] == ["a.laz", "b.laz"]
    assert runs.SERVER_FOLDER not in json.dumps(counts)


def test_only_the_wanted_outputs_are_kept(service: runs.Service) -> None:
    job_id = finished(service, ("terrain", "classes"))
    assert list(service.client.get(f"/jobs/{job_id}/results").json()) == ["terrain", "classes"]


def test_a_classification_has_no_buildings_and_says_so(service: runs.Service) -> None:
    job_id = finished(service)
    links = service.client.get(f"/jobs/{job_id}").json()["links"]
    assert not [link for link in links if link["rel"] == "items"]
    for path in ("buildings", f"buildings/{runs.ident('gable')}"):
        answer = service.client.get(f"/jobs/{job_id}/{path}")
        assert "the process classify has no buildings" in runs.problem(answer, 404, "no-such-output")


def test_the_outcome_is_one_sentence(tmp_path: Path) -> None:
    assert (
        classification_outcome(summary_in(tmp_path / "out")) == "2 files with 4 points: 75.0 % ground, 25.0 % building"
    )


@pytest.mark.slow
def test_a_driver_classifies_a_tile_and_writes_it_back_whole(bench: Bench) -> None:
    sent = las_bytes(20_000)

    def gather(request: JobRequest, *, target: Path, **_others: Any) -> JobFiles:
        target.mkdir(parents=True)
        (target / "tile.laz").write_bytes(sent)
        tile = Fetched(reference=request.tiles[0], path=target / "tile.laz", points=20_000, sha256=None)
        return JobFiles(tiles=[tile])

    def classify_here(request: ClassifyRequest, on_event: Any, executor: Any, cancelled: Any) -> ClassifySummary:
        del executor
        here = ClassifyRequest(**{**vars(request), "resources": Resources(workers=0)})
        return classify(here, on_event, None, cancelled)

    bench.tools |= {"gather": gather, "classify": classify_here}
    job = bench.submit({"process_id": "classify"})
    bench.driver()
    done = bench.over(job)
    assert done.status is JobStatus.SUCCESSFUL, done.failure
    assert done.message.startswith("1 file with 20000 points: ")
    progress = [event.progress for event in bench.store.events(done.job_id)]
    assert progress == sorted(progress)
    assert len(set(progress)) > 5
    out_dir = bench.folder.outputs(job.job_id, 1)
    with zipfile.ZipFile(out_dir / "points.zip") as archive:
        written = laspy.read(io.BytesIO(archive.read("tile.laz")))
    before = laspy.read(io.BytesIO(sent))
    assert np.array_equal(written.X, before.X)
    assert sum(done.summary["classes"].values()) == len(before.X)
    for name in RASTERS:
        assert (out_dir / f"{name}.tif").read_bytes()[:2] == b"II"
