"""One change in pictures: its outlines in both epochs, and both models from one place at one scale."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from matplotlib.collections import PathCollection

from pipeline.report.perspective import ViewedFace
from pipeline.report.pictures import blank, paths_of, png_of, set_frame
from pipeline.report.render import solid_faces
from pipeline.ruler.epochs.change_records import Change
from pipeline.ruler.epochs.epoch import Epoch
from pipeline.ruler.report.epochs_map import COLOURS
from pipeline.ruler.report.model_pictures import corners_of, scale_bar, view_png

SIZE_PX = (420, 320)
"""Width and height of a picture."""
PER_CLASS = 3
"""Changes of each class that are drawn, the largest."""
OLD_LINE, NEW_LINE = "#c2401f", "#2f6fa8"
"""Outlines in plan."""
_CLASSES = (Change.NEW, Change.GONE, Change.RAISED, Change.LOWERED, Change.RESHAPED)
_COLUMNS = ("building_id", "geometry", "roof_type", "solid", "solid_surfaces")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A change that is drawn."""

    row: Mapping[str, Any]
    plan: bytes
    scale_m: float
    scale_share: float
    old: bytes | None
    """The model of the earlier epoch; None without one."""
    new: bytes | None
    """The model of the later epoch; None without one."""


class _Model(NamedTuple):
    outline: Any
    faces: list[ViewedFace]


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
    units = epoch.reference.horizontal_unit_m, epoch.reference.vertical_unit_m
    return {
        row["building_id"]: _Model(
            outline=shapely.transform(shapely.from_wkb(row["geometry"]), lambda xy: xy * units[0]),
            faces=solid_faces(row, units),
        )
        for row in epoch.table.to_table(columns=list(_COLUMNS), filter=chosen).to_pylist()
    }


def _case(row: Mapping[str, Any], before: Sequence[_Model], after: Sequence[_Model]) -> Case:
    faces = [[one.faces for one in models] for models in (before, after)]
    shown = corners_of([*faces[0], *faces[1]])
    figure, axes = blank(*SIZE_PX)
    colour = COLOURS[Change(row["change"])]
    filled = paths_of([one.outline for one in (after or before)])
    axes.add_collection(PathCollection(filled, facecolors=f"{colour}30", edgecolors="none"), autolim=False)
    for models, line, dashes in ((before, OLD_LINE, (0, (4, 2))), (after, NEW_LINE, "solid")):
        outlines = paths_of([one.outline for one in models])
        drawn = PathCollection(outlines, facecolors="none", edgecolors=line, linewidths=1.6, linestyles=dashes)
        axes.add_collection(drawn, autolim=False)
    bounds = shapely.total_bounds([one.outline for one in (*before, *after)])
    scale_m, share = scale_bar(set_frame(axes, np.reshape(bounds, (2, 2))))
    old, new = (view_png(models, shown, SIZE_PX) for models in faces)
    return Case(row=row, plan=png_of(figure), scale_m=scale_m, scale_share=share, old=old, new=new)
