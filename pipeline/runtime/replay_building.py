"""Replay: one quarantined building again, on any machine, from its bundle alone."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline import __version__
from pipeline.errors import RunError
from pipeline.export.facts import RecordContext
from pipeline.export.obj import obj_text
from pipeline.export.record_rows import building_row
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.export.tile import city_lines
from pipeline.model import BuildingResult, Reason
from pipeline.recipe import failed_building
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits, Loss
from pipeline.runtime.isolation.replay_bundle import Bundle

_OF_THE_RUN = ("geometry", "acquired_from", "acquired_to", "mesh_path", "input_hash", "settings_hash", *SHAPE_COLUMNS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Replayed:
    """The outcome of a building this time."""

    result: BuildingResult
    """The result, as in a run."""
    loss: Loss | None = None
    """How it ended its process; None where it did not."""


def replay(bundle: Bundle, limits: IsolationLimits | None) -> Replayed:
    """Model a bundle's building in a child process with limits; raises RunError if none can be started.

    Without limits it is modelled in this process, where a debugger sees it and a crash ends the process.
    """
    if limits is None:
        try:
            return Replayed(result=model_bundle(bundle))
        except MemoryError as error:
            return Replayed(result=_failed(bundle, Reason.OUT_OF_MEMORY, f"memory ran out: {error}"))
    ((_, outcome),) = supervise(model_bundle, [bundle], limits)
    if isinstance(outcome, Loss):
        return Replayed(result=_failed(bundle, outcome.reason, outcome.detail), loss=outcome)
    return Replayed(result=outcome)


def _failed(bundle: Bundle, reason: Reason, detail: str) -> BuildingResult:
    return failed_building(bundle.candidate, bundle.method, reason, detail)


def replay_row(bundle: Bundle, replayed: Replayed) -> Mapping[str, Any]:
    """The building's record, without the columns that only a run has."""
    row = building_row(replayed.result, _context(bundle))
    return {name: value for name, value in row.items() if name not in _OF_THE_RUN}


def _context(bundle: Bundle) -> RecordContext:
    return RecordContext(reference=bundle.reference, settings_hash="", engine_version=__version__)


def write_replay(folder: str, bundle: Bundle, replayed: Replayed) -> tuple[Path, ...]:
    """Write `<building_id>.json`, and where there is a model `<building_id>.obj` and `<building_id>.city.jsonl`.

    Raises RunError if the folder cannot be written.
    """
    result, row = replayed.result, replay_row(bundle, replayed)
    texts = {".json": json.dumps(row, indent=1) + "\n"}
    if result.solids:
        lines = city_lines([result], [row], _context(bundle), f"building {result.building_id}")
        texts |= {
            ".obj": obj_text([result], bundle.reference),
            ".city.jsonl": "".join(f"{line}\n" for line in lines),
        }
    written = []
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        for suffix, text in texts.items():
            path = Path(folder, result.building_id + suffix)
            path.write_text(text, encoding="utf-8")
            written.append(path)
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {error.strerror or error}. Give another --out") from error
    return tuple(written)


def model_bundle(bundle: Bundle) -> BuildingResult:
    """The building of a bundle, modelled again; raises MemoryError where memory runs out."""
    from pipeline.recipe import reconstruct_building  # as above

    return reconstruct_building(bundle.candidate, bundle.method, bundle.settings)
