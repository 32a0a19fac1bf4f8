"""Scenes with exact truth: buildings as solids, analytic terrain, trees and small boxes (cars).

A scene has its own frame: metres east, north and up from `Scene.origin`. `first_hit` finds what a ray hits in it.
"""

from __future__ import annotations

import dataclasses
import math
from enum import StrEnum

import numpy as np
import shapely

from pipeline.model import FloatArray, Plane, RoofType
from pipeline.ruler.simulation.roofs import (
    ROOF_TYPES,
    ROOFS,
    BrokenForm,
    CurvedForm,
    FaceRings,
    RoofDimensions,
    RoofShape,
)

_STEP_M = 0.05
"""Step of the central differences of the terrain."""


class Defect(StrEnum):
    """A reason why a building is hard to reconstruct from its points."""

    STRIP_SHIFT = "strip_shift"
    WRONG_ROWS = "wrong_rows"
    WET_SPOT = "wet_spot"
    DORMERS = "dormers"
    SUPERSTRUCTURE = "superstructure"
    OVERHANGING_TREE = "overhanging_tree"


class FaultKind(StrEnum):
    """A kind of survey error inside a rectangle."""

    STRIP_SHIFT = "strip_shift"
    WRONG_ROWS = "wrong_rows"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Terrain:
    """Analytic terrain: a sloping plane with gentle waves."""

    base_z_m: float
    """Elevation of the plane at the scene's origin."""
    slope_x: float = 0.0
    """Rise per metre of easting."""
    slope_y: float = 0.0
    """Rise per metre of northing."""
    waves: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 4)))
    """(k, 4) float64: amplitude in metres, wave number east and north in radians per metre, phase."""

    def elevation(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Elevation at scene coordinates; arrays of one shape."""
        z = self.base_z_m + self.slope_x * x + self.slope_y * y
        for amplitude, east, north, phase in self.waves:
            z = z + amplitude * np.sin(east * x + north * y + phase)
        return z

    def at(self, x: float, y: float) -> float:
        """Elevation of one place."""
        return float(self.elevation(np.array([x]), np.array([y]))[0])

    def slope_deg(self, x: float, y: float) -> float:
        """Slope at a place, by central differences."""
        east = self.elevation(np.array([x - _STEP_M, x + _STEP_M]), np.array([y, y]))
        north = self.elevation(np.array([x, x]), np.array([y - _STEP_M, y + _STEP_M]))
        return math.degrees(math.atan(math.hypot(float(np.diff(east)[0]), float(np.diff(north)[0])) / (2 * _STEP_M)))


def undulating_terrain(
    base_z_m: float,
    slope_deg: float,
    aspect_deg: float,
    amplitude_m: float,
    wavelength_m: float,
    random: np.random.Generator,
) -> Terrain:
    """Terrain that falls by slope_deg towards aspect_deg (clockwise from north), with three waves over it.

    The amplitude is that of all waves together, so no point is farther than it from the plane.
    """
    fall, aspect = math.tan(math.radians(slope_deg)), math.radians(aspect_deg)
    waves = np.zeros((3, 4))
    for k, (share, length) in enumerate(((0.6, 1.0), (0.3, 0.55), (0.1, 0.3))):
        direction, phase = random.uniform(0, 2 * math.pi, 2)
        number = 2 * math.pi / (wavelength_m * length)
        waves[k] = amplitude_m * share, number * math.cos(direction), number * math.sin(direction), phase
    return Terrain(base_z_m=base_z_m, slope_x=-fall * math.sin(aspect), slope_y=-fall * math.cos(aspect), waves=waves)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WetSpot:
    """A circle in plan where a roof does not return pulses: water, fresh tar."""

    x: float
    """Easting of its middle, scene frame."""
    y: float
    """Northing of its middle."""
    radius_m: float
    """Radius."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Building:
    """An exact building. Made by `place_building`."""

    building_id: str
    """Name, unique within the scene."""
    block_id: str
    """Buildings that touch share a block; else the building's own id."""
    shape: RoofShape | BrokenForm | CurvedForm
    """The parametric shape."""
    dimensions: RoofDimensions
    """Its size."""
    x: float
    """Easting of the middle of the main rectangle, scene frame."""
    y: float
    """Northing of the same."""
    azimuth_deg: float
    """Direction of the ridge, clockwise from north."""
    floor_z_m: float
    """Lowest terrain at the outline: where the walls end."""
    eave_z_m: float
    """Elevation of the eave."""
    vertices: FloatArray
    """(v, 3) float64, roof vertices in the scene frame."""
    faces: tuple[FaceRings, ...]
    """Rings of each roof face: its outline counter-clockwise seen from above, then its holes clockwise."""
    planes: tuple[Plane, ...]
    """Exact plane of each roof face in the scene frame, without points (n_points 0, rmse_m 0)."""
    groups: tuple[int, ...]
    """A number for every roof face; faces with one number count as one, such as both parts of a side of a bent hip."""
    wet_spots: tuple[WetSpot, ...] = ()
    """Circles where its roof does not return pulses."""
    glass_share: float = 0.0
    """Share of the pulses on its roof that go through to what is beneath: glass."""
    defects: tuple[Defect, ...] = ()
    """Reasons why it is hard."""

    @property
    def roof_type(self) -> RoofType:
        """Its roof type in the records."""
        return ROOF_TYPES[self.shape]

    @property
    def is_good(self) -> bool:
        """Whether it has no defects."""
        return not self.defects

    @property
    def ridge_z_m(self) -> float:
        """Highest roof point."""
        return float(self.vertices[:, 2].max())

    @property
    def footprint(self) -> shapely.Polygon:
        """2D outline in the scene frame."""
        return _outline(self.vertices[:, :2], self.faces)

    def roof_polygons(self) -> tuple[shapely.Polygon, ...]:
        """3D polygons of the roof faces in the scene frame."""
        return tuple(_polygon(self.vertices, face) for face in self.faces)


def _polygon(vertices: FloatArray, rings: FaceRings) -> shapely.Polygon:
    """The polygon of a face over vertices (v, 2) or (v, 3)."""
    return shapely.Polygon(vertices[list(rings[0])], [vertices[list(hole)] for hole in rings[1:]])


def _outline(plan: FloatArray, faces: tuple[FaceRings, ...]) -> shapely.Polygon:
    """The union of the faces over plan vertices (v, 2)."""
    union = shapely.union_all([_polygon(plan, face) for face in faces])
    pieces = [piece for piece in shapely.get_parts(union) if isinstance(piece, shapely.Polygon)]
    if len(pieces) != 1:
        raise ValueError(f"the roof faces cover {len(pieces)} separate outlines: let all parts of a building touch")
    return pieces[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tree:
    """An ellipsoid crown over a trunk that is too thin to be hit; beams sink into it at random."""

    x: float
    """Easting, scene frame."""
    y: float
    """Northing."""
    crown_z_m: float
    """Elevation of the crown's middle."""
    crown_radius_m: float
    """Horizontal half axis."""
    crown_half_height_m: float
    """Vertical half axis."""
    free_path_m: float
    """Mean depth that a beam sinks into the crown: smaller is denser."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Box:
    """A small object that is not a building: a car."""

    corners: FloatArray
    """(4, 2) float64, counter-clockwise, scene frame."""
    top_z_m: float
    """Elevation of its top."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurveyFault:
    """An error of the survey inside a rectangle."""

    extent: tuple[float, float, float, float]
    """Smallest x, smallest y, largest x, largest y in the scene frame."""
    kind: FaultKind
    """strip_shift: the border of two strips runs through the middle, and the returns beyond it are shifted.
    wrong_rows: the returns of some scan rows are shifted."""
    shift: tuple[float, float, float]
    """Metres east, north and up by which the wrong returns are moved."""
    azimuth_deg: float = 0.0
    """strip_shift: direction of the border, clockwise from north; the returns to the right of it are moved."""
    share: float = 0.0
    """wrong_rows: share of the scan rows that are moved."""
    other_strip: int | None = None
    """Number of the other strip that the moved returns belong to, counted from 0 behind the strips of the survey; None
    if they stay returns of their own strip. The same in all tiles of a scene."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that a scanner can hit, and its survey errors."""

    name: str
    """Name of the suite."""
    origin: tuple[float, float, float]
    """CRS coordinates of the scene frame's origin, whole metres."""
    extent: tuple[float, float, float, float]
    """Scanned rectangle: smallest x, smallest y, largest x, largest y in the scene frame."""
    terrain: Terrain
    """The ground."""
    buildings: tuple[Building, ...] = ()
    """Hits and labels number them in this order."""
    trees: tuple[Tree, ...] = ()
    """Trees and shrubs."""
    boxes: tuple[Box, ...] = ()
    """Cars."""
    survey_extent: tuple[float, float, float, float] | None = None
    """Extent of the whole survey, scene frame, if the scene is one tile of it: the strips are laid over it."""
    survey_faults: tuple[SurveyFault, ...] = ()
    """Errors of the survey."""
    crs: str | None = "EPSG:25832+7837"
    """Any text that pyproj understands; None without a CRS."""


def turned(local: FloatArray, x: float, y: float, azimuth_deg: float) -> FloatArray:
    """Points (n, 2) of a frame whose first axis points to azimuth_deg, as scene coordinates (n, 2)."""
    azimuth = math.radians(azimuth_deg)
    east, north = math.sin(azimuth), math.cos(azimuth)
    u, v = local[:, 0], local[:, 1]
    return np.column_stack([x + u * east - v * north, y + u * north + v * east])


def face_plane(ring: FloatArray) -> Plane:
    """The exact plane through a planar ring (n, 3) that is not vertical, by Newell's sums."""
    middle = ring.mean(axis=0)
    here = ring - middle
    there = np.roll(here, -1, axis=0)
    normal_x = float(np.sum((here[:, 1] - there[:, 1]) * (here[:, 2] + there[:, 2])))
    normal_y = float(np.sum((here[:, 2] - there[:, 2]) * (here[:, 0] + there[:, 0])))
    normal_z = float(np.sum((here[:, 0] - there[:, 0]) * (here[:, 1] + there[:, 1])))
    a, b = -normal_x / normal_z, -normal_y / normal_z
    if np.ptp(ring[:, 2]) == 0:  # exactly horizontal, despite the rounding of the sums
        a = b = 0.0
    return Plane(a=a, b=b, c=float(middle[2] - a * middle[0] - b * middle[1]), n_points=0, rmse_m=0.0)


def outline_samples(ring: FloatArray, step_m: float = 0.5) -> FloatArray:
    """Points (n, 2) at most step_m apart along a closed ring (k, 2), all its vertices among them."""
    samples = []
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        count = max(1, math.ceil(float(np.hypot(*(end - start))) / step_m))
        samples.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.concatenate(samples)


def place_building(
    building_id: str,
    shape: RoofShape,
    dimensions: RoofDimensions,
    *,
    at: tuple[float, float],
    azimuth_deg: float,
    eave_height_m: float,
    terrain: Terrain,
    block_id: str | None = None,
) -> Building:
    """Put a building without defects on the terrain, with exact roof vertices and planes.

    `at` is the middle of its main rectangle, easting and northing in the scene frame. The eave is above the *highest*
    terrain at the outline, so that no wall vanishes uphill; the floor is the lowest, rounded down to 1 mm. Raises
    ValueError if the dimensions give no such roof.
    """
    roof = ROOFS[shape](dimensions)
    plan = turned(roof.vertices[:, :2], *at, azimuth_deg)
    outline = _outline(plan, roof.faces)
    samples = outline_samples(shapely.get_coordinates(outline.exterior)[:-1])
    ground = terrain.elevation(samples[:, 0], samples[:, 1])
    eave_z = round(float(ground.max()) + eave_height_m, 3)
    vertices = np.column_stack([plan, roof.vertices[:, 2] + eave_z])
    return Building(
        building_id=building_id,
        block_id=block_id or building_id,
        shape=shape,
        dimensions=dimensions,
        x=at[0],
        y=at[1],
        azimuth_deg=azimuth_deg,
        floor_z_m=math.floor(float(ground.min()) * 1000) / 1000,
        eave_z_m=eave_z,
        vertices=vertices,
        faces=roof.faces,
        planes=tuple(face_plane(vertices[list(face[0])]) for face in roof.faces),
        groups=roof.groups,
    )
