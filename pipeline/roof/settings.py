"""Settings of the way from labelled points to solids."""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofSettings(Parameters):
    """How roof planes become roof faces and closed solids."""

    min_points: int = parameter(10, "A candidate with fewer roof points is not modelled.", minimum=3, maximum=1000)
    min_points_in_footprint: int = parameter(
        4, "The same where the footprint is given: few points then tell a simple roof.", minimum=3, maximum=1000
    )
    max_points: int = parameter(4_000_000, "A candidate with more points is refused as too complex.", minimum=1000)
    min_roof_height_m: float = parameter(
        1.5, "Points lower than this above the floor are no roof points.", unit="m", minimum=0.2, maximum=10.0
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
        "Where on the way from a roof point to the nearest empty place the eave lies, without a footprint.",
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
        "Where the outline lies without a footprint: at the eaves, or at the walls that points beneath the eaves show.",
        choices=("eaves", "walls"),
    )
    usual_overhang_m: float = parameter(
        0.0,
        "With outline = walls: how far eaves hang over where no point tells of any wall of a building.",
        unit="m",
        minimum=0.0,
        maximum=1.0,
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
    eave_tolerance_spacings: float = parameter(
        1.2,
        "How far the raw outline may lie from its straight lines.",
        unit="point spacings",
        minimum=0.2,
        maximum=5.0,
    )
    straight_borders: bool = parameter(True, "Whether borders between roof faces are drawn with straight lines.")
    border_tolerance_spacings: float = parameter(
        0.65,
        "How far a border between roof faces may lie from its straight lines.",
        unit="point spacings",
        minimum=0.1,
        maximum=5.0,
    )
    square_within_deg: float = parameter(
        12.0,
        "An outline's line takes the dominant direction, or the one square to it, when it is this close.",
        unit="deg",
        minimum=0.0,
        maximum=30.0,
    )
    void_distance_m: float = parameter(
        4.0,
        "Inside a given footprint a place farther than this from every roof point is no roof.",
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
        0.4,
        "A roof face that comes nearer to the floor than this becomes horizontal.",
        unit="m",
        minimum=0.05,
        maximum=5.0,
    )
    max_overshoot_m: float = parameter(
        2.0,
        "A roof face that goes farther than this above or below the points of its plane becomes horizontal.",
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
