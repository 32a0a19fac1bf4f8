"""The models of a run that goes on: what its batches have put into scratch, read from outside.

The run does nothing for it. Every outcome in scratch is whole, never changes, and is there as long as the run models
and publishes; afterwards the run directory has all of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import RunCancelledError
from pipeline.export.facts import RecordContext
from pipeline.io import SpatialReference
from pipeline.runtime.manifest import NAME, RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.location import SCRATCH
from pipeline.runtime.scratch.outcomes import Place, keys_of, stored_units
from pipeline.runtime.stages.model_batch import StoredResult, stored_results
from pipeline.runtime.stages.reconstruct import stage_of_models


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelsSoFar:
    """Where a run puts its models, and what their records say about the run."""

    scratch: Scratch
    """The run's scratch."""
    stage: str
    """The stage under which its models are stored."""
    context: RecordContext
    """Facts of the run for the records, as far as a run that goes on knows them."""
    crs: Mapping[str, Any] | None
    """The entry of run.json."""

    @classmethod
    def of_run(cls, run_dir: Path) -> ModelsSoFar | None:
        """The models of the run into a local directory, whose scratch is there, too.

        None before the run begins and after it ends: scratch exists only in between.

        Raises
        ------
        RunError
            run.json is damaged.
        """
        if not (run_dir / NAME).is_file():
            return None
        manifest = read_manifest(run_dir)
        roots = sorted(_folders(run_dir / SCRATCH))
        if manifest.status is not RunStatus.RUNNING or not roots:
            return None
        crs = manifest.crs
        return cls(
            scratch=Scratch(str(roots[0])),
            stage=stage_of_models(manifest.settings_hash),
            context=RecordContext(
                reference=SpatialReference.of_facts(crs),
                settings_hash=manifest.settings_hash,
                engine_version=manifest.engine_version,
            ),
            crs=crs,
        )

    def places(self) -> list[Place]:
        """The batches that are done, by tile and key."""
        return [
            Place(self.stage, unit, key)
            for unit in stored_units(self.scratch, self.stage)
            for key in keys_of(self.scratch, self.stage, unit)
        ]

    def buildings(self, place: Place) -> list[StoredResult] | None:
        """The buildings of a batch; None if scratch is gone, since the run is over.

        Only for scratch of our own account: pickles run code.
        """
        try:
            return [entry for entry in stored_results(self.scratch, place) if not entry.is_rejected]
        except RunCancelledError:
            return None


def _folders(folder: Path) -> list[Path]:
    try:
        return [path for path in folder.iterdir() if path.is_dir()]
    except FileNotFoundError:
        return []
