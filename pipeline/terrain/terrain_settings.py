"""Settings of the stages from a tile's points to candidates; no kernel is imported here."""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter
from pipeline.terrain.filter_settings import FILTERS, HierarchicalFilterSettings, MorphologicalFilterSettings
from pipeline.terrain.reach import GLASS_M, GLASS_PLANARITY_M, NEAR_CELLS, PLANARITY_SCALES

_MAX_SUPPORT_M = 500
"""A filter that looks farther makes a block nearly all halo."""


class OutlierSettings(Parameters):
    """When a point counts as a gross outlier."""

    cube_m: float = parameter(
        5.0, "Side of the cubes in which neighbours are counted.", unit="m", minimum=1.0, maximum=50.0
    )
    min_neighbours: int = parameter(
        4, "Fewest other points in the 27 cubes around a point that is kept.", minimum=0, maximum=100
    )
    min_share: float = parameter(
        0.1,
        "Fewer other points suffice if they are this share of those in the cubes above and below, too: in a sparse "
        "survey few points lie anywhere.",
        minimum=0.0,
        maximum=1.0,
    )

    @property
    def support_m(self) -> float:
        """How far the decision looks."""
        return 2.0 * self.cube_m


class GroundSettings(MorphologicalFilterSettings, HierarchicalFilterSettings):
    """How ground is separated from objects."""

    filter: str = parameter(
        "morphological",
        "Separates ground from objects: openings of growing size, or TIN densification with planar fitting.",
        choices=tuple(FILTERS),
    )

    pit_depth_m: float = parameter(
        1.0,
        "A cell that lies deeper than this below all but two of its 24 neighbours is a low outlier.",
        unit="m",
        minimum=0.2,
        maximum=20.0,
    )
    bridge_m: int = parameter(
        24,
        "Farthest that the terrain is drawn under objects, unless the filter needs more.",
        unit="m",
        minimum=4,
        maximum=80,
    )
    max_slope: float = parameter(
        1.0,
        "Steepest slope, rise over run, at which the terrain is extended from the middle of the ground around a place.",
        minimum=0.01,
        maximum=2.0,
    )
    tolerance_m: float = parameter(
        0.5, "Points closer than this to level terrain are ground.", unit="m", minimum=0.05, maximum=3.0
    )
    tolerance_slope: float = parameter(
        1.0,
        "Increase of that distance in metres where the terrain rises by 45 degrees, in proportion elsewhere; "
        "the hierarchical filter does not use it.",
        minimum=0.0,
        maximum=3.0,
    )

    def cross_faults(self) -> list[str]:
        """A filter that looks so far that blocks would be nearly all halo."""
        if self.filter == "hierarchical":
            counts = [self.seed_cell_m, self.level_ratio, self.passes, self.min_reach_m, self.clump_m]
            cause = f"seed_cell_m {self.seed_cell_m}, level_ratio {self.level_ratio}, passes {self.passes}"
            fix = "use fewer passes or smaller cells"
        else:
            counts = [self.max_window_m, self.residual_window_m, self.trend_m, self.widest_m, self.regrowth_m]
            counts += [self.regrowth_passes, self.rejoin_passes, self.rejoin_m, self.berm_passes]
            cause = (
                f"max_window_m {self.max_window_m}, residual_window_m {self.residual_window_m}, trend_m {self.trend_m},"
                f" widest_m {self.widest_m}, regrowth_m {self.regrowth_m} in {self.regrowth_passes} and "
                f"{self.berm_passes} passes, rejoin_m {self.rejoin_m} in {self.rejoin_passes} passes, "
                f"bridge_m {self.bridge_m}"
            )
            fix = "use smaller ones"
        whole = all(isinstance(n, int) for n in (*counts, self.bridge_m))
        if not whole or self.level_ratio < 2 or self.support_m <= _MAX_SUPPORT_M:
            return []
        return [f"filter looks {self.support_m:g} m far, by {cause}: {fix}, for at most {_MAX_SUPPORT_M} m"]

    @property
    def reach_m(self) -> int:
        """Farthest that the terrain is drawn under objects: at least to the middle of the widest object cut off."""
        if self.filter == "hierarchical":
            return max(self.bridge_m, 2 * self.seed_cell_m // 3)
        return max(self.bridge_m, self.max_window_m + 1, self.widest_m // 2 + 1 if self.looks_for_wide else 0)

    @property
    def support_m(self) -> float:
        """How far a terrain elevation looks: the pit tests, the filter, the local planes, cell sizes, slopes."""
        if self.filter == "hierarchical":
            return self.hierarchical_support_m + self.reach_m + 4
        near = self.rejoined_support_m + min(self.reach_m, NEAR_CELLS)
        return max(self.morphological_support_m + self.reach_m, near) + 4

    @property
    def trusted_support_m(self) -> float:
        """How far a terrain elevation looks where the ground is known by its class: neither filter nor pit test runs.

        A plane is drawn through the ground cells of a square that never reaches farther than `reach_m`: without ground
        in it there is no terrain. The rest is as in `support_m`.
        """
        return float(self.reach_m + 4)


class VegetationSettings(Parameters):
    """How local planarity is measured."""

    radius_m: float = parameter(
        1.0,
        "Radius of the windows that judge planarity; doubled up to twice where they hold too few points.",
        unit="m",
        minimum=0.3,
        maximum=5.0,
    )
    min_neighbours: int = parameter(6, "Fewest points in a window for a judgement.", minimum=4, maximum=50)
    roughness_m: float = parameter(
        0.1,
        "Largest orthogonal standard deviation of a planar window; half as much again at each doubling.",
        unit="m",
        minimum=0.02,
        maximum=1.0,
    )
    smooth_m: float = parameter(
        0.03,
        "The same of a smooth window: a roof is as smooth as the scanner measures, and the top of a hedge is not.",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    level_m: float = parameter(
        2.0,
        "Points this far above or below a vertex lie across a wall and do not count for it.",
        unit="m",
        minimum=0.5,
        maximum=20.0,
    )
    company_m: float = parameter(
        2.0,
        "Radius of the sphere around a vertex; the verdicts in it decide together whether the vertex is roof or crown. "
        "Doubled up to twice where it holds fewer than min_neighbours of them.",
        unit="m",
        minimum=0.5,
        maximum=5.0,
    )
    crown_share: float = parameter(
        0.5, "Share of rough vertices in that sphere above which a vertex belongs to a crown.", minimum=0.1, maximum=1.0
    )
    pierced_share: float = parameter(
        0.1,
        "Share of vertices from pulses with several returns in that sphere, above which it may be part of a crown.",
        minimum=0.0,
        maximum=1.0,
    )
    canopy_m: float = parameter(
        1.0, "Earlier returns this far above the surface of last returns are canopy.", unit="m", minimum=0.3, maximum=5
    )

    @property
    def support_m(self) -> float:
        """How far the judgement looks: shifted windows of the widest scale around the vertices of a sphere; glass."""
        return max(2.0 * self.radius_m * 2.0 ** (PLANARITY_SCALES - 1) + self.crowns_support_m, GLASS_M)

    @property
    def crowns_support_m(self) -> float:
        """How far the searches for crowns and for glass look at judged vertices: the widest sphere, some squares."""
        return max(self.company_m * 2.0 ** (PLANARITY_SCALES - 1), GLASS_PLANARITY_M)


class SurfaceSettings(Parameters):
    """How the TIN is thinned and cut."""

    thinning_m: float = parameter(
        0.5, "Side of the cells of which one point each enters the scene's TIN.", unit="m", minimum=0.1, maximum=5.0
    )
    max_circumradius_m: float = parameter(
        6.0, "Facets with a wider circumcircle bridge a gap in the data.", unit="m", minimum=1.0, maximum=30.0
    )
    wall_m: float = parameter(2.0, "MX_zdiff from which a facet is a wall.", unit="m", minimum=0.5, maximum=10.0)
    wall_deg: float = parameter(
        55.0,
        "Flatter facets are not walls: where points lie metres apart, a pitched roof rises that far between them.",
        unit="deg",
        minimum=0.0,
        maximum=90.0,
    )
    steep_deg: float = parameter(
        70.0, "Facets steeper than this cut too, from steep_m on.", unit="deg", minimum=45.0, maximum=90.0
    )
    steep_m: float = parameter(
        1.0, "Least elevation difference of a facet that cuts by its slope.", unit="m", minimum=0.2, maximum=10.0
    )
    thin_m: float = parameter(
        1.75,
        "Objects lower than min_height_m and thinner than this, between ground on both sides, belong to no building: "
        "hedges and garden walls of a metre, and the distance to the ground points beside them. 0 keeps all.",
        unit="m",
        minimum=0.0,
        maximum=5.0,
    )
    step_height_m: float = parameter(
        2.0, "A wall whose foot stands this high above the terrain is a step.", unit="m", minimum=0.5, maximum=20.0
    )
    reach_m: float = parameter(
        1.0,
        "Points closer than this in elevation to a surface belong to it.",
        unit="m",
        minimum=0.1,
        maximum=5.0,
    )

    @property
    def support_m(self) -> float:
        """How far the facets of a fragment look: two facets, their circumcircles, and the cells of their vertices."""
        return 4.0 * self.max_circumradius_m + 3.0 * self.thinning_m

    @property
    def far_mm(self) -> int:
        """Farthest vertex that a point may refer to: a tile looks at all facets with a vertex this near its core."""
        return round(2 * self.thinning_m * 1000)


class StripSettings(Parameters):
    """What becomes of flight strips that do not fit each other."""

    warn_m: float = parameter(
        0.1,
        "Strips that lie farther above one another are named in a warning.",
        unit="m",
        minimum=0.02,
        maximum=10.0,
    )
    align_m: float = parameter(
        0.35,
        "Strips that lie farther above one another are moved to their common mean before anything else; those below "
        "are aligned building by building (min_strip_offset_m).",
        unit="m",
        minimum=0.05,
        maximum=10.0,
    )


class CandidateSettings(Parameters):
    """Conditions that make a surface a candidate."""

    min_object_area_m2: float = parameter(
        4.0,
        "Smaller surfaces are counted, not listed: crowns fall apart into thousands of them.",
        unit="m2",
        minimum=0.5,
        maximum=100.0,
    )
    min_area_m2: float = parameter(
        5.0, "Least plan area of a surface that is surely a roof.", unit="m2", minimum=1.0, maximum=1000.0
    )
    sure_planar_share: float = parameter(
        0.75,
        "Share of vertices with planar surroundings from which a surface is surely a roof.",
        minimum=0.0,
        maximum=1.0,
    )
    max_slenderness: float = parameter(
        3.0,
        "Largest height over mean width of a small surface that is surely a roof.",
        minimum=0.5,
        maximum=100.0,
    )
    doubtful_area_m2: float = parameter(
        20.0, "Least plan area of a surface that is not surely a roof.", unit="m2", minimum=1.0, maximum=1000.0
    )
    min_height_m: float = parameter(
        2.0,
        "Least height above the terrain; for a pitched roof the ridge's height, estimated from the spread of heights.",
        unit="m",
        minimum=0.5,
        maximum=20.0,
    )
    min_width_m: float = parameter(
        2.0,
        "Least mean width, twice the area over the outline; half of it for a surface that is surely a roof.",
        unit="m",
        minimum=0.0,
        maximum=20.0,
    )
    min_planar_share: float = parameter(
        0.5, "Least share of vertices with planar surroundings.", minimum=0.0, maximum=1.0
    )
    max_canopy_share: float = parameter(
        0.35, "Largest share of earlier returns above the surface.", minimum=0.0, maximum=1.0
    )
    max_through_share: float = parameter(
        0.15,
        "Largest share of points whose pulses go on to a later return; more for narrow surfaces and for few points. A "
        "surface surely below it need not be planar.",
        minimum=0.01,
        maximum=1.0,
    )
    beam_m: float = parameter(
        0.1,
        "Added to that share per metre of mean width: the width of a pulse, half of which goes on at an edge.",
        unit="m",
        minimum=0.0,
        maximum=2.0,
    )
    min_smooth_share: float = parameter(
        0.2,
        "From this share of vertices with smooth surroundings on, a surface is a roof in spite of such pulses; more "
        "for few vertices.",
        minimum=0.01,
        maximum=1.0,
    )
    min_wall_share: float = parameter(0.15, "Least share of the outline that touches walls.", minimum=0.0, maximum=1.0)
    min_top_share: float = parameter(
        0.3,
        "Least share of the adjacent walls whose top the surface lies at (the Z_avg rule by surface).",
        minimum=0.0,
        maximum=1.0,
    )
    min_deck_end_share: float = parameter(
        0.6,
        "A surface that is level with the ground along two opposite ends, over this share of them, is the deck of a "
        "bridge; 2 rejects none.",
        minimum=0.1,
        maximum=2.0,
    )
    max_vehicle_width_m: float = parameter(
        2.55,
        "Largest width of vehicles, by law in the EU; 0 rejects none. Where points lie more than a quarter of it "
        "apart, widths are not known well enough.",
        unit="m",
        minimum=0.0,
        maximum=5.0,
    )
    min_vehicle_length_m: float = parameter(
        4.0, "Least length of vehicles that are as high as buildings.", unit="m", minimum=1.0, maximum=20.0
    )
    max_vehicle_height_m: float = parameter(
        4.2,
        "Largest height of vehicles: 4 m by law in the EU, and the error of the terrain.",
        unit="m",
        minimum=1.0,
        maximum=10.0,
    )
    min_vehicle_open_share: float = parameter(
        0.9,
        "Least share of the outline of vehicles that stands free: what is beside it reaches less than two thirds of "
        "its height.",
        minimum=0.0,
        maximum=1.0,
    )
    unite_share: float = parameter(
        0.5,
        "A surface with at least this share of its outline along steps joins the largest roof beside them.",
        minimum=0.1,
        maximum=1.0,
    )
    unite_reach_m: float = parameter(
        3.0, "Largest distance to this roof, between the bounding boxes of both.", unit="m", minimum=0.0, maximum=50.0
    )


class UnitSettings(Parameters):
    """How touching buildings are separated."""

    split: str = parameter(
        "ridges",
        "Places at which a candidate is split into units: none, steps, or steps and valleys between parallel ridges.",
        choices=("nothing", "steps", "ridges"),
    )
    min_step_m: float = parameter(0.2, "Least step between the roofs of two units.", unit="m", minimum=0.1, maximum=5.0)
    min_ridge_step_m: float = parameter(
        0.06,
        "Least mean step between two units of one gable roof; both slopes step there, by about the same amount.",
        unit="m",
        minimum=0.05,
        maximum=5.0,
    )
    min_area_m2: float = parameter(
        25.0, "Least plan area of a unit; smaller ones join a neighbour.", unit="m2", minimum=1.0, maximum=1000.0
    )
    enclosed_share: float = parameter(
        0.5,
        "A unit with at least this share of its outline against one other joins it, as towers do.",
        minimum=0.1,
        maximum=1.0,
    )
    annex_share: float = parameter(
        0.4,
        "A unit below this share of the area of its only neighbour joins it if its top lies below that one's middle.",
        minimum=0.0,
        maximum=1.0,
    )


OTHER = 255
"""Replaces a producer's own code for other things, and an ASPRS code that the user took out of its list."""


class ClassCodeSettings(Parameters):
    """Meaning of the codes in the file; points with a code in no list are undecided."""

    ground: tuple[int, ...] = parameter((2,), "Codes that mean ground.", minimum=0, maximum=255)
    building: tuple[int, ...] = parameter((6,), "Codes that mean building.", minimum=0, maximum=255)
    vegetation: tuple[int, ...] = parameter((3, 4, 5), "Codes that mean vegetation.", minimum=0, maximum=255)
    noise: tuple[int, ...] = parameter(
        (7, 18), "Codes that mean noise: such points are left out for any value of `classes`.", minimum=0, maximum=255
    )
    undecided: tuple[int, ...] = parameter(
        (0, 1, 12, 19),
        "Codes without information: such points are judged by their own evidence, as are points with codes in no list.",
        minimum=0,
        maximum=255,
    )
    other: tuple[int, ...] = parameter(
        (8, 9, 10, 11, 13, 14, 15, 16, 17, 20, 21, 22, 26, OTHER),
        "Codes of other things, such as water, roads, wires and bridges (26 in the Netherlands), which are never roof.",
        minimum=0,
        maximum=255,
    )

    @classmethod
    def role(cls, code: int) -> str:
        """What an ASPRS code means to a run: the name of its list, or `undecided`.

        >>> [ClassCodeSettings.role(code) for code in (2, 6, 9, 28, OTHER)]
        ['ground', 'building', 'other', 'undecided', 'other']
        """
        lists: dict[str, tuple[int, ...]] = dataclasses.asdict(cls())
        return next((name for name, codes in lists.items() if code in codes), "undecided")

    def cross_faults(self) -> list[str]:
        """A code means one thing; the default of `other` gives way to other lists."""
        groups: dict[int, list[str]] = {}
        for name, codes in dataclasses.asdict(self).items():
            is_default = name == "other" and codes == type(self).__dataclass_fields__["other"].default
            for code in dict.fromkeys(codes) if isinstance(codes, tuple) and not is_default else ():
                groups.setdefault(code, []).append(name)
        return [
            f"code {code} is {' and '.join(names)}: give it in one list"
            for code, names in sorted(groups.items())
            if len(names) > 1
        ]

    @property
    def table(self) -> tuple[int, ...] | None:
        """The ASPRS code of each of the 256 codes; None if all keep their own meaning.

        >>> ClassCodeSettings().table is None
        True
        >>> table = ClassCodeSettings(building=(67,)).table
        >>> table[67], table[6], table[9], table[28]
        (6, 255, 9, 28)
        """
        asprs: dict[str, tuple[int, ...]] = dataclasses.asdict(ClassCodeSettings())
        table = list(range(256))
        for codes in asprs.values():
            for code in codes:
                table[code] = OTHER
        # `other` first, whose default gives way to other lists
        for name, codes in reversed(asprs.items()):
            for code in getattr(self, name):
                table[code] = code if code in codes else OTHER if name == "other" else codes[0]
        return None if table == list(range(256)) else tuple(table)


APRON_M = 6
"""Width in metres of the terrain that a tile stores beyond its core."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassesInUse:
    """Which of the file's classes are believed, decided once for a run."""

    ground: bool = False
    """Class 2 is the ground; no filter runs."""
    building: bool = False
    """Class 6 is building, classes that exclude buildings are believed, the rest is judged by its own evidence."""
    vegetation: bool = False
    """Classes 3 to 5 are vegetation; neither it nor other things, such as water, are ever part of a building."""
    roofs: bool = False
    """Class 6 is never ground, although the ground is found in the points."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """The settings of the stages between a tile's points and its candidates."""

    outliers: OutlierSettings = dataclasses.field(default_factory=OutlierSettings)
    ground: GroundSettings = dataclasses.field(default_factory=GroundSettings)
    vegetation: VegetationSettings = dataclasses.field(default_factory=VegetationSettings)
    surfaces: SurfaceSettings = dataclasses.field(default_factory=SurfaceSettings)
    candidates: CandidateSettings = dataclasses.field(default_factory=CandidateSettings)
    units: UnitSettings = dataclasses.field(default_factory=UnitSettings)
    strips: StripSettings = dataclasses.field(default_factory=StripSettings)

    @property
    def support_m(self) -> float:
        """Farthest in metres that points beyond its core matter to a tile: where it looks, and whether those count."""
        return self.split_support_m(footprints=False) + self.outliers.support_m

    def split_support_m(self, *, footprints: bool) -> float:
        """How far in metres the split of a tile looks at points beyond its core.

        A fragment depends on the facets around it, and these on the planarity of their vertices. Points in given
        footprints are taken one by one, without a TIN.
        """
        return 0.0 if footprints else self.surfaces.support_m + self.vegetation.support_m

    def terrain_m(self, *, footprints: bool) -> float:
        """How far beyond the core the split needs terrain, in metres: at all points that it looks at."""
        return max(float(APRON_M), self.split_support_m(footprints=footprints))

    def ground_support_m(self, classes: ClassesInUse) -> float:
        """How far in metres a terrain elevation looks at the lowest points of cells.

        It looks as far as the ground filter. With class 2 as ground no filter runs, only planes are drawn.
        """
        return self.ground.trusted_support_m if classes.ground else self.ground.support_m
