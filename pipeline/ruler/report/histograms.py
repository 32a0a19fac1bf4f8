"""The charts of an evaluation: residuals, agreement of footprints and faces, completeness by size and slope."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from markupsafe import Markup

from pipeline.model import BoolArray, FloatArray
from pipeline.ruler.evaluation.counted_models import flags, floats, visible_share
from pipeline.ruler.report.svg_chart import Axis, Ordinate, category_svg, histogram_svg, rebinned

GOOD_M = 0.2
"""Marked distance in charts: points within it count as right."""
_MIN_SHARE = 1e-5
"""Lower end of logarithmic axes."""
_FACE_AREAS_M2 = (0.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, math.inf)
_MIN_FACE_M2 = 10.0
_SLOPES_DEG = (0.0, 7.0, 20.0, 30.0, 40.0, 50.0, 90.0)


class Chart(NamedTuple):
    """A chart with its words; `svg` is an inline SVG."""

    title: str
    svg: Markup
    caption: str


def charts(tables: Mapping[str, pa.Table]) -> list[Chart]:
    """The charts of the tables, in the order of the page, without buildings at the edge of the data."""
    made = [_residuals(tables["residual_histogram"])] if "residual_histogram" in tables else []
    cut: set[str] = set()
    if "buildings" in tables:
        buildings = tables["buildings"]
        if "touches_data_edge" in buildings.column_names:
            is_cut = buildings["touches_data_edge"].to_pylist()
            cut = {name for name, at_edge in zip(buildings["building_id"].to_pylist(), is_cut, strict=True) if at_edge}
            buildings = buildings.filter(pa.array([not at_edge for at_edge in is_cut], pa.bool_()))
        made += _of_buildings(buildings)
    if "true_faces" in tables:
        faces = tables["true_faces"]
        if cut:
            faces = faces.filter(pa.array([name not in cut for name in faces["building_id"].to_pylist()], pa.bool_()))
        made += _of_faces(faces)
    return [chart for chart in made if chart is not None]


def _percent(value: float) -> str:
    """A share as a short text, also a very small one."""
    return f"{100.0 * value:.3g} %"


def _residuals(table: pa.Table) -> Chart | None:
    """Shares of points by vertical distance, on a logarithmic axis."""
    low, high = floats(table, "low_m"), floats(table, "high_m")
    counts = floats(table, "count")
    if not counts.sum():
        return None
    order = np.argsort(low)
    low, high = low[order], high[order]
    signed = bool(low[0] < 0.0)
    edges = np.linspace(-1.5, 1.5, 61) if signed else np.linspace(0.0, 1.5, 31)
    all_points = rebinned(low, high, counts[order], edges) / counts.sum()
    top = floats(table, "count_top")[order] if "count_top" in table.column_names else np.zeros(len(low))
    steps = rebinned(low, high, top, edges) / top.sum() if top.sum() else None
    is_near = (low >= -GOOD_M - 1e-9) & (high <= GOOD_M + 1e-9)
    within = counts[order][is_near].sum() / counts.sum()
    words = "signed, model below the points is positive" if signed else "absolute"
    return Chart(
        title="Vertical distance of points to the models",
        svg=histogram_svg(
            edges,
            all_points,
            x=Axis(name="distance, m", text=lambda value: f"{value:g}"),
            y=Axis(name="share of points (log)", text=_percent),
            ordinate=Ordinate(low=_MIN_SHARE, high=1.0, log=True),
            description=f"Histogram of the vertical distances of {counts.sum():,.0f} points, "
            f"{100.0 * within:.1f} % of them within {GOOD_M:g} m.",
            steps=steps,
            marks=(-GOOD_M, GOOD_M),
        ),
        caption=f"{counts.sum():,.0f} points that have a roof; {words}; the outermost bars include all values beyond. "
        + ("Line: points that are visible from above. " if steps is not None else "")
        + f"Dashed: {GOOD_M:g} m.",
    )


def _plain(
    values: FloatArray,
    edges: FloatArray,
    *,
    title: str,
    x_name: str,
    what: str,
    percent: bool = False,
    marks: tuple[float, ...] = (),
    caption: str = "",
) -> Chart | None:
    """A histogram of counts; values beyond the edges go to the outermost bins."""
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    heights = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].astype(np.float64)
    middle = float(np.median(values))
    median = f"{100.0 * middle:.1f} %" if percent else f"{middle:.3f}"
    return Chart(
        title=title,
        svg=histogram_svg(
            edges,
            heights,
            x=Axis(name=x_name, text=(lambda v: f"{100.0 * v:.0f} %") if percent else (lambda v: f"{v:g}")),
            y=Axis(name=what, text=lambda value: f"{value:,.0f}"),
            ordinate=Ordinate(low=0.0, high=max(1.0, float(heights.max())) * 1.05, log=False),
            description=f"Histogram of {title.lower()}: {len(values):,} {what}, median {median}.",
            marks=marks,
        ),
        caption=f"{len(values):,} {what}, median {median}. {caption}".strip(),
    )


def _of_buildings(table: pa.Table) -> list[Chart | None]:
    """Agreement building by building."""
    names = set(table.column_names)
    values = {name: _of_found(table, name) for name in ("iou", "area_bias") if name in names}
    if "surface_within" in names:
        values["surface_within"] = floats(table, "surface_within")
    if (shares := visible_share(table)) is not None:
        values["points_within"] = shares
    unit, bias = np.linspace(0.0, 1.0, 41), np.linspace(-0.5, 0.5, 41)
    visible = "share of the building's top-visible points"
    beyond = "The outermost bars include all values beyond."
    return [
        _plain(
            values[name],
            edges,
            title=title,
            x_name=x_name,
            what="buildings",
            caption=words,
            percent=name != "iou",
            marks=(0.0,) if name == "area_bias" else (),
        )
        for name, edges, title, x_name, words in (
            (
                "points_within",
                unit,
                "Points within 0.2 m, by building",
                visible,
                "",
            ),
            ("surface_within", unit, "True roof within 0.2 m, by building", "share of the roof's area", ""),
            ("iou", unit, "Footprint IoU of found buildings", "intersection over union", "One to one."),
            ("area_bias", bias, "Area bias of footprints", "modelled over true area, minus 1", beyond),
        )
        if name in values
    ]


def _of_found(table: pa.Table, name: str) -> FloatArray:
    """A column over the buildings that were found."""
    values = floats(table, name)
    if "model_id" in table.column_names:
        values = values[table["model_id"].is_valid().to_numpy()]
    return values


def _of_faces(table: pa.Table) -> list[Chart | None]:
    """Agreement of found faces, and completeness by class."""
    names = set(table.column_names)
    found = flags(table, "found")
    made: list[Chart | None] = []
    for name, edges, title, x_name, marks in (
        ("angle_deg", np.linspace(0.0, 10.0, 41), "Angle to the true face", "degrees", ()),
        ("offset_m", np.linspace(-0.3, 0.3, 49), "Offset of found faces", "m", (0.0,)),
    ):
        if name in names:
            values = floats(table, name)[found]
            unsigned = bool(np.isfinite(values).any() and np.nanmin(values) >= 0.0)
            shown = edges[edges >= -1e-12] if unsigned else edges
            made.append(_plain(values, shown, title=title, x_name=x_name, what="found faces", marks=marks))
    areas = floats(table, "area_m2")
    counted = areas >= _MIN_FACE_M2
    if "to_be_found" in names:
        counted = flags(table, "to_be_found")
    classed = counted | (areas < _MIN_FACE_M2)
    title, x_name = "Faces found, by area", "area of the true face, m²"
    made.append(_completeness(areas[classed], found[classed], _FACE_AREAS_M2, title, x_name, True))
    if "slope_deg" in names:
        slopes = floats(table, "slope_deg")
        title, x_name = "Faces found, by slope", "slope of the true face, degrees"
        made.append(_completeness(slopes[counted], found[counted], _SLOPES_DEG, title, x_name, False))
    return made


def _completeness(
    values: FloatArray, found: BoolArray, borders: tuple[float, ...], title: str, x_name: str, by_area: bool
) -> Chart | None:
    """Shares of found faces, by classes of `values`."""
    if len(values) == 0:
        return None
    bins = list(itertools.pairwise(borders))
    within = [found[(values >= low) & (values < high)] for low, high in bins]
    names = [f"{low:g}-{high:g}" if math.isfinite(high) else f"> {low:g}" for low, high in bins]
    counts, shares = [len(one) for one in within], [float(one.mean()) if len(one) else math.nan for one in within]
    pale = [by_area and high <= _MIN_FACE_M2 for _, high in bins]
    classes = "; ".join(
        f"{name}: {100.0 * share:.0f} % of {count:,}"
        for name, share, count in zip(names, shares, counts, strict=True)
        if count
    )
    caption = "Over the bars: true faces. "
    caption += (
        "Pale: too small to be required; too sparse ones are left out." if by_area else "Only faces that must be found."
    )
    return Chart(
        title=title,
        svg=category_svg(
            names,
            np.array(shares),
            counts,
            x_name=x_name,
            y_name="share found",
            description=f"{title}. {classes}.",
            pale=pale,
        ),
        caption=caption,
    )
