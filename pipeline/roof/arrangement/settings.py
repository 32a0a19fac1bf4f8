"""Settings of the arrangement: how labels become lines, and cells become roof faces."""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArrangementSettings(Parameters):
    """What a roof face costs against what it explains."""

    residual_cap_m: float = parameter(
        0.3,
        "A point farther than this from a plane is not explained by it.",
        unit="m",
        minimum=0.05,
        maximum=5.0,
    )
    border_cost: float = parameter(
        0.3,
        "Unexplained points that a border of the length of one point spacing must save.",
        unit="points",
        minimum=0.0,
        maximum=100.0,
    )
    face_cost: float = parameter(
        3.0, "Misfitting points that a roof face must save.", unit="points", minimum=0.0, maximum=1000.0
    )
    face_area_m2: float = parameter(
        2.0,
        "A roof face must save at least the points that fall on this area.",
        unit="m2",
        minimum=0.0,
        maximum=100.0,
    )
    raster_cell_m: float = parameter(
        0.35, "Cell of the coarse labels; at least one point spacing.", unit="m", minimum=0.1, maximum=5.0
    )
    line_length_m: float = parameter(
        0.7, "Shorter borders of the coarse labels give no line.", unit="m", minimum=0.1, maximum=20.0
    )
    line_reach_m: float = parameter(0.6, "How far beyond its border a line cuts.", unit="m", minimum=0.0, maximum=20.0)
    overshoot_m: float = parameter(
        0.5,
        "A plane that goes farther than this beyond the heights of its points is unlikely there; at least one point "
        "spacing.",
        unit="m",
        minimum=0.1,
        maximum=100.0,
    )
