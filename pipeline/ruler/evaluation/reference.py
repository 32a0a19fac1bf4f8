"""What models are measured against: true models, classified points, or both."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping

import shapely

from pipeline.model import BoolArray, ByteArray, FloatArray, LabelArray
from pipeline.ruler.evaluation.models import RoofModel


@dataclasses.dataclass(frozen=True, kw_only=True)
class Conditions:
    """What is known about a simulated building, beside its model."""

    shape: str
    """The parametric shape."""
    good: bool
    """True where nothing makes it hard: no defects."""
    defects: tuple[str, ...]
    """What makes it hard."""
    pitch_deg: float
    """Steepest roof face."""
    terrain_slope_deg: float
    """Slope of the terrain at the building."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferencePoints:
    """The points of one tile that the measures look at, metres. All arrays have one length n."""

    name: str
    """Of the file."""
    xyz: FloatArray
    """(n, 3) float64."""
    classification: LabelArray
    """(n,) int32, reference class: 2 ground, 6 building (roofs and walls), others as they are."""
    building: LabelArray
    """(n,) int32, index into the reference's buildings that the point lies in or belongs to; -1 for none."""
    face: LabelArray
    """(n,) int32, true roof face of the building; -1 where unknown, for walls and for what is no roof."""
    is_roof: BoolArray
    """(n,) bool, True where the residual measures use the point: class 6 (with true labels: roof faces, no walls)
    inside the building's footprint."""
    last: BoolArray
    """(n,) bool, True for last returns: what ground filters are judged on."""
    return_number: ByteArray | None = None
    """(n,) uint8, 1 is the first return; None where unknown: 1 for all."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """A reference. Made by `read_truth_reference` or `read_points_reference`."""

    name: str
    """What the report calls it."""
    kind: str
    """truth (models and labelled points), or points (classes alone, with or without footprints)."""
    buildings: tuple[RoofModel, ...]
    """True models; from points alone: footprints without roof faces (given ones, or outlines of the class-6 raster)."""
    has_faces: bool
    """True where the buildings have true roof faces and types."""
    outlines: str
    """Where the footprints come from: truth, given, raster."""
    tiles: tuple[Callable[[], ReferencePoints], ...]
    """Each reads one tile: one at a time is in memory. Empty where no points are at hand."""
    bounds: tuple[tuple[float, float, float, float], ...] = ()
    """x_min, y_min, x_max, y_max of each tile's points, metres. Empty where unknown: each tile is then judged alone."""
    conditions: Mapping[str, Conditions] = dataclasses.field(default_factory=dict)
    """By building_id; empty where nothing is known."""
    face_points: Mapping[tuple[str, int], int] = dataclasses.field(default_factory=dict)
    """Points of each true face, by building_id and plane_id; empty where unknown: then no face is too sparse."""
    extent: shapely.Geometry | None = None
    """Where the reference is complete, so that a model elsewhere is wrong; None: nowhere (footprints of a part)."""
    has_ground: bool = False
    """True where class 2 of the points is the true ground."""
    unclassified_is_object: bool = True
    """False where classes 0 and 1 say nothing: other classes tell what the objects are."""
    crs: str | None = None
    """Name or code; None where unknown."""
    notes: tuple[str, ...] = ()
    """What had to be assumed, as sentences for the report."""

    def points(self) -> Iterator[ReferencePoints]:
        """The tiles, one after the other."""
        for read in self.tiles:
            yield read()
