"""A finished run as one HTML file: outcome, map, failures by reason, slowest buildings, time, memory, inputs."""

from __future__ import annotations

import datetime as dt
import heapq
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import table_dataset
from pipeline.io import arrow_at, storage_at
from pipeline.model import Reason, Status
from pipeline.reasons import REASONS
from pipeline.report.class_map import MAX_DRAWN, ROWS, ClassMap
from pipeline.report.maps import BAD, DOUBTFUL, FAIR, GOOD, MISSING, NO_FIGURE, Entry
from pipeline.report.page_template import page_template
from pipeline.report.pictures import data_uri
from pipeline.report.statistics import QUANTILES, run_statistics
from pipeline.runtime.manifest import NAME, PAGE, RunManifest, RunStatus
from pipeline.runtime.manifest_reading import read_manifest

LISTED = 500
"""Largest number of buildings without a roof model in the list of the page: those without any model first, then the
largest. All of them are in the table `buildings`."""
INPUTS, PROCESSES = 200, 20
"""Largest numbers of inputs and processes on the page; `run.json` has all."""
_EXAMPLES = 3
_DIGITS = 12
_FAILED_TILE = "failed tile"
_REJECTED, _REUSED = "#9aa3ab", "#46586a"
_COLUMNS = (
    *("building_id", "source_id", "status", "reason", "reason_detail", "roof_type", "geometry"),
    *("footprint_area_m2", "n_points", "n_planes", "tile"),
)
_FIGURES = {
    "rmse_m": "RMSE of the roof returns, m",
    "p95_m": "95 % of the roof returns within, m",
    "share_within_0_2m": "share of the roof returns within 0.2 m",
    "share_below_roof": "share of points on facades and below the roof",
    "coverage": "share of the roof returns with a roof",
    "density_per_m2": "points per m²",
    "height_m": "height, m",
}
_STATUSES = {
    Status.OK: ("models", GOOD, "closed, valid solids with a roof that their points support"),
    Status.DOUBTFUL: ("doubtful models", DOUBTFUL, "closed, valid solids that their points do not support"),
    Status.FALLBACK: ("blocks", FAIR, "the roof could not be delivered, a block stands in its place"),
    Status.FAILED: ("no model", MISSING, "the record and its reason remain"),
}


def write_run_page(run_dir: str) -> str:
    """Write `run.html` with its images, styles and scripts into a run directory, a path or URL; returns its place.

    Raises RunError if the run is not finished or the page cannot be written.
    """
    storage = storage_at(run_dir)
    storage.put(PAGE, run_page(run_dir).encode())
    return f"{storage.place}/{PAGE}"


def run_page(run_dir: str) -> str:
    """The page as text; raises RunError if the run is not finished."""
    manifest = read_manifest(run_dir)
    if manifest.status not in {RunStatus.FINISHED, RunStatus.INCOMPLETE}:
        raise RunError(f"{run_dir} is {manifest.status.value}: a report needs a run that ended, run it to its end")
    seen = _Seen({one.building_id for one in manifest.slowest})
    filesystem, path = arrow_at(run_dir)
    dataset = table_dataset(path, "buildings", filesystem)
    try:
        for batch in dataset.to_batches(columns=list(_COLUMNS)):
            seen.add(pa.Table.from_batches([batch]))
        statistics = run_statistics(path, filesystem)
    except (pa.ArrowInvalid, OSError) as error:
        raise RunError(f"the tables of {run_dir} cannot be read as Parquet: {error}") from error
    seen.map.add(_failed_tiles(manifest))
    drawn = seen.map.map(_unit_m(manifest))
    return page_template("run.html").render(
        run=manifest,
        subject=_subject(run_dir, manifest),
        cards=_cards(manifest, statistics),
        map=None if drawn is None else {"uri": data_uri(drawn.png), "it": drawn},
        left_out=seen.map.left_out,
        max_drawn=MAX_DRAWN,
        without_outline=seen.without_outline,
        reasons=_reasons(statistics, seen),
        listed=seen.listed(),
        not_ok=statistics["candidates"] - statistics["statuses"][Status.OK.value],
        slowest=[_slow(one.building_id, one.seconds, seen.slow.get(one.building_id)) for one in manifest.slowest],
        stages=_stages(manifest),
        peaks=_peaks(manifest)[:PROCESSES],
        processes=len(manifest.peak_memory_bytes),
        statistics=statistics,
        quantiles=[(label, statistics["quantiles"][name]) for name, label in _FIGURES.items()],
        quantile_names=[name for name, _ in QUANTILES],
        rejected=[(reason, _meaning(reason), n) for reason, n in statistics["rejected_reasons"].items()],
        inputs=manifest.inputs[:INPUTS],
        digits=_DIGITS,
        nothing=NO_FIGURE,
        manifest_name=NAME,
    )


class _Seen:
    """The rows of all buildings for the page, part by part."""

    def __init__(self, slow: set[str]) -> None:
        kinds = {one.value: Entry(label, colour) for one, (label, colour, _) in _STATUSES.items()}
        tiles = Entry("tile that could not be published", BAD, hatched=True)
        self.map = ClassMap(
            "Buildings by status", {Status.OK.value: kinds[Status.OK.value], _FAILED_TILE: tiles} | kinds
        )
        self.slow: dict[str, Mapping[str, Any]] = {}
        """Rows of the slowest buildings by id."""
        self.examples: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
        """A few ids by status and reason, the first by name."""
        self.without_outline = 0
        """Buildings that are on no map."""
        self._slow = pa.array(sorted(slow), pa.string())
        self._not_ok: list[tuple[bool, float, str, Mapping[str, Any]]] = []

    def add(self, rows: pa.Table) -> None:
        """Add a part."""
        area = pc.fill_null(rows["footprint_area_m2"], 0.0)
        columns = [rows["status"], rows["geometry"], area, rows["building_id"]]
        self.map.add(pa.table(columns, names=ROWS.names).cast(ROWS))
        self.without_outline += rows["geometry"].null_count
        for row in rows.filter(pc.is_in(rows["building_id"], self._slow)).to_pylist():
            self.slow[row["building_id"]] = row
        for row in rows.filter(pc.not_equal(rows["status"], Status.OK.value)).to_pylist():
            known = row["status"], row["reason"]
            self.examples[known] = heapq.nsmallest(_EXAMPLES, (*self.examples[known], row["building_id"]))
            failed = row["status"] == Status.FAILED.value
            self._not_ok.append((failed, row["footprint_area_m2"] or 0.0, row["building_id"], row))
        if len(self._not_ok) > 2 * LISTED:
            self._not_ok = self._first()

    def _first(self) -> list[tuple[bool, float, str, Mapping[str, Any]]]:
        return heapq.nsmallest(LISTED, self._not_ok, key=lambda one: (not one[0], -one[1], one[2]))

    def listed(self) -> list[dict[str, Any]]:
        """The listed rows of buildings without a roof model."""
        return [_line(row) for *_, row in self._first()]


def _line(row: Mapping[str, Any]) -> dict[str, Any]:
    """A building as a line of a table."""
    place = None if row["geometry"] is None else shapely.point_on_surface(shapely.from_wkb(row["geometry"]))
    return {
        "id": row["building_id"],
        "source_id": row["source_id"] or "",
        "status": row["status"],
        "reason": row["reason"] or "",
        "detail": row["reason_detail"] or "",
        "roof_type": row["roof_type"],
        "area": row["footprint_area_m2"],
        "points": row["n_points"],
        "planes": row["n_planes"],
        "tile": row["tile"],
        "place": "" if place is None or place.is_empty else f"{place.x:.0f} {place.y:.0f}",
    }


def _slow(building_id: str, seconds: float, row: Mapping[str, Any] | None) -> dict[str, Any]:
    """A slow building; one in a failed tile has no row."""
    known = {"id": building_id} if row is None else _line(row)
    return known | {"seconds": seconds, "is_there": row is not None}


def _failed_tiles(manifest: RunManifest) -> pa.Table:
    """The squares of tiles whose buildings are not in the tables, in the CRS's units."""
    unit_m = _unit_m(manifest)
    squares = shapely.transform(np.array(manifest.squares(manifest.failed_tiles), object), lambda xy: xy / unit_m)
    n = len(squares)
    rows = [[_FAILED_TILE] * n, list(shapely.to_wkb(squares)), [np.inf] * n, list(manifest.failed_tiles)[:n]]
    return pa.table(rows, schema=ROWS)


def _unit_m(manifest: RunManifest) -> float:
    """Metres per unit of the geometries."""
    return float((manifest.crs or {}).get("horizontal_unit_m") or 1.0)


def _subject(run_dir: str, manifest: RunManifest) -> str:
    """The subject, in a sentence."""
    took = "" if manifest.finished_at is None else f", in {_length(manifest.finished_at - manifest.started_at)}"
    points = manifest.counts.get("points", 0)
    return (
        f"{run_dir}: {points / 1e6:,.1f} million points in {len(manifest.tiles):,} tiles, "
        f"begun {manifest.started_at:%Y-%m-%d %H:%M %Z}{took}."
    )


def _length(time: dt.timedelta) -> str:
    """A length of time in words.

    >>> _length(dt.timedelta(seconds=42)), _length(dt.timedelta(hours=27, minutes=4))
    ('42 s', '27 h 4 min')
    """
    minutes = round(time.total_seconds() / 60.0)
    if minutes < 2:
        return f"{time.total_seconds():.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _cards(manifest: RunManifest, statistics: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """The main figures: number, name, colour, meaning."""
    cards = []
    for status, (name, colour, meaning) in _STATUSES.items():
        share = statistics["shares"][status.value]
        text = meaning if share is None else f"{share:.1%} of all; {meaning}"
        cards.append((f"{statistics['statuses'][status.value]:,}", name, colour, text))
    cards.append((f"{statistics['rejected']:,}", "rejected", _REJECTED, "objects that were rejected as buildings"))
    reused = manifest.counts.get("reused", 0)
    if reused:
        cards.append((f"{reused:,}", "taken over", _REUSED, "models of an earlier run whose input did not change"))
    return cards


def _meaning(reason: str) -> str:
    """The meaning of a reason; empty for one of a later version."""
    return REASONS[Reason(reason)].meaning if reason in set(Reason) else ""


def _reasons(statistics: Mapping[str, Any], seen: _Seen) -> list[tuple[str, str, str, int, str, list[str]]]:
    """Status, reason, meaning, count, share of all candidates, a few ids; those without a model first."""
    found = []
    for status in (one.value for one in reversed(Status) if one is not Status.OK):
        for reason, count in statistics["reasons"].get(status, {}).items():
            share = f"{count / statistics['candidates']:.2%}"
            found.append((status, reason, _meaning(reason), count, share, sorted(seen.examples[status, reason])))
    return found


def _peaks(manifest: RunManifest) -> list[tuple[str, int]]:
    """Processes with their largest memory, the largest first."""
    return sorted(manifest.peak_memory_bytes.items(), key=lambda item: (-item[1], item[0]))


def _stages(manifest: RunManifest) -> list[tuple[str, float, float]]:
    """Seconds of the stages in the order in which they ran, each with its share of the longest one."""
    seconds = {name: value for name, value in manifest.timings_s.items() if name != "total"}
    most = max(seconds.values(), default=0.0) or 1.0
    return [(name, value, value / most) for name, value in seconds.items()]
