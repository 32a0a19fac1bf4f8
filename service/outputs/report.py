"""The report of a run: request, inputs, results and failures, in a fixed order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.model import Status
from pipeline.runtime.manifest_reading import city_unit_m
from service.features.index import RowIndex
from service.outputs.catalogue import ResultsCrs
from service.wording import as_inputs

FORMAT = 1
"""Version of the report's layout."""


def report(
    manifest: Mapping[str, Any], index: RowIndex, crs: ResultsCrs, failed_tiles: Mapping[str, str], run_dir: Path
) -> dict[str, Any]:
    """The report as plain JSON values, without paths of the server.

    Parameters
    ----------
    manifest : mapping
        The content of `run.json`.
    index : RowIndex
        The rows of the tables, which are counted.
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
    shown = "degrees" if crs.is_known else "geometry"
    statuses = _counts(index, "buildings", "status")
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
            "candidates": index.totals("buildings").n,
            "by_status": {status.value: statuses.get(status.value, 0) for status in Status},
            "by_reason": _counts(index, "buildings", "reason"),
            "by_roof_type": _counts(index, "buildings", "roof_type"),
            "by_lod": _counts(index, "buildings", "lod"),
            "by_method": _counts(index, "buildings", "method"),
            "roof_planes": index.totals("planes").n,
            "without_footprint": index.figure(f"SELECT count(*) FROM buildings WHERE {shown} IS NULL"),  # noqa: S608
            "at_the_edge_of_the_data": _counts(index, "buildings", "touches_data_edge").get(1, 0),
        },
        "rejected": {"objects": index.totals("rejected").n, "by_reason": _counts(index, "rejected", "reason")},
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


def _counts(index: RowIndex, table: str, column: str) -> dict[Any, int]:
    """How many rows have each value, the most frequent first; null is not counted."""
    with index.opened() as connection:
        query = f"SELECT {column}, count(*) FROM {table} WHERE {column} IS NOT NULL GROUP BY 1 ORDER BY 2 DESC, 1"  # noqa: S608
        return dict(connection.execute(query).fetchall())


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
