"""Plots for detached buildings, each with free ground around it, packed in rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pipeline.model import FloatArray
from pipeline.ruler.simulation.envelope import RoofPart, envelope
from pipeline.ruler.simulation.roofs import ROOFS, BrokenForm, CurvedForm, RoofDimensions, RoofFaces, RoofShape
from pipeline.ruler.simulation.simulated_scene import (
    Building,
    Scene,
    Terrain,
    face_plane,
    place_building,
    turned,
    undulating_terrain,
)

OF_EACH = 4
"""Buildings of each form in a scene of all forms of a suite."""
_STRIP_M, _MARGIN_M = 150.0, 4.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plot:
    """The place of one building."""

    x: float
    """Easting of the middle of the building's main rectangle, scene frame."""
    y: float
    extent: tuple[float, float, float, float]
    """The plot: smallest x, smallest y, largest x, largest y."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedBuilding:
    """A building before it has a place."""

    shape: RoofShape
    dimensions: RoofDimensions
    azimuth_deg: float
    """Direction of the ridge, clockwise from north."""
    margin_m: float

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner (2,) of the turned roof's box about the middle of the main rectangle."""
        plan = turned(ROOFS[self.shape](self.dimensions).vertices[:, :2], 0.0, 0.0, self.azimuth_deg)
        return plan.min(axis=0), plan.max(axis=0)

    def built(self, building_id: str, plot: Plot, eave_height_m: float, terrain: Terrain) -> Building:
        """The building on its plot."""
        return place_building(
            building_id,
            self.shape,
            self.dimensions,
            at=(plot.x, plot.y),
            azimuth_deg=self.azimuth_deg,
            eave_height_m=eave_height_m,
            terrain=terrain,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedRoof:
    """A building with a roof of its own making before it has a place."""

    name: str
    shape: RoofShape | BrokenForm | CurvedForm
    roof: RoofFaces
    """About the middle of its box."""
    box: PlannedBuilding
    eave_height_m: float

    @classmethod
    def over(
        cls,
        parts: Sequence[RoofPart],
        name: str,
        *,
        azimuth_deg: float,
        eave_height_m: float,
        margin_m: float,
        shape: RoofShape | BrokenForm | CurvedForm = RoofShape.FLAT,
    ) -> PlannedRoof:
        """The envelope of convex parts in any frame."""
        roof = envelope(parts)
        low, high = roof.vertices.min(axis=0), roof.vertices.max(axis=0)
        middle: FloatArray = np.append((low + high)[:2] / 2, 0.0)
        size = RoofDimensions(length_m=float(high[0] - low[0]), width_m=float(high[1] - low[1]))
        box = PlannedBuilding(shape=RoofShape.FLAT, dimensions=size, azimuth_deg=azimuth_deg, margin_m=margin_m)
        moved = dataclasses.replace(roof, vertices=roof.vertices - middle)
        return cls(name=name, shape=shape, roof=moved, box=box, eave_height_m=eave_height_m)

    def built(self, plot: Plot, terrain: Terrain) -> Building:
        """The building on its plot: that of the box around it, with its own roof."""
        around = self.box.built(self.name, plot, self.eave_height_m, terrain)
        plan = turned(self.roof.vertices[:, :2], plot.x, plot.y, self.box.azimuth_deg)
        vertices = np.column_stack([plan, self.roof.vertices[:, 2] + around.eave_z_m])
        planes = tuple(face_plane(vertices[list(face[0])]) for face in self.roof.faces)
        faces, groups, shape = self.roof.faces, self.roof.groups, self.shape
        return dataclasses.replace(around, shape=shape, vertices=vertices, faces=faces, planes=planes, groups=groups)


def packed_plots(
    buildings: Sequence[PlannedBuilding], strip_width_m: float, strips: int, gap_m: float = 0.0
) -> tuple[list[Plot], tuple[float, float]]:
    """Pack plots in rows across parallel strips that run north; no plot crosses the border of two strips.

    Rows are filled in the order of the buildings; `gap_m` is kept free at both sides of a strip. Returns one plot per
    building, in their order, and the extent of all strips: east, north; whole metres. Raises ValueError if a plot is
    wider than a strip.
    """
    boxes = [building.bounds for building in buildings]
    sizes = [high - low + 2 * building.margin_m for (low, high), building in zip(boxes, buildings, strict=True)]
    room = strip_width_m - 2 * gap_m
    rows: list[list[int]] = [[]]
    filled = 0.0
    for number, size in enumerate(sizes):
        if size[0] > room:
            raise ValueError(f"a plot {size[0]:.1f} m wide does not fit a strip of {room:g} m")
        if filled + size[0] > room:
            rows.append([])
            filled = 0.0
        rows[-1].append(number)
        filled += float(size[0])
    depths = [max((float(sizes[number][1]) for number in row), default=0.0) for row in rows]
    length = sum(depths) / strips
    plots: dict[int, Plot] = {}
    strip, y, longest = 0, 0.0, 0.0
    for row, depth in zip(rows, depths, strict=True):
        if y + depth / 2 > length and strip < strips - 1:
            strip, y = strip + 1, 0.0
        spare = (room - sum(float(sizes[number][0]) for number in row)) / max(len(row), 1)
        x = strip * strip_width_m + gap_m
        for number in row:
            width, (low, high) = float(sizes[number][0]) + spare, boxes[number]
            plots[number] = Plot(
                x=x + (width - float(low[0] + high[0])) / 2,
                y=y + (depth - float(low[1] + high[1])) / 2,
                extent=(x, y, x + width, y + depth),
            )
            x += width
        y += depth
        longest = max(longest, y)
    return [plots[number] for number in range(len(buildings))], (strips * strip_width_m, float(np.ceil(longest)))


def scene_of_forms(
    name: str,
    forms: Mapping[BrokenForm, Callable[[np.random.Generator], list[RoofPart]]]
    | Mapping[CurvedForm, Callable[[np.random.Generator], list[RoofPart]]],
    random: np.random.Generator,
    north_m: float,
) -> Scene:
    """Four buildings of each form on plots of their own on nearly level ground; their ids are FORM-NUMBER."""
    planned = [
        PlannedRoof.over(
            parts_of(random),
            f"{form}-{number}",
            azimuth_deg=float(random.uniform(0.0, 360.0)),
            eave_height_m=float(random.uniform(3.0, 7.0)),
            margin_m=_MARGIN_M,
            shape=form,
        )
        for form, parts_of in forms.items()
        for number in range(OF_EACH)
    ]
    plots, extent = packed_plots([one.box for one in planned], _STRIP_M, 1)
    terrain = undulating_terrain(40.0, 1.0, float(random.uniform(0.0, 360.0)), 0.4, 150.0, random)
    return Scene(
        name=name,
        origin=(572_000.0, north_m, 0.0),
        extent=(0.0, 0.0, *extent),
        terrain=terrain,
        buildings=tuple(one.built(plot, terrain) for one, plot in zip(planned, plots, strict=True)),
    )
