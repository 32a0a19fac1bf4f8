"""Settings of party walls."""

from __future__ import annotations

from pipeline.parameters import Parameters, parameter


class PartyWallSettings(Parameters):
    """When two walls touch."""

    max_distance_m: float = parameter(
        0.1, "Walls touch where they are at most this far apart, or overlap by as much.", unit="m", minimum=0.0,
        maximum=5.0,
    )  # fmt: skip
    max_angle_deg: float = parameter(
        5.0, "Largest angle between the planes of two walls that touch.", unit="deg", minimum=0.0, maximum=30.0
    )
    min_area_m2: float = parameter(0.1, "Smaller contacts do not count.", unit="m2", minimum=0.0, maximum=100.0)
