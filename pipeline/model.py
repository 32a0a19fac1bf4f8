"""Frozen data that the stages hand to one another. Data are nouns; functions that make them are verbs elsewhere."""

from __future__ import annotations

import dataclasses
import math
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt
from shapely import LineString, MultiPolygon, Polygon

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
LabelArray = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]
ByteArray = npt.NDArray[np.uint8]
KindArray = npt.NDArray[np.int8]


class Status(StrEnum):
    """How a candidate ended, the best first."""

    OK = "ok"
    DOUBTFUL = "doubtful"
    FALLBACK = "fallback"
    FAILED = "failed"

    @property
    def has_roof(self) -> bool:
        """Whether the roof was modelled: `ok`, or `doubtful` where the points do not support the model."""
        return self in {Status.OK, Status.DOUBTFUL}


class Reason(StrEnum):
    """Why a candidate is not `ok`, or why an object was rejected: the closed list of the records."""

    TOO_FEW_POINTS = "too_few_points"
    NO_PLANE = "no_plane"
    NO_PARTITION = "no_partition"
    INVALID_SOLID = "invalid_solid"
    TOO_COMPLEX = "too_complex"
    NO_FOOTPRINT = "no_footprint"
    HEIGHT_GIVEN = "height_given"
    POOR_FIT = "poor_fit"
    SCATTERED = "scattered"
    NOT_SEEN = "not_seen"
    TOO_MANY_FACES = "too_many_faces"
    UNCERTAIN = "uncertain"
    ABOVE_POINTS = "above_points"
    LEVEL_THROUGH_SLOPE = "level_through_slope"
    INTERNAL_ERROR = "internal_error"
    CRASHED = "crashed"
    TIMED_OUT = "timed_out"
    OUT_OF_MEMORY = "out_of_memory"
    TOO_SMALL = "too_small"
    TOO_LOW = "too_low"
    BELOW_Z_AVG = "below_z_avg"
    NO_WALLS = "no_walls"
    VEGETATION = "vegetation"
    TOO_NARROW = "too_narrow"
    BRIDGE = "bridge"
    VEHICLE = "vehicle"
    STRIPS_DISAGREE = "strips_disagree"
    OVERRIDDEN = "overridden"


class RoofType(StrEnum):
    """Roof types of the records."""

    FLAT = "flat"
    PENT = "pent"
    GABLE = "gable"
    HALF_HIP = "half-hip"
    HIP = "hip"
    PYRAMID = "pyramid"
    GAMBREL = "gambrel"
    MANSARD = "mansard"
    BUTTERFLY = "butterfly"
    SAWTOOTH = "sawtooth"
    L_SHAPE = "l-shape"
    T_SHAPE = "t-shape"
    CROSS = "cross"
    BARREL = "barrel"
    CONE = "cone"
    DOME = "dome"
    COMBINATION = "combination"
    UNKNOWN = "unknown"
    NONE = "none"

    @property
    def is_curved(self) -> bool:
        """Whether its faces are facets of one surface."""
        return self in (RoofType.BARREL, RoofType.CONE, RoofType.DOME)


class HeightSource(StrEnum):
    """Where the height of a model comes from: points, or an attribute of its footprint."""

    POINTS = "points"
    HEIGHT = "height"
    ROOF_ELEVATION = "roof_elevation"
    STOREYS = "storeys"


class GroundSource(StrEnum):
    """Where the floor of a building comes from: the terrain, an attribute of its footprint, or neither."""

    TERRAIN = "terrain"
    ATTRIBUTE = "attribute"
    ASSUMED = "assumed"


class FaceKind(StrEnum):
    """Kind of a face of a solid; the semantics of OBJ groups and CityJSON surfaces."""

    ROOF = "roof"
    WALL = "wall"
    GROUND = "ground"
    CEILING = "ceiling"
    """The underside of an overhang."""
    CLOSURE = "closure"
    """The foot of a box on the roof."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Points with the attributes that later stages use. All arrays have one length n."""

    xyz: FloatArray
    """(n, 3) float64, easting, northing, elevation in metres; finite."""
    return_number: ByteArray
    """(n,) uint8, 1 is the first return; 1 where the file has none."""
    return_count: ByteArray
    """(n,) uint8, returns of the pulse; 1 where the file has none."""
    classification: ByteArray
    """(n,) uint8, ASPRS class; 0 where the file has none."""
    gps_time: FloatArray
    """(n,) float64, seconds as in the file; 0 where the file has none."""
    source_id: npt.NDArray[np.uint16]
    """(n,) uint16, flight line; 0 where the file has none."""

    def __post_init__(self) -> None:
        """Hold the lengths together."""
        n = len(self.xyz)
        if self.xyz.shape != (n, 3):
            raise ValueError(f"xyz has shape {self.xyz.shape}, not (n, 3)")
        for field in dataclasses.fields(self):
            if len(getattr(self, field.name)) != n:
                raise ValueError(f"{field.name} has {len(getattr(self, field.name))} entries for {n} points")

    def __len__(self) -> int:
        """Number of points."""
        return len(self.xyz)

    def take(self, index: npt.NDArray[Any] | slice) -> PointCloud:
        """The points that an index array, mask or slice selects."""
        return PointCloud(**{f.name: getattr(self, f.name)[index] for f in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tin:
    """A triangulated irregular network over points that are kept elsewhere."""

    facets: LabelArray
    """(m, 3) int32, vertex indices, counter-clockwise seen from above."""
    neighbours: LabelArray
    """(m, 3) int32, the facet across the edge opposite to each vertex; -1 at the hull."""

    def __len__(self) -> int:
        """Number of facets."""
        return len(self.facets)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plane:
    """A roof plane z = a x + b y + c in the candidate's local metres."""

    a: float
    """Rise per metre of easting."""
    b: float
    """Rise per metre of northing."""
    c: float
    """Elevation over the local origin, metres."""
    n_points: int
    """Points that support the plane; 0 if it was drawn where no point is."""
    rmse_m: float
    """Root mean square of the vertical residuals of those points, metres."""

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """(a, b, c)."""
        return self.a, self.b, self.c

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit normal that points up."""
        scale = 1.0 / math.sqrt(1.0 + self.a * self.a + self.b * self.b)
        return -self.a * scale, -self.b * scale, scale

    @property
    def slope_deg(self) -> float:
        """0 is horizontal, 90 vertical."""
        return math.degrees(math.atan(math.hypot(self.a, self.b)))

    @property
    def aspect_deg(self) -> float:
        """Direction of steepest descent, clockwise from north, in [0, 360); 0 for a horizontal plane."""
        if self.a == 0.0 and self.b == 0.0:
            return 0.0
        aspect = math.degrees(math.atan2(-self.a, -self.b)) % 360.0
        return 0.0 if aspect >= 360.0 else aspect

    @property
    def o_distance_m(self) -> float:
        """Signed distance from the local origin to the plane, positive where the plane is above it."""
        return self.c / math.sqrt(1.0 + self.a * self.a + self.b * self.b)


class GuideKind(StrEnum):
    """What a given line of a roof is."""

    RIDGE = "ridge"
    HIP = "hip"
    VALLEY = "valley"
    EAVE = "eave"
    STEP = "step"
    ANY = "any"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Guide:
    """A line of a roof that an operator gave."""

    kind: GuideKind
    """What it is; `any` where that is not known."""
    line: LineString
    """In plan, metres."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenHeights:
    """Heights of one building by the attributes of its given footprint; nan if unknown."""

    height_m: float = math.nan
    """Height above ground, metres."""
    roof_z_m: float = math.nan
    """Elevation of the roof, metres."""
    storeys_m: float = math.nan
    """Height of all storeys together, metres."""
    ground_z_m: float = math.nan
    """Elevation of the ground, metres."""
    terrain_z_m: float = math.nan
    """Lowest terrain at the outline of the footprint, metres: not an attribute, found by the points around."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Candidate:
    """The points of one possible building, and the terrain around it."""

    building_id: str
    """base32 of a sha256 over the CRS and the smallest point; the same for every method and tiling."""
    origin: tuple[float, float, float]
    """Absolute easting, northing, elevation in metres of the local origin: whole metres."""
    points: FloatArray
    """(n, 3) float64, local metres, exact multiples of 1 mm, in canonical order (X, Y, Z, return, GPS time, source)."""
    ground: FloatArray
    """(m, 3) float64, local metres: samples of the terrain around and beneath, on a 1 m lattice."""
    ground_z_m: float
    """Local elevation of the lowest terrain at the outline: where the walls end."""
    ground_source: GroundSource | None = None
    """Where that elevation comes from; None if it is unknown."""
    split_returns: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(k, 3) float64, those of the points whose pulse went on to a lower return: it met them with a part of its beam.
    Empty where the file has no returns."""
    footprint: Polygon | MultiPolygon | None = None
    """Given footprint in local metres; None where none was given."""
    source_id: str | None = None
    """The given footprint's own id."""
    given: GivenHeights | None = None
    """Its heights by attributes, elevations in local metres; None without any."""
    outline: MultiPolygon | None = None
    """Its outline, drawn with regard to what it touches, local metres; None where it is drawn around its own points."""
    beside: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(j, 3) float64, other points within about 2 m around and beneath, of pulses with one return: facades and ground.
    Empty unless outlines are drawn at the walls."""
    beside_later: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(i, 3) float64, the same of pulses with several returns, the last of each."""
    elsewhere: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(e, 3) float64, local metres: centres, on the terrain, of the cells of 1 m wholly in the given footprint that
    hold points, but none of its own. Empty without a footprint."""
    voids: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """(v, 3) float64, local metres, at elevation 0: centres of the cells of 1 m nearby that belong to squares without
    any point. Empty with a footprint and at the edge of the data."""
    touches_data_edge: bool = False
    """True where the data end at the candidate: it may be cut."""
    is_known: bool = False
    """True where a footprint or the user says that it is a building."""
    strip_offset_m: float = math.nan
    """Largest offset between two flight strips that was taken out of the points, metres; nan where none was."""
    ground_noise_m: float = math.nan
    """Robust standard deviation of single points of open, level ground nearby about the terrain, metres; nan where
    there is little such ground."""
    guides: tuple[Guide, ...] = ()
    """Given lines near its points, in local metres."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanFace:
    """A roof face as a method itself draws it in plan."""

    plane: int
    """Index into the segmentation's planes."""
    polygon: Polygon
    """2D, local metres; the faces of one building do not overlap."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Result of a segmentation method: planes, and the plane of every point."""

    planes: tuple[Plane, ...]
    """The roof planes."""
    labels: LabelArray
    """(n,) int32, index into planes for every point of the candidate; -1 where no plane explains it."""
    faces: tuple[PlanFace, ...] | None = None
    """The building primitive of a method that knows the whole form: its roof faces in plan, closed by walls as they
    are. None where the faces are to be drawn from the labels."""
    roof_type: RoofType | None = None
    """Roof type that the method names; None leaves it to the rule over the delivered planes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PreparedCloud:
    """A candidate's points, prepared once for the method and for the roof."""

    candidate: Candidate
    """Where they come from."""
    shift_m: FloatArray
    """(3,) float64, the origin of `points` in the candidate's frame: whole metres. Results do not depend on where the
    building stands."""
    points_mm: IntArray
    """(n, 3) int64, all points about that origin, millimetres, each coordinate at least 0."""
    points: FloatArray
    """(n, 3) float64, the same in metres."""
    visible: IntArray
    """(v,) int64, ascending indices of the points that see the sky."""
    highest: IntArray
    """(h,) int64, ascending indices of the highest of these at every position in plan."""

    @property
    def ground_z_m(self) -> float:
        """Elevation of the floor about the origin of `points`, metres."""
        return self.candidate.ground_z_m - float(self.shift_m[2])

    def segmentation(
        self,
        planes: tuple[Plane, ...],
        index: IntArray,
        labels: LabelArray,
        *,
        faces: tuple[PlanFace, ...] | None = None,
        roof_type: RoofType | None = None,
    ) -> Segmentation:
        """The result of a method, in the candidate's frame; its planes are over the origin of `points`.

        Parameters
        ----------
        index : (k,) int64
            The points that the method labelled, `visible` or `highest`; all others get the label -1.
        labels : (k,) int32
            Their planes.
        """
        all_labels = np.full(len(self.points), -1, np.int32)
        all_labels[index] = labels
        x, y, z = self.shift_m.tolist()
        return Segmentation(
            planes=tuple(dataclasses.replace(plane, c=plane.c + z - plane.a * x - plane.b * y) for plane in planes),
            labels=all_labels,
            faces=faces,
            roof_type=roof_type,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolidFace:
    """A planar face: an outer ring and holes, as vertex indices."""

    rings: tuple[tuple[int, ...], ...]
    """Outer ring first, counter-clockwise seen from outside the solid, holes clockwise; first vertex not repeated."""
    kind: FaceKind
    """Roof, wall or ground."""
    plane: int = -1
    """Index of the roof plane; -1 for walls and ground."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solid:
    """A closed, outward oriented polyhedron."""

    vertices: FloatArray
    """(v, 3) float64, local metres, exact multiples of 1 mm (rounded before validity is judged)."""
    faces: tuple[SolidFace, ...]
    """The boundary."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofFace:
    """The polygon of a roof plane in one solid."""

    plane: int
    """Index into the building's planes."""
    polygon: Polygon
    """3D polygon in local metres."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelQuality:
    """How well the points support a delivered model: nan where they do not say, or without a model."""

    point_spacing_m: float = math.nan
    """Typical distance of neighbouring roof points in plan, metres."""
    noise_m: float = math.nan
    """Robust standard deviation of the roof returns about the roof, vertical; nan for a block."""
    share_within: float = math.nan
    """Share of the roof returns that have a roof within 0.2 m above or below them."""
    share_below_roof: float = math.nan
    """Share of all points that are not roof returns: on facades, below the roof."""
    unexplained_m2: float = math.nan
    """Plan area of roof without a point within 0.2 m of it nearby, square metres."""
    extrapolated_share: float = math.nan
    """Share of the roof's plan area that is farther than two point spacings from every point over or under it."""
    largest_hole_m: float = math.nan
    """Diameter of the largest circle on the roof that holds no point, in plan, metres."""
    ridge_z_sigma_m: float = math.nan
    """Standard deviation of the highest roof point, metres, without what a whole strip is off by; nan for a block."""
    outline_sigma_m: float = math.nan
    """Standard deviation in plan of the edges of the outline, metres; nan if it was given."""
    bic_margin: float = math.nan
    """By how much the information criterion of the chosen form is below the next one's; nan where none competed."""
    is_curved: bool = False
    """True where most of the roof is one surface that bends steadily: by its type or by its planes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WallOutline:
    """The walls beneath a footprint that was drawn at the eaves."""

    outline: MultiPolygon
    """2D outline of the walls in local metres."""
    overhang_m: float
    """Mean overhang of the eaves along the walls that points show, metres."""
    overhang_sigma_m: float
    """Its standard error, metres."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LodModel:
    """A building's model at a coarser level of detail than that of its record."""

    lod: str
    """1.2, 1.3 or 2.0."""
    planes: tuple[Plane, ...]
    """The planes that the roofs of the solids number; horizontal below LoD2."""
    solids: tuple[Solid, ...]
    """Closed solids, one for each solid of the record's model, in the same order."""


class OverhangSource(StrEnum):
    """Where the overhangs of a model in LoD2.3 come from."""

    SEEN = "seen"
    USUAL = "usual"
    GIVEN = "given"


class NoOverhang(StrEnum):
    """Why a building has no model in LoD2.3: a closed list."""

    NO_LOD22 = "no_lod22"
    FOOTPRINT_GIVEN = "footprint_given"
    NO_WALL_SEEN = "no_wall_seen"
    NO_OPEN_GROUND = "no_open_ground"
    OVERHANG_TOO_SMALL = "overhang_too_small"
    WALLS_BREAK = "walls_break"
    TOO_LOW = "too_low"
    INVALID_SOLID = "invalid_solid"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Overhangs:
    """A building's model in LoD2.3, or why there is none."""

    solids: tuple[Solid, ...] = ()
    """Closed solids, one for each solid of the record's model, in the same order; their roofs number its planes. Empty
    where there are none."""
    source: OverhangSource | None = None
    """Where the overhangs come from; None without solids."""
    reason: NoOverhang | None = None
    """Why no solid was made; None if one was."""


class DecisionKind(StrEnum):
    """What was decided while a building was modelled."""

    CHECK = "check"
    FORM = "form"
    LEVEL = "level"


class Outcome(StrEnum):
    """How a check, a form or a level of detail ended."""

    MET = "met"
    MISSED = "missed"
    CHOSEN = "chosen"
    OUTDONE = "outdone"
    INVALID = "invalid"
    UNDRAWABLE = "undrawable"
    WITHDRAWN = "withdrawn"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Decision:
    """A check, a form or a level of detail on the way to a model; nan and None where a figure was not needed."""

    kind: DecisionKind
    """A figure against its limit, a form of the roof that was tried, or a level of detail that was asked for."""
    name: str
    """Name of the figure, the form or the level."""
    outcome: Outcome
    """How it ended."""
    detail: str = ""
    """How the form was drawn, or why it was refused."""
    value: float = math.nan
    """The figure of a check."""
    limit: float = math.nan
    """The least value that meets the check."""
    n_faces: int | None = None
    """Roof faces."""
    n_planes: int | None = None
    """Roof planes with a face."""
    levelled_share: float = math.nan
    """Share of the plan whose faces were made level, since their planes left the points."""
    explained_share: float = math.nan
    """Share of the roof points near the faces, vertically."""
    bic_margin: float = math.nan
    """By how much the information criterion is below that of the form that competed; negative where it is above."""
    validity_codes: tuple[int, ...] = ()
    """Codes of the faults of the solids."""

    @classmethod
    def check(cls, name: str, value: float, limit: float, detail: str = "") -> Decision:
        """A figure that has to reach a limit."""
        outcome = Outcome.MET if value >= limit else Outcome.MISSED
        return cls(kind=DecisionKind.CHECK, name=name, outcome=outcome, detail=detail, value=value, limit=limit)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Doubt:
    """A threshold that a model misses: why its own points do not support it."""

    reason: Reason
    """Of the closed list."""
    words: str
    """Figure and threshold, as in the record's `reason_detail`."""
    check: Decision
    """The same as an entry of the decisions."""

    @classmethod
    def of(cls, reason: Reason, words: str, name: str, value: float, limit: float) -> Doubt:
        """A figure by its name in the decisions, and the limit that it misses."""
        check = Decision(kind=DecisionKind.CHECK, name=name, outcome=Outcome.MISSED, value=value, limit=limit)
        return cls(reason=reason, words=words, check=check)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingResult:
    """Outcome of a candidate. Every candidate has one, also one that failed: the defaults are those without a model."""

    building_id: str
    """As the candidate's."""
    origin: tuple[float, float, float]
    """As the candidate's."""
    source_id: str | None
    """As the candidate's."""
    status: Status
    """ok, doubtful, fallback or failed."""
    reason: Reason | None
    """None where ok."""
    reason_detail: str
    """The measured figure and the threshold; empty where ok."""
    method: str
    """Name of the method."""
    roof_type: RoofType = RoofType.NONE
    """From the delivered planes; none where there is no model."""
    lod: str = ""
    """Level of detail of the model: the finest requested, 1.2 for a fallback block, empty where there is no model."""
    footprint: Polygon | MultiPolygon | None
    """2D outline of the delivered solids in local metres (failed: of the points where that is possible)."""
    footprint_share: float = math.nan
    """Area of that outline over the area of the given footprint: below 1 where a part of it, having no points, was left
    out; nan without a given footprint or without a model."""
    planes: tuple[Plane, ...] = ()
    """The delivered roof planes."""
    faces: tuple[RoofFace, ...] = ()
    """The delivered roof faces."""
    solids: tuple[Solid, ...] = ()
    """The delivered closed solids; empty where failed."""
    validity_codes: tuple[int, ...] = ()
    """Codes of the faults that kept the method's own solid from delivery; empty where there were none."""
    ground_z_m: float
    """Local elevation of the floor."""
    height_source: HeightSource | None = None
    """Where the height of the model comes from; None without a model."""
    ground_source: GroundSource | None = None
    """Where the elevation of the floor comes from; None if it is unknown."""
    n_points: int
    """Points of the candidate."""
    density_per_m2: float
    """Points a square metre of footprint; nan without one."""
    rmse_m: float = math.nan
    """Root mean square vertical distance of the covered roof returns to the top surface, with few far ones limited;
    nan without a model."""
    p95_m: float = math.nan
    """95th percentile of the absolute vertical distances; nan without a model."""
    coverage: float = 0.0
    """Share of the roof returns that have a roof above or below them; 0 without a model, nan for one by attributes."""
    quality: ModelQuality = ModelQuality()
    """How well the points support the model."""
    replaced_confidence: float = math.nan
    """Of a block in place of a doubtful model: the confidence in that model; nan otherwise."""
    touches_data_edge: bool
    """As the candidate's."""
    strip_offset_m: float = math.nan
    """As the candidate's."""
    ground_noise_m: float = math.nan
    """As the candidate's."""
    walls: WallOutline | None = None
    """The walls beneath the footprint; None where it was given, or where no wall is asked for or seen."""
    guides: tuple[int, int] | None = None
    """Guides that its faces follow, and others over or beside them; None without a model, or without any guide near."""
    decisions: tuple[Decision, ...] = ()
    """What was checked and tried, in this order; empty where the building ended its process."""
    coarser: tuple[LodModel, ...] = ()
    """Models at the coarser requested levels of detail, the finest first; none beside a fallback block."""
    overhangs: Overhangs | None = None
    """The model in LoD2.3 beside that of the record; None unless the settings request it, and without a model."""
    boxes: tuple[Solid, ...] | None = None
    """Closed boxes of what stands on the roof, in LoD2.2; None unless the settings request them."""

    def doubted(self, doubt: Doubt) -> BuildingResult:
        """The same model as a doubtful one."""
        return dataclasses.replace(
            self,
            status=Status.DOUBTFUL,
            reason=doubt.reason,
            reason_detail=doubt.words,
            decisions=(*self.decisions, doubt.check),
        )
