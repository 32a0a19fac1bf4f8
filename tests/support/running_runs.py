"""A run that goes on, as its scratch shows it: batches that are done, without the science."""

import pickle
from collections.abc import Sequence
from pathlib import Path

import finished_runs as runs

from pipeline.export.facts import CandidateFacts
from pipeline.model import BuildingResult
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.models_so_far import ModelsSoFar
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import OutcomeTask, Place, run_and_store
from pipeline.runtime.stages.model_batch import Batch, StoredResult, figures_of
from pipeline.runtime.stages.reconstruct import stage_of_models
from service.outputs.buildings_so_far import BuildingsSoFar

STAGE = stage_of_models("0f" * 32)
"""The stage of the models of `finished_runs.write_run`."""


class RunningRun:
    """A run directory whose run goes on, with its scratch."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = runs.write_run(run_dir, {}, status=RunStatus.RUNNING)
        self.scratch = Scratch(str(run_dir / "scratch" / "0a"))
        Path(self.scratch.root).mkdir(parents=True)

    def models(self, tile: str, key: str, *buildings: BuildingResult, rejected: tuple[str, ...] = ()) -> None:
        """A batch is done; some of its candidates are rejected."""
        entries = {
            result.building_id: StoredResult(
                result=result, facts=CandidateFacts(), is_rejected=result.building_id in rejected
            )
            for result in buildings
        }
        stored = {name: ("", pickle.dumps(entry)) for name, entry in entries.items()}
        batch = Batch(modelled=(), stored=stored, compared=False, slow_s=1.0)
        place = Place(STAGE, tile, key)
        run_and_store(
            OutcomeTask(
                function=lambda _: batch,
                task=None,
                place=place,
                scratch=self.scratch,
                brief=figures_of,
                stage="reconstruct",
            )
        )

    @property
    def so_far(self) -> ModelsSoFar:
        """Its models."""
        found = ModelsSoFar.of_run(self.run_dir)
        assert found is not None
        return found

    def writer(self, folder: Path) -> BuildingsSoFar:
        """A writer of what readers see; not opened."""
        return BuildingsSoFar(folder, self.so_far.context, self.so_far.crs)

    def add_to(self, shown: BuildingsSoFar) -> None:
        """Add the batches that are not there yet, but do not show them."""
        for place in self.so_far.places():
            if place.name not in shown.batches:
                shown.add(place.name, place.unit, found_in(self.so_far, place))


def found_in(models: ModelsSoFar, place: Place) -> Sequence[StoredResult]:
    """The buildings of a batch that must be there."""
    found = models.buildings(place)
    assert found is not None
    return found
