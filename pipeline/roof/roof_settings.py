"""Settings of the roof: from planes to roof faces and solids, the arrangement of faces, the roof types."""

from __future__ import annotations

from pipeline.parameters import Parameters, parameter

_CELL_SPACINGS = 1.2
_GUIDE_SPACINGS = 0.4
GUIDE_REACH_M = 2.0
"""Guides within this distance of the box of a building's points concern it: no line moves farther to a guide."""
"""A cell of dense points then holds one or two of them."""
_MIN_CELL_M = 0.25
"""A superstructure of a metre has four such cells per side."""


class RoofSettings(Parameters):
    """How roof planes become roof faces and closed solids."""

    min_points: int = parameter(10, "A candidate with fewer roof points is not modelled.", minimum=3, maximum=1000)
    min_points_in_footprint: int = parameter(
        4, "The same where the footprint is given: a few points then show a simple roof.", minimum=3, maximum=1000
    )
    max_points: int = parameter(4_000_000, "A candidate with more points is refused as too complex.", minimum=1000)
    min_strip_offset_m: float = parameter(
        0.1,
        "Flight strips that disagree by more at a building are aligned there; the elevations over the roofs that both"
        " saw, root mean square.",
        unit="m",
        minimum=0.03,
        maximum=10.0,
    )
    min_roof_height_m: float = parameter(
        1.5,
        "Points lower than this above the floor are not roof points, except in a given footprint.",
        unit="m",
        minimum=0.2,
        maximum=10.0,
    )
    gap_spacings: float = parameter(
        1.5,
        "A place farther than this from every roof point is not roof.",
        unit="point spacings",
        minimum=0.7,
        maximum=5.0,
    )
    outside_fraction: float = parameter(
        0.21,
        "Place of the eave on the way from a roof point to the nearest empty place, as a share, without a footprint.",
        minimum=0.05,
        maximum=0.95,
    )
    step_offset_spacings: float = parameter(
        0.5,
        "Distance of a high step edge from the outermost points of its upper face.",
        unit="point spacings",
        minimum=0.0,
        maximum=2.0,
    )
    outline: str = parameter(
        "eaves",
        "Outline without a footprint: at the eaves, or at the walls that points beneath the eaves show.",
        choices=("eaves", "walls"),
    )
    usual_overhang_m: float = parameter(
        0.0,
        "With outline = walls, and in LoD2.3: overhang of the eaves where no points show a wall of the building.",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    wall_outline: bool = parameter(
        False,
        "With outline = eaves: find the walls beneath as well, for the columns wall_outline and overhang_m; LoD2.3 does"
        " so, too.",
    )
    min_overhang_m: float = parameter(
        0.2,
        "LoD2.3: where the roof hangs over less, the wall goes up to the eaves.",
        unit="m",
        minimum=0.05,
        maximum=1.0,
        added=True,
    )
    beyond_footprint_m: float = parameter(
        0.0,
        "LoD2.3: overhang beyond given footprints, which are taken as the walls, where open ground lies before them.",
        unit="m",
        minimum=0.0,
        maximum=1.0,
        added=True,
    )
    overhang_thickness_m: float = parameter(
        0.2,
        "LoD2.3: vertical distance from the roof to the underside of an overhang; assumed, not measured.",
        unit="m",
        minimum=0.05,
        maximum=1.0,
        added=True,
    )
    superstructures: bool = parameter(
        False, "LoD2.2: chimneys and roof units above the roof faces become boxes of their own.", added=True
    )
    templates_spacing_m: float = parameter(
        0.6,
        "Arranged faces compete with simple roof shapes where points lie at least this far apart.",
        unit="m",
        minimum=0.0,
        maximum=100.0,
    )
    straight_eaves: bool = parameter(
        True, "Whether the outline is drawn with straight lines where no footprint is given."
    )
    outline_noise_spacings: float = parameter(
        0.4,
        "Standard deviation of the raw outline about its edges, for points at random: with less, the outline gets more"
        " edges.",
        unit="point spacings",
        minimum=0.05,
        maximum=2.0,
    )
    min_outline_noise_m: float = parameter(
        0.25,
        "The same at least, where points are dense: gutters and plants make an eave as ragged. Small houses show finer"
        " edges.",
        unit="m",
        minimum=0.02,
        maximum=2.0,
    )
    straight_borders: bool = parameter(True, "Whether borders between roof faces are drawn with straight lines.")
    void_distance_m: float = parameter(
        4.0,
        "Inside a given footprint a place farther than this from every roof point is not roof.",
        unit="m",
        minimum=0.5,
        maximum=100.0,
    )
    min_face_area_m2: float = parameter(
        0.6, "A smaller roof face joins a neighbour.", unit="m2", minimum=0.05, maximum=100.0
    )
    min_face_spacings2: float = parameter(
        2.0,
        "A roof face smaller than this many squared point spacings joins a neighbour.",
        unit="squared point spacings",
        minimum=0.0,
        maximum=100.0,
    )
    min_void_m2: float = parameter(6.0, "A smaller gap in a roof is closed.", unit="m2", minimum=0.0, maximum=1000.0)
    min_part_area_m2: float = parameter(
        4.0, "A smaller separate part of a building is left out.", unit="m2", minimum=0.0, maximum=100.0
    )
    simplification_spacings: float = parameter(
        0.8,
        "Border vertices are dropped while the area cut off stays under the square of this.",
        unit="point spacings",
        minimum=0.0,
        maximum=3.0,
    )
    min_clearance_m: float = parameter(
        0.1,
        "A roof face is level where it would come nearer to the floor than this.",
        unit="m",
        minimum=0.05,
        maximum=5.0,
    )
    max_overshoot_m: float = parameter(
        2.0,
        "A slope that goes farther than this below its points is level from there on. Other forms are tried first if a "
        "face goes farther than this above or below the points of its plane.",
        unit="m",
        minimum=0.1,
        maximum=100.0,
    )
    block_height_percentile: float = parameter(
        70.0,
        "Height of a block and of each level part: this percentile of its roof points.",
        unit="%",
        minimum=1.0,
        maximum=100.0,
    )
    level_step_m: float = parameter(
        2.0,
        "LoD1.3: roof faces with a lower step between them are one level part.",
        unit="m",
        minimum=0.1,
        maximum=50.0,
    )

    @property
    def at_walls(self) -> bool:
        """Whether outlines are drawn back to the walls; that takes straight lines."""
        return self.outline == "walls" and self.straight_eaves

    @property
    def finds_walls(self) -> bool:
        """Whether the walls beneath outlines at the eaves are found for the records."""
        return self.wall_outline and self.straight_eaves and not self.at_walls

    def needs_facades(self, *, is_drawn: bool, is_given: bool = False) -> bool:
        """Whether a candidate needs the points around and beneath it.

        `is_drawn` if it has an outline already, `is_given` if its footprint is given.
        """
        if is_given:
            return self.finds_walls and self.beyond_footprint_m > 0.0
        return self.finds_walls or (self.at_walls and not is_drawn)


class ArrangementSettings(Parameters):
    """Costs of roof faces against the points that they explain."""

    residual_cap_m: float = parameter(
        0.3,
        "A point farther than this from a plane is not explained by it.",
        unit="m",
        minimum=0.05,
        maximum=5.0,
    )
    border_cost: float = parameter(
        0.2,
        "Unexplained points that a border of the length of one point spacing must save.",
        unit="points",
        minimum=0.0,
        maximum=100.0,
    )
    face_cost: float = parameter(
        3.0, "Misfitting points that a roof face must save.", unit="points", minimum=0.0, maximum=1000.0
    )
    face_area_m2: float = parameter(
        2.5,
        "A roof face must save at least the points that fall on this area, or `face_points`.",
        unit="m2",
        minimum=0.0,
        maximum=100.0,
    )
    face_points: float = parameter(
        18.0,
        "This many points are enough for a roof face that explains all its own: about four by four spacings.",
        unit="points",
        minimum=0.0,
        maximum=10_000.0,
    )
    corner_share: float = parameter(
        0.5,
        "Misfitting points that a corner of the borders must save, as a share of a roof face's; 0 keeps all.",
        minimum=0.0,
        maximum=10.0,
    )
    corner_gap_m: float = parameter(
        0.2, "Roof planes whose heights differ by less make one corner together.", unit="m", minimum=0.0, maximum=2.0
    )
    corner_reach_m: float = parameter(
        0.7, "How far a corner of three or more borders moves to join another.", unit="m", minimum=0.0, maximum=5.0
    )
    plane_shift_m: float = parameter(
        0.15,
        "How far a plane may move to meet its neighbours in their corners, root mean square over its points.",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    min_face_width_m: float = parameter(
        0.5,
        "A narrower sliver is not a roof face: gutters, low rims, the smeared edge of a wall. A parapet on the outline "
        "stays.",
        unit="m",
        minimum=0.0,
        maximum=2.0,
    )
    raster_cell_m: float = parameter(
        0.35,
        "Cell of the coarse labels, at least one point spacing; for dense points 1.2 spacings, at least 0.25 m.",
        unit="m",
        minimum=0.1,
        maximum=5.0,
    )
    line_length_m: float = parameter(
        0.5, "Shorter borders of the coarse labels give no line.", unit="m", minimum=0.1, maximum=20.0
    )
    line_reach_m: float = parameter(0.6, "How far beyond its border a line cuts.", unit="m", minimum=0.0, maximum=20.0)
    overshoot_m: float = parameter(
        0.5,
        "A plane that goes farther than this beyond the heights of its points, or of all points around a corner of a "
        "roof face, is unlikely there; at least one point spacing.",
        unit="m",
        minimum=0.1,
        maximum=100.0,
    )

    def raster_cell_of(self, spacing_m: float) -> float:
        """Cell of the coarse labels for a spacing, metres.

        Examples
        --------
        >>> [ArrangementSettings().raster_cell_of(spacing_m) for spacing_m in (0.1, 0.25, 0.3, 0.5)]
        [0.25, 0.3, 0.35, 0.5]
        """
        return max(min(self.raster_cell_m, max(_CELL_SPACINGS * spacing_m, _MIN_CELL_M)), spacing_m)

    def costs_of_face(self, points_per_m2: float) -> tuple[float, float]:
        """Misfitting points that a face must save: one that explains all its own points, and one that explains half.

        Evidence is counted in points, but points that misfit a roof lie in heaps: a pipe, a crown or a parapet has more
        points where they are denser. So the cost of a face grows with the density. A face that explains all its points
        needs no more than `face_points`, since dense points distinguish a plane from a heap.

        Examples
        --------
        >>> [ArrangementSettings().costs_of_face(density) for density in (1.0, 6.5, 40.0)]
        [(3.0, 3.0), (16.25, 16.25), (18.0, 100.0)]
        """
        by_area = max(self.face_cost, self.face_area_m2 * points_per_m2)
        return max(self.face_cost, min(by_area, self.face_points)), by_area


class GuideSettings(Parameters):
    """Given lines of roofs."""

    kind_column: str = parameter("kind", "Column of the file with the kinds of the lines.")
    distance_m: float = parameter(
        0.4,
        "How far a line of the points, or an edge of the outline, may lie from a guide that takes its place; at least "
        "0.4 point spacings.",
        unit="m",
        minimum=0.0,
        maximum=GUIDE_REACH_M,
    )

    def distance_of(self, spacing_m: float) -> float:
        """The distance for a spacing, metres.

        Examples
        --------
        >>> [GuideSettings().distance_of(spacing_m) for spacing_m in (0.5, 2.0)]
        [0.4, 0.8]
        """
        return max(self.distance_m, _GUIDE_SPACINGS * spacing_m)


class RoofTypeSettings(Parameters):
    """Thresholds of the roof types; they change no geometry."""

    flat_below_deg: float = parameter(
        7.0, "A roof plane with less slope is flat.", unit="deg", minimum=0.5, maximum=20.0
    )
    aspect_tolerance_deg: float = parameter(
        20.0,
        "Sides are opposite where their aspects are 180 degrees apart within this.",
        unit="deg",
        minimum=1.0,
        maximum=45.0,
    )
    slope_tolerance_deg: float = parameter(
        5.0,
        "Slopes of one direction bend where they differ by this (gambrels, mansards). Backs of saw teeth are steeper.",
        unit="deg",
        minimum=1.0,
        maximum=45.0,
    )
    sliver_height_m: float = parameter(
        0.5,
        "Roof planes meet across a wall that is nowhere higher: fitted planes seldom meet in one line.",
        unit="m",
        minimum=0.0,
        maximum=5.0,
    )
    minor_share: float = parameter(
        0.12,
        "An opposite side, or wings, with a smaller share of the main roof do not decide its type.",
        minimum=0.0,
        maximum=0.4,
    )
    minor_share_together: float = parameter(
        0.20,
        "If all faces that do not decide have this share of the roof's area, the roof is a combination.",
        minimum=0.0,
        maximum=1.0,
    )


class FootprintSettings(Parameters):
    """Columns of the given footprints that hold heights; used only where points give no model, or no ground."""

    height: str = parameter(
        "", "Column with the height of a building above its ground, in the vertical unit of the run's CRS."
    )
    roof_elevation: str = parameter(
        "", "Column with the elevation of its roof, in the vertical unit and datum of the run's CRS."
    )
    storeys: str = parameter("", "Column with its number of storeys above ground.")
    storey_height_m: float = parameter(3.0, "Height of a storey.", unit="m", minimum=1.0, maximum=10.0)
    ground_elevation: str = parameter(
        "", "Column with the elevation of its ground, like `roof_elevation`; points of the ground come first."
    )

    @property
    def columns(self) -> dict[str, str]:
        """The columns that are named, by setting."""
        names = ("height", "roof_elevation", "storeys", "ground_elevation")
        return {name: getattr(self, name) for name in names if getattr(self, name)}
