"""Which jobs are estimated and run, and how estimates are compared with the truth."""

import itertools
import tomllib
from pathlib import Path
from typing import Any

import pytest

from benchmarks.estimates import HEADER, Job, jobs, rows
from pipeline.batch.batch_file import read_batch


def a_round(job: str, guess: float, truth: float) -> dict[str, Any]:
    pairs = {"wall_s": [guess, truth], "largest_gib": [0.4, 0.4], "all_gib": [1.0, 0.8], "buildings": [9, 10]}
    return {"job": job, "plan_s": 4.0, "load": 1.0, "load_after": 2.0, **pairs}


def test_a_row_has_the_medians_and_the_range_of_the_ratios() -> None:
    found = [a_round("CSite2", 10.0, 20.0), a_round("Delft, workers 0", 1.0, 1.0), a_round("CSite2", 30.0, 20.0)]
    first, second = rows([*found, a_round("CSite2", 20.0, 20.0)])
    assert first[:5] == ["CSite2", "3", "20.0 s", "20.0 s", "1.00 (0.50 to 1.50)"]
    assert first[-3:] == ["9 / 10", "4 s", "1.0 to 2.0"]
    # a job whose times gave the rates is marked
    assert second[0] == "Delft, workers 0 *"
    assert len(first) == len(second) == len(HEADER)


def test_each_job_is_a_batch_file_and_a_command_with_the_same_options(tmp_path: Path) -> None:
    found = [Job(name="a", inputs=(tmp_path / "a.laz",)), *jobs(tmp_path, None, ())]
    assert len({job.label for job in found}) == len(found)
    for job in found:
        file = tmp_path / "job.toml"
        file.write_text(job.batch(tmp_path / "models"))
        words = job.words(tmp_path / "models")
        batch, given = read_batch(str(file)), dict(itertools.pairwise(words))
        assert [Path(path) for path in batch.request().inputs] == [path.resolve() for path in job.inputs]
        assert batch.request().settings.general.method == given["--method"] == job.method
        assert batch.request().settings.general.classes == given["--classes"] == job.classes
        assert str(tomllib.loads(file.read_text())["cluster"]["workers"]) == given["--workers"]
        assert (batch.request().footprints or "") == given.get("--footprints", "") == job.footprints


@pytest.mark.parametrize("workers", ["auto", 0, 2])
def test_a_label_names_what_is_not_usual(workers: int | str) -> None:
    label = Job(name="a", inputs=(), workers=workers, classes="trust", footprints="f.gpkg").label
    assert label == "a, with classes, in footprints" if workers == "auto" else f"a, workers {workers}, with" in label
