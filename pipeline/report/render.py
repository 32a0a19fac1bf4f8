"""A picture of a run: the map of its roof faces, and a bird's-eye view of its models where they stand densest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.io import arrow_at
from pipeline.model import RoofType, Status
from pipeline.report.maps import round_length
from pipeline.report.palette import ROOF_COLOURS
from pipeline.report.perspective import MAP_SUN, View, ViewedFace, draw_view, lambert, shaded
from pipeline.report.pictures import paths_of, plan_rings
from pipeline.report.statistics import run_statistics
from pipeline.runtime.manifest import NAME
from pipeline.runtime.manifest_reading import read_manifest

WALL_COLOUR = "#f1ece1"
FAILED_COLOUR = "#c22032"
HATCHES = {
    Status.DOUBTFUL: ("....", "#333333"),
    Status.FALLBACK: ("////", "#333333"),
    Status.FAILED: ("xxxx", FAILED_COLOUR),
}
"""Hatch and colour of outlines that are not `ok`."""
VIEW_SIDE_M = 180.0
"""Side of the square in the bird's-eye view: the one with the most roof faces."""
WHOLE_BELOW_M = 260.0
"""Up to this width and length, the view shows the whole run."""
Window = tuple[float, float, float, float]
"""West, south, east, north."""
NO_WINDOW: Window = (0.0, 0.0, 0.0, 0.0)
"""The window of a run without roof faces."""
_SURFACE_KINDS = {"RoofSurface", "WallSurface"}


def render_run(
    run_dir: str | Path,
    png_path: str | Path,
    truth: str | Path | None = None,
    filesystem: pafs.FileSystem | None = None,
    dpi: int = 120,
) -> None:
    """Draw a finished run to a PNG file.

    Roof faces have the colour of their roof type, lit from the north-west; fallbacks are hatched, failed candidates
    hatched in red, rejected objects thin grey outlines. Footprints of a local run directory of true models are dashed
    lines. The run directory is a path or URL, or a path of `filesystem`. Raises RunError if it has no run, or the
    picture cannot be written.
    """
    filesystem, run = arrow_at(run_dir) if filesystem is None else (filesystem, str(run_dir))
    buildings = read_table(run, "buildings", filesystem)
    planes = read_table(run, "planes", filesystem)
    rejected = read_table(run, "rejected", filesystem)
    outlines = None if truth is None else _geometries(read_table(str(truth), "buildings"))
    units = _units(run, filesystem)
    figure = Figure(figsize=(20.0, 10.5), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    plan, view = figure.subplots(1, 2, gridspec_kw={"width_ratios": [0.85, 1.0], "wspace": 0.02})
    figure.subplots_adjust(left=0.01, right=0.99, top=0.94, bottom=0.06)
    window, is_part = view_window(_geometries(planes), units[0])
    _draw_map(plan, buildings, planes, rejected, outlines)
    _draw_scale_bar(plan, units[0])
    if is_part:
        _draw_window(plan, window)
    if window != NO_WINDOW:
        inside = shapely.intersects(shapely.centroid(_geometries(buildings)), shapely.box(*window))
        rows = buildings.filter(pa.array(inside)).select(["roof_type", "solid", "solid_surfaces"]).to_pylist()
        models = [faces for row in rows if (faces := solid_faces(row, units))]
        if models:
            draw_view(view, models, View(), origin=np.array([window[0] * units[0], window[1] * units[0], 0.0]))
    view.set_axis_off()
    statistics = run_statistics(run, filesystem)
    figure.suptitle(_title(statistics, buildings), fontsize=15, x=0.01, ha="left")
    figure.legend(handles=_legend(statistics, outlines is not None), loc="lower center", ncols=12, frameon=False)
    try:
        figure.savefig(png_path, format="png")
    except OSError as error:
        raise RunError(f"{png_path} cannot be written: {error.strerror or error}") from error


def _geometries(table: pa.Table) -> Any:
    """The geometries of a table as an array, with None for null."""
    return shapely.from_wkb(np.array(table["geometry"].to_pylist(), dtype=object))


def _units(run_dir: str, filesystem: pafs.FileSystem) -> tuple[float, float]:
    """Metres per horizontal and per vertical unit; 1 for simulated truth, which has no manifest."""
    held = filesystem.get_file_info(f"{run_dir.rstrip('/')}/{NAME}")
    crs = {} if held.type == pafs.FileType.NotFound else read_manifest(run_dir, filesystem).crs or {}
    return float(crs.get("horizontal_unit_m", 1.0)), float(crs.get("vertical_unit_m", 1.0))


def view_window(faces: Any, unit_m: float) -> tuple[Window, bool]:
    """The window of a bird's-eye view in the units of an array of roof faces, and whether it is smaller than the whole.

    The square with the most roof faces is found on a lattice of half its side; the first of equal ones wins.
    """
    present = faces[~shapely.is_missing(faces)]
    if len(present) == 0:
        return NO_WINDOW, False
    west, south, east, north = (float(v) for v in shapely.total_bounds(present))
    if max(east - west, north - south) <= WHOLE_BELOW_M / unit_m:
        return (west, south, east, north), False
    side = VIEW_SIDE_M / unit_m
    cell = np.floor((shapely.get_coordinates(shapely.centroid(present)) - [west, south]) / (side / 2.0)).astype(int)
    counts = np.zeros(cell.max(axis=0) + 2, dtype=np.int64)
    np.add.at(counts, (cell[:, 0], cell[:, 1]), 1)
    pooled = counts[:-1, :-1] + counts[1:, :-1] + counts[:-1, 1:] + counts[1:, 1:]
    column, row = np.unravel_index(int(np.argmax(pooled)), pooled.shape)
    left = max(west, min(west + float(column) * side / 2.0, east - side))
    bottom = max(south, min(south + float(row) * side / 2.0, north - side))
    return (left, bottom, left + side, bottom + side), True


def _draw_map(axes: Axes, buildings: pa.Table, planes: pa.Table, rejected: pa.Table, truth: Any) -> None:
    """Roof faces, outlines, failed candidates and rejected objects."""
    kinds = dict(zip(buildings["building_id"].to_pylist(), buildings["roof_type"].to_pylist(), strict=True))
    fills = []
    for building_id, slope, aspect in zip(
        *(planes[name].to_pylist() for name in ("building_id", "slope_deg", "aspect_deg")), strict=True
    ):
        tilt, turn = math.radians(slope), math.radians(aspect)
        light = lambert((math.sin(tilt) * math.sin(turn), math.sin(tilt) * math.cos(turn), math.cos(tilt)), MAP_SUN)
        fills.append(shaded(ROOF_COLOURS[RoofType(kinds[building_id])], light))
    faces = paths_of(_geometries(planes))
    axes.add_collection(PathCollection(faces, facecolors=fills, edgecolors="#55504a", linewidths=0.25))
    _draw_outlines(axes, _geometries(rejected), color="#9a9a9a", linewidths=0.5)
    footprints = _geometries(buildings)
    _draw_outlines(axes, footprints, color="#2b2b2b", linewidths=0.6)
    statuses = np.array(buildings["status"].to_pylist(), dtype=object)
    for status, (hatch, colour) in HATCHES.items():
        hatched = footprints[(statuses == status) & ~shapely.is_missing(footprints)]
        if len(hatched):
            marked = PathCollection(paths_of(hatched), facecolors="none", edgecolors=colour, linewidths=0.9)
            marked.set_hatch(hatch)
            axes.add_collection(marked)
    if truth is not None:
        _draw_outlines(axes, truth, color="#0050a0", linewidths=1.4, linestyles=(0, (4, 2)))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color("#cccccc")


def _draw_outlines(axes: Axes, geometries: Any, **style: Any) -> None:
    """The rings of polygons as lines."""
    axes.add_collection(LineCollection([ring for one in geometries for ring in plan_rings(one)], **style))


def _draw_scale_bar(axes: Axes, unit_m: float) -> None:
    """A bar of a round number of metres, about a fifth of the map's width, in its lower left corner."""
    west, east = axes.get_xlim()
    south, north = axes.get_ylim()
    length_m = round_length((east - west) * unit_m / 5.0)
    x, y = west + 0.02 * (east - west), south + 0.02 * (north - south)
    height = 0.006 * (north - south)
    axes.add_patch(Rectangle((x, y), length_m / unit_m, height, color="#222222", zorder=5))
    axes.text(x, y + 2.0 * height, f"{length_m:g} m", fontsize=11, color="#222222", zorder=5)


def _draw_window(axes: Axes, window: Window) -> None:
    """The square that the bird's-eye view shows."""
    west, south, east, north = window
    axes.add_patch(
        Rectangle((west, south), east - west, north - south, fill=False, edgecolor="#111111", linewidth=1.2, zorder=4)
    )


def solid_faces(row: Mapping[str, Any], units: tuple[float, float], roof_colour: str | None = None) -> list[ViewedFace]:
    """Roofs and walls of the solids of a row of the table `buildings`, in metres; by default by its roof type."""
    horizontal, vertical = units
    roof = roof_colour or ROOF_COLOURS[RoofType(row["roof_type"])]
    parts = [] if row["solid"] is None else shapely.get_parts(shapely.from_wkb(row["solid"])).tolist()
    return [
        ViewedFace(
            rings=tuple(
                shapely.get_coordinates(ring, include_z=True)[:-1] * [horizontal, horizontal, vertical]
                for ring in shapely.get_rings(part)
            ),
            colour=roof if kind == "RoofSurface" else WALL_COLOUR,
        )
        for part, kind in zip(parts, row["solid_surfaces"] or (), strict=True)
        if kind in _SURFACE_KINDS
    ]


def _title(statistics: dict[str, Any], buildings: pa.Table) -> str:
    """Counts and residuals in two lines."""
    statuses, rmse = statistics["statuses"], statistics["quantiles"]["rmse_m"]
    methods = ", ".join(sorted(set(buildings["method"].to_pylist()))) or "no method"
    noun = "candidate" if statistics["candidates"] == 1 else "candidates"
    title = f"{statistics['candidates']} {noun} by {methods}: " + ", ".join(f"{n} {s}" for s, n in statuses.items())
    if rmse["p50"] is None:
        return title
    coverage = statistics["quantiles"]["coverage"]["p50"]
    return f"{title}; rmse {rmse['p50']:.2f} m (median), {rmse['p90']:.2f} m (p90), coverage {coverage:.1%}"


def _legend(statistics: dict[str, Any], with_truth: bool) -> list[Any]:
    """Legend entries with counts."""
    entries: list[Any] = [
        Patch(facecolor=ROOF_COLOURS[RoofType(kind)], edgecolor="#55504a", label=f"{kind} {count}")
        for kind, count in statistics["roof_types"].items()
        if kind != RoofType.NONE
    ]
    statuses = statistics["statuses"]
    for status, (hatch, colour) in HATCHES.items():
        label = f"{status.value} {statuses[status.value]}"
        entries.append(Patch(facecolor="none", edgecolor=colour, hatch=hatch, label=label))
    entries.append(Line2D([], [], color="#9a9a9a", linewidth=1.0, label=f"rejected {statistics['rejected']}"))
    if with_truth:
        entries.append(Line2D([], [], color="#0050a0", linestyle=(0, (4, 2)), label="truth"))
    return entries
