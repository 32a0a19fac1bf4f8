"""The reference of a measurement: true models, classified points, or both."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping

import shapely

from pipeline.model import BoolArray, ByteArray, FloatArray, LabelArray
from pipeline.ruler.evaluation.models import RoofModel


@dataclasses.dataclass(frozen=True, kw_only=True)
class Conditions:
    """Known facts about a simulated building besides its model."""

    shape: str
    good: bool
    defects: tuple[str, ...]
    pitch_deg: float
    """Slope of the steepest roof face."""
    terrain_slope_deg: float
    """Slope of the terrain at the building."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferencePoints:
    """The points of one tile, metres. All arrays have one length n."""

    name: str
    xyz: FloatArray
    """(n, 3) float64."""
    classification: LabelArray
    """(n,) int32, reference class: 2 ground, 6 building (roofs and walls), others unchanged."""
    building: LabelArray
    """(n,) int32, index into the reference's buildings that the point lies in or belongs to; -1 for none."""
    face: LabelArray
    """(n,) int32, true roof face of the building; -1 if unknown, for walls and other objects."""
    is_roof: BoolArray
    """(n,) bool, True where the residual measures use the point: class 6 (with true labels: roof faces, no walls)
    inside the building's footprint."""
    last: BoolArray
    """(n,) bool, True for last returns, on which ground filters are judged."""
    return_number: ByteArray | None = None
    """(n,) uint8, 1 is the first return; None if unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """A reference. Made by `read_truth_reference` or `read_points_reference`."""

    name: str
    kind: str
    """truth (models and labelled points), or points (classes alone, with or without footprints)."""
    buildings: tuple[RoofModel, ...]
    """True models, or for points footprints without roof faces (given ones, or outlines of the class-6 raster)."""
    has_faces: bool
    """True where the buildings have true roof faces and types."""
    outlines: str
    """Source of the footprints: truth, given, raster."""
    tiles: tuple[Callable[[], ReferencePoints], ...]
    """Each reads one tile, so one at a time is in memory. Empty without points."""
    bounds: tuple[tuple[float, float, float, float], ...] = ()
    """x_min, y_min, x_max, y_max of each tile's points, metres. Empty if unknown: each tile is then judged alone."""
    conditions: Mapping[str, Conditions] = dataclasses.field(default_factory=dict)
    """By building_id; empty if unknown."""
    face_points: Mapping[tuple[str, int], int] = dataclasses.field(default_factory=dict)
    """Points of each true face, by building_id and plane_id; empty if unknown: then no face is too sparse."""
    extent: shapely.Geometry | None = None
    """Area where the reference is complete and extra models are wrong; None: nowhere (footprints of a part)."""
    has_ground: bool = False
    """True where class 2 of the points is the true ground."""
    unclassified_is_object: bool = True
    """False if other classes name the objects, so classes 0 and 1 mean nothing."""
    crs: str | None = None
    """Name or code; None if unknown."""
    notes: tuple[str, ...] = ()
    """Assumptions, as sentences for the report."""

    def points(self) -> Iterator[ReferencePoints]:
        """The tiles, one after the other."""
        for read in self.tiles:
            yield read()
