"""Settings of the arrangement: how labels become lines, and cells become roof faces."""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter

_CELL_SPACINGS = 1.2
_MIN_CELL_M = 0.25
"""A superstructure of a metre has four such cells a side."""


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
        "A roof face must save at least the points that fall on this area, or those of `face_points`.",
        unit="m2",
        minimum=0.0,
        maximum=100.0,
    )
    face_points: float = parameter(
        18.0,
        "So many points are enough where a roof face explains all its own; a place of about four by four spacings.",
        unit="points",
        minimum=0.0,
        maximum=10_000.0,
    )
    raster_cell_m: float = parameter(
        0.35,
        "Cell of the coarse labels; at least one point spacing. Of dense points 1.2 spacings, at least 0.25 m.",
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
        """Misfitting points that a face must save that explains all its own points, and one that explains half.

        Evidence is counted in points, but what misfits a roof lies in heaps: a pipe, a crown, a parapet has the more
        points the denser they lie. So the cost of a face grows with the density as long as that is all there is to
        say; dense points say more, for they tell a plane from a heap.

        Examples
        --------
        >>> [ArrangementSettings().costs_of_face(density) for density in (1.0, 6.5, 40.0)]
        [(3.0, 3.0), (16.25, 16.25), (18.0, 100.0)]
        """
        by_area = max(self.face_cost, self.face_area_m2 * points_per_m2)
        return max(self.face_cost, min(by_area, self.face_points)), by_area
