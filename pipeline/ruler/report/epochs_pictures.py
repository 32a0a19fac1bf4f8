"""One change in pictures: its outlines in both epochs, and both models from one place at one scale."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection

from pipeline.model import FloatArray, RoofType
from pipeline.report.perspective import View, ViewedFace, draw_view, projected
from pipeline.report.pictures import blank, paths_of, png_of
from pipeline.report.render import ROOF_COLOURS, WALL_COLOUR
from pipeline.ruler.epochs.epoch import Epoch
from pipeline.ruler.epochs.records import Change
from pipeline.ruler.report.epochs_map import COLOURS

WIDTH_PX, HEIGHT_PX = 420, 320
"""Size of a picture."""
PER_CLASS = 3
"""Changes of each class that are drawn, the largest."""
OLD_LINE, NEW_LINE = "#c2401f", "#2f6fa8"
"""Outlines in plan."""
_CLASSES = (Change.NEW, Change.GONE, Change.RAISED, Change.LOWERED, Change.RESHAPED)
_COLUMNS = ("building_id", "geometry", "roof_type", "solid", "solid_surfaces")
_MARGIN = 0.06
_LENGTHS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A change that is drawn."""

    row: Mapping[str, Any]
    """Its row of the table."""
    plan: bytes
    """Outlines of both epochs."""
    scale_m: float
    """Length of the scale bar."""
    scale_share: float
    """Its share of the plan's width."""
    old: bytes | None
    """The model of the earlier epoch; None without one."""
    new: bytes | None
    """The model of the later epoch; None without one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Model:
    outline: Any
    faces: tuple[ViewedFace, ...]


def cases(largest: pa.Table, old: Epoch, new: Epoch) -> list[Case]:
    """The largest changes of each class with their pictures, class by class; rows are in descending order of size."""
    rows: list[dict[str, Any]] = []
    for change in _CLASSES:
        rows += largest.filter(pc.equal(largest["change"], change.value)).slice(0, PER_CLASS).to_pylist()
    before = _models(old, {name for row in rows for name in row["old_ids"]})
    after = _models(new, {name for row in rows for name in row["new_ids"]})
    return [
        _case(row, [before[name] for name in row["old_ids"]], [after[name] for name in row["new_ids"]]) for row in rows
    ]


def _models(epoch: Epoch, names: set[str]) -> dict[str, _Model]:
    """The models of some buildings, in metres, by name."""
    if not names:
        return {}
    chosen = pc.field("building_id").isin(pa.array(sorted(names), pa.string()))
    table = epoch.table.to_table(columns=list(_COLUMNS), filter=chosen)
    horizontal, vertical = epoch.reference.horizontal_unit_m, epoch.reference.vertical_unit_m
    found = {}
    for row in table.to_pylist():
        outline = shapely.transform(shapely.from_wkb(row["geometry"]), lambda xy: xy * horizontal)
        faces = []
        colour = ROOF_COLOURS[RoofType(row["roof_type"])]
        parts = [] if row["solid"] is None else shapely.get_parts(shapely.from_wkb(row["solid"])).tolist()
        for part, kind in zip(parts, row["solid_surfaces"] or (), strict=True):
            rings = tuple(
                shapely.get_coordinates(ring, include_z=True)[:-1] * [horizontal, horizontal, vertical]
                for ring in shapely.get_rings(part)
            )
            if kind != "GroundSurface":
                faces.append(ViewedFace(rings=rings, colour=colour if kind == "RoofSurface" else WALL_COLOUR))
        found[row["building_id"]] = _Model(outline=outline, faces=tuple(faces))
    return found


def _case(row: Mapping[str, Any], before: list[_Model], after: list[_Model]) -> Case:
    outlines = [one.outline for one in (*before, *after)]
    bounds = shapely.total_bounds(outlines)
    corners = [ring for one in (*before, *after) for face in one.faces for ring in face.rings]
    view = View()
    plan, width_m = _plan(row, before, after, bounds)
    origin = np.floor(np.concatenate(corners).min(axis=0)) if corners else np.zeros(3)
    screen = projected(np.concatenate(corners) - origin, view) if corners else np.zeros((1, 2))
    scale_m = max(length for length in _LENGTHS_M if length <= max(_LENGTHS_M[0], width_m / 3.0))
    return Case(
        row=row,
        plan=plan,
        scale_m=scale_m,
        scale_share=scale_m / width_m,
        old=_view(before, origin, screen, view),
        new=_view(after, origin, screen, view),
    )


def _plan(row: Mapping[str, Any], before: list[_Model], after: list[_Model], bounds: FloatArray) -> tuple[bytes, float]:
    """The outlines of both epochs, and the width of the picture in metres."""
    figure, axes = blank(WIDTH_PX, HEIGHT_PX)
    colour = COLOURS[Change(row["change"])]
    shape = [one.outline for one in (after or before)]
    axes.add_collection(PathCollection(paths_of(shape), facecolors=f"{colour}30", edgecolors="none"), autolim=False)
    for models, line, dashes in ((before, OLD_LINE, (0, (4, 2))), (after, NEW_LINE, "solid")):
        drawn = PathCollection(
            paths_of([one.outline for one in models]),
            facecolors="none",
            edgecolors=line,
            linewidths=1.6,
            linestyles=dashes,
        )
        axes.add_collection(drawn, autolim=False)
    width_m = _frame(axes, bounds[:2], bounds[2:])
    return png_of(figure), width_m


def _view(models: list[_Model], origin: FloatArray, screen: FloatArray, view: View) -> bytes | None:
    """The models of one epoch, in the frame of both."""
    faces = [
        [ViewedFace(rings=tuple(ring - origin for ring in face.rings), colour=face.colour) for face in model.faces]
        for model in models
        if model.faces
    ]
    if not faces:
        return None
    figure, axes = blank(WIDTH_PX, HEIGHT_PX)
    draw_view(axes, faces, view, shadows=False)
    _frame(axes, screen.min(axis=0), screen.max(axis=0))
    return png_of(figure)


def _frame(axes: Axes, low: FloatArray, high: FloatArray) -> float:
    """Set limits around a box with a margin, in the shape of the picture; its width."""
    size = np.maximum(high - low, 1.0) * (1.0 + 2.0 * _MARGIN)
    width = max(float(size[0]), float(size[1]) * WIDTH_PX / HEIGHT_PX)
    middle = (low + high) / 2.0
    axes.set_xlim(middle[0] - width / 2.0, middle[0] + width / 2.0)
    half = width * HEIGHT_PX / WIDTH_PX / 2.0
    axes.set_ylim(middle[1] - half, middle[1] + half)
    return width
