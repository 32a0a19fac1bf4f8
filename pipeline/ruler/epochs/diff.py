"""From two run directories to the files of a comparison; `pipeline.ruler.report.epochs_page` writes the page."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.errors import RunError
from pipeline.io import is_url
from pipeline.io.storage import LocalStorage
from pipeline.ruler.epochs.agreement import check_agreement
from pipeline.ruler.epochs.change_summary import Summary
from pipeline.ruler.epochs.change_writing import GEOJSON, JSON, PARQUET, GeoJson, geojson_sink, parquet_sink
from pipeline.ruler.epochs.epoch import Epoch, open_epoch
from pipeline.ruler.epochs.epoch_comparison import OnPart, compare_epochs
from pipeline.ruler.epochs.epoch_settings import DiffSettings

FORMAT = 1
"""Version of `changes.json`."""
_LEVEL_SHARE = 0.5
"""Share of the least height change from which on a shift of all elevations gives a warning."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DiffRequest:
    """A comparison of two runs."""

    old: str
    """The run directory of the earlier epoch: a path or a URL."""
    new: str
    """The run directory of the later epoch."""
    out: str
    """The folder of the results, created if missing."""
    settings: DiffSettings = dataclasses.field(default_factory=DiffSettings)
    """The thresholds of a change."""
    geojson: GeoJson = "changed"
    """Which rows `changes.geojson` holds."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Diff:
    """The result of a comparison."""

    request: DiffRequest
    old: Epoch
    new: Epoch
    summary: Summary
    warnings: tuple[str, ...]
    """Warnings about the result, one sentence each."""
    written: tuple[Path, ...]

    def as_dict(self) -> dict[str, Any]:
        """The content of `changes.json`, without times and durations: the same runs give the same bytes."""
        return {
            "format": FORMAT,
            "old": _facts(self.old),
            "new": _facts(self.new),
            "settings": dataclasses.asdict(self.request.settings),
            "warnings": list(self.warnings),
            **self.summary.as_dict(),
        }


def refuse_run_as_out(out: str, runs: Sequence[str]) -> None:
    """Refuse to write into the folder of a run, by a RunError."""

    def whole(place: str) -> str:
        return place.rstrip("/") if is_url(place) else str(Path(place).resolve())

    if whole(out) in {whole(run) for run in runs}:
        raise RunError(f"{out} is one of the runs that are compared: give --out a folder of its own")


def _facts(epoch: Epoch) -> dict[str, Any]:
    manifest = epoch.manifest
    return {
        "run": epoch.run_dir,
        "status": manifest.status.value,
        "method": manifest.method,
        "settings_hash": manifest.settings_hash,
        "engine_version": manifest.engine_version,
        "content_sha256": manifest.content_sha256,
        "crs": epoch.reference.name,
        "buildings": len(epoch),
    }


def diff(
    request: DiffRequest,
    on_part: OnPart = lambda done, total: None,  # noqa: ARG005
    take_in: Sequence[Callable[[pa.Table], None]] = (),
) -> Diff:
    """Compare two runs and write `changes.parquet`, `changes.geojson` and `changes.json`.

    `take_in` are further consumers of the rows of every part, such as a map. Raises RunError if a directory has no run
    that ended, or the results cannot be written, and CrsError if the runs have different reference systems or units.
    """
    refuse_run_as_out(request.out, (request.old, request.new))
    storage = LocalStorage(root=Path(request.out))
    old = open_epoch("OLD", request.old)
    new = open_epoch("NEW", request.new)
    warnings = list(check_agreement(old, new))
    reference = new.reference if new.reference.wkt is not None else old.reference
    summary = Summary()
    keys = [PARQUET, GEOJSON]
    with contextlib.ExitStack() as sinks:
        takers = [summary.add, *take_in, sinks.enter_context(parquet_sink(storage, reference))]
        if request.geojson == "none" or reference.to_degrees is None:
            keys.remove(GEOJSON)
        else:
            takers.append(sinks.enter_context(geojson_sink(storage, reference, request.geojson)))
        for table in compare_epochs(old, new, request.settings, on_part):
            for take in takers:
                take(table)
    if GEOJSON not in keys:
        storage.path(GEOJSON).unlink(missing_ok=True)  # of an earlier comparison
        if request.geojson != "none":
            warnings.append(
                f"no {GEOJSON}: GeoJSON is in WGS 84 (RFC 7946), and the CRS of the runs is unknown or local"
            )
    level = summary.level
    min_m = request.settings.min_height_change_m
    shift_m = request.settings.vertical_shift_m
    if level.median_m is not None and abs(level.median_m) > _LEVEL_SHARE * min_m:
        warnings.append(
            f"unchanged roofs of NEW lie {level.median_m:+.3f} m off those of OLD (median of {level.count}): if the "
            f"surveys are that far apart, set vertical_shift_m to {shift_m + level.median_m:.3f}"
        )
    found = Diff(
        request=request,
        old=old,
        new=new,
        summary=summary,
        warnings=tuple(warnings),
        written=tuple(storage.path(key) for key in (*keys, JSON)),
    )
    text = json.dumps(found.as_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    storage.put(JSON, text.encode())
    return found
