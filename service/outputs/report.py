"""The report of a run: request, inputs, results and failures, in a fixed order."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.model import Status
from pipeline.runtime.manifest_reading import city_unit_m
from service.outputs.catalogue import ResultsCrs
from service.wording import as_inputs

FORMAT = 1
"""Version of the report's layout."""


@dataclasses.dataclass(kw_only=True)
class Tally:
    """Counts made while the tables are merged."""

    buildings: int = 0
    statuses: Counter[str] = dataclasses.field(default_factory=Counter)
    roof_types: Counter[str] = dataclasses.field(default_factory=Counter)
    reasons: Counter[str] = dataclasses.field(default_factory=Counter)
    methods: Counter[str] = dataclasses.field(default_factory=Counter)
    lods: Counter[str] = dataclasses.field(default_factory=Counter)
    planes: int = 0
    rejected: int = 0
    rejected_reasons: Counter[str] = dataclasses.field(default_factory=Counter)
    modelled: int = 0
    """Buildings with a model."""
    without_geometry: int = 0
    """Buildings without an outline in the GeoJSON."""
    cut: int = 0
    """Buildings at the edge of the data."""

    def count_building(self, record: Mapping[str, Any], *, has_geometry: bool) -> None:
        """Count one row of the buildings table."""
        self.buildings += 1
        self.statuses[record["status"]] += 1
        self.roof_types[record["roof_type"]] += 1
        self.methods[record["method"]] += 1
        if record["reason"] is not None:
            self.reasons[record["reason"]] += 1
        if record["lod"] is not None:
            self.lods[record["lod"]] += 1
            self.modelled += 1
        self.without_geometry += not has_geometry
        self.cut += bool(record["touches_data_edge"])

    def count_rejected(self, reasons: Sequence[str]) -> None:
        """Count rows of the rejected table."""
        self.rejected += len(reasons)
        self.rejected_reasons.update(reasons)


def report(
    manifest: Mapping[str, Any], tally: Tally, crs: ResultsCrs, failed_tiles: Mapping[str, str], run_dir: Path
) -> dict[str, Any]:
    """The report as plain JSON values, without paths of the server.

    Parameters
    ----------
    manifest : mapping
        The content of `run.json`.
    tally : Tally
        Counts of the merged tables.
    crs : ResultsCrs
        The CRS of the results.
    failed_tiles : mapping of str
        The error of each tile that could not be published.
    run_dir : Path
        The run directory; its name is removed.
    """
    clean = cleaner([entry["path"] for entry in manifest["inputs"]], run_dir)
    inputs = [{"name": Path(entry["path"]).name, **_without(entry, "path")} for entry in manifest["inputs"]]
    facts = manifest.get("crs") or {}
    return {
        "format": FORMAT,
        "status": manifest["status"],
        "engine_version": manifest["engine_version"],
        "method": manifest["method"],
        "started_at": manifest["started_at"],
        "finished_at": manifest["finished_at"],
        "inputs": inputs,
        "source_licence": manifest.get("source_licence"),
        "crs": {
            **{name: facts.get(name) for name in ("name", "epsg", "horizontal_unit_m", "vertical_unit_m", "wkt")},
            "cityjson_vertical_unit_m": city_unit_m(facts),
            "uri": crs.uri,
            "to_wgs84": crs.to_wgs84,
            "to_wgs84_accuracy_m": crs.accuracy_m,
        },
        "buildings": {
            "candidates": tally.buildings,
            "by_status": {status.value: tally.statuses[status.value] for status in Status},
            "by_reason": _sorted(tally.reasons),
            "by_roof_type": _sorted(tally.roof_types),
            "by_lod": _sorted(tally.lods),
            "by_method": _sorted(tally.methods),
            "roof_planes": tally.planes,
            "without_footprint": tally.without_geometry,
            "at_the_edge_of_the_data": tally.cut,
        },
        "rejected": {"objects": tally.rejected, "by_reason": _sorted(tally.rejected_reasons)},
        "tiles": {
            "planned": len(manifest["tiles"]) + len(set(failed_tiles) - set(manifest["tiles"])),
            "failed": [{"tile": tile, "reason": clean(why)} for tile, why in sorted(failed_tiles.items())],
            "without_points": list(manifest.get("tiles_without_points", ())),
            "without_terrain": list(manifest.get("tiles_without_terrain", ())),
        },
        "counts": dict(manifest["counts"]),
        "headline": clean(manifest.get("headline", "")),
        "warnings": [clean(warning) for warning in manifest["warnings"]],
        "timings_s": dict(manifest["timings_s"]),
        "largest_process_bytes": max(manifest["peak_memory_bytes"].values(), default=None),
        "settings": manifest["settings"],
        "settings_hash": manifest["settings_hash"],
        "content_sha256": manifest["content_sha256"],
    }


def report_bytes(found: Mapping[str, Any]) -> bytes:
    """A report as a file."""
    return (json.dumps(found, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def _sorted(counts: Counter[str]) -> dict[str, int]:
    """The counts, largest first."""
    return dict(sorted(counts.items(), key=lambda entry: (-entry[1], entry[0])))


def _without(entry: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != name}


def cleaner(paths: Sequence[str], run_dir: Path) -> Callable[[str], str]:
    """A function that removes the server's folders from a text, where only file names remain, and names inputs."""
    folders = {str(Path(path).parent) for path in paths} | {str(run_dir), str(run_dir.resolve())}
    # longest first: otherwise the end of a subfolder would remain
    ordered = sorted((folder for folder in folders if folder not in ("/", ".")), key=len, reverse=True)

    def clean(text: str) -> str:
        for folder in ordered:
            text = text.replace(f"{folder}/", "").replace(folder, "the run")
        return as_inputs(text)

    return clean
