"""A small simulated suburb for runs that take seconds."""

import dataclasses
import random
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from pipeline.extras.classify.classify import ClassifyRequest, ClassifySummary, classify
from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Candidate
from pipeline.recipe import reconstruct_building
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.monitoring.measurement import Measured, measure
from pipeline.runtime.monitoring.progress import Listener, ignore
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.settings import RunSettings


@pytest.fixture(scope="session")
def suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LAZ tile of about 70 x 70 m with a few houses and trees."""
    return simulate("suburb", tmp_path_factory.mktemp("suburb"), 3, size_m=(70.0, 70.0), density_per_m2=4.0).laz


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LAZ tile of about 220 x 200 m: rows of touching houses at several levels, streets, trees."""
    return simulate("town", tmp_path_factory.mktemp("town"), 5, size_m=(220.0, 200.0), density_per_m2=3.0).laz


@pytest.fixture(scope="session")
def halves(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same points in two files whose points overlap and come in another order."""
    folder = tmp_path_factory.mktemp("halves")
    las = laspy.read(suburb)
    order = np.random.default_rng(5).permutation(len(las.points))
    cut = len(order) // 2
    paths = folder / "b.laz", folder / "a.laz"
    for path, chosen in zip(paths, (order[: cut + 500], order[cut - 500 :]), strict=True):
        part = laspy.LasData(las.header)
        part.points = las.points[chosen]
        part.write(path)
    return paths


class ShuffledExecutor(SerialExecutor):
    """Runs tasks, and hands out results, in an order that a seed decides."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def map(
        self, stage: str, function: Callable[[Any], Any], tasks: Sequence[Any], watch: Any
    ) -> Generator[Measured[Any], None, None]:
        """Run all tasks in random order, then yield them in another one."""
        del stage, watch
        results = [measure(function, task) for task in self._random.sample(list(tasks), len(tasks))]
        yield from self._random.sample(results, len(results))


@pytest.fixture
def shuffled() -> type[ShuffledExecutor]:
    """An executor whose order a seed decides."""
    return ShuffledExecutor


Reconstruct = Callable[..., RunSummary]
RESOURCES = {field.name for field in dataclasses.fields(Resources)}


@pytest.fixture
def reconstruct(tmp_path: Path) -> Reconstruct:
    """Run serially into a fresh directory: `reconstruct(*paths, settings={...}, **fields)` of request or resources."""
    numbers = iter(range(1000))

    def go(
        *paths: Path,
        settings: dict[str, Any] | None = None,
        executor: Any = None,
        on_event: Listener = ignore,
        **fields: Any,
    ) -> RunSummary:
        request = RunRequest(
            inputs=tuple(str(path) for path in paths),
            out=fields.pop("out", str(tmp_path / f"run-{next(numbers)}")),
            settings=RunSettings.from_mapping(settings or {}),
            resources=Resources(**{"workers": 0} | {name: fields.pop(name) for name in RESOURCES & fields.keys()}),
            **fields,
        )
        return run(request, on_event, executor)

    return go


@pytest.fixture
def run_classify(tmp_path: Path) -> Callable[..., ClassifySummary]:
    """Classify serially, classes ignored, into a fresh folder, as `reconstruct` does."""
    numbers = iter(range(1000))

    def go(*paths: Path, settings: dict[str, Any] | None = None, executor: Any = None, **fields: Any) -> Any:
        request = ClassifyRequest(
            inputs=tuple(str(path) for path in paths),
            out=fields.pop("out", str(tmp_path / f"classified-{next(numbers)}")),
            settings=RunSettings.from_mapping({"classes": "ignore", **(settings or {})}),
            resources=Resources(workers=fields.pop("workers", 0)),
            **fields,
        )
        return classify(request, executor=executor)

    return go


@pytest.fixture
def candidates(monkeypatch: pytest.MonkeyPatch) -> list[Candidate]:
    """Gets the candidates of the runs of a test."""
    seen: list[Candidate] = []

    def watched(candidate: Candidate, method: str, settings: ReconstructSettings) -> BuildingResult:
        seen.append(candidate)
        return reconstruct_building(candidate, method, settings)

    monkeypatch.setattr("pipeline.recipe.reconstruct_building", watched)
    return seen
