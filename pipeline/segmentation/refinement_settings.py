"""Settings of the refinement of rough clusters and of region growing. No kernels here."""

from __future__ import annotations

from pipeline.parameters import Parameters, parameter

_GRID_M = 1e-3
"""Resolution of the points: a distance to a plane is never less, even if settings and noise are 0."""


class RegionGrowingSettings(Parameters):
    """Settings of region growing."""

    growing_neighbours: int = parameter(
        9, "Nearest points over which a region grows.", unit="points", minimum=3, maximum=64
    )
    growing_noises: float = parameter(
        3.0,
        "Distance up to which a region takes points, in standard deviations of the noise.",
        minimum=0.1,
        maximum=100.0,
    )
    min_growing_m: float = parameter(0.15, "Least such distance.", unit="m", minimum=0.001, maximum=10.0)
    max_growing_m: float = parameter(0.30, "Largest such distance.", unit="m", minimum=0.001, maximum=10.0)
    agreeing_share: float = parameter(
        0.4,
        "A point joins where at least this share of its neighbours lies as near to the plane.",
        minimum=0.0,
        maximum=1.0,
    )
    free_plane_points: int = parameter(
        8, "Points from which on a region has a plane of its own, in place of its cluster's direction.", unit="points",
        minimum=4, maximum=10_000,
    )  # fmt: skip

    def cross_faults(self) -> list[str]:
        """The distances must be a range."""
        return [*super().cross_faults(), *self.range_faults("min_growing_m", "max_growing_m")]

    def growing_distance_m(self, sigma_m: float) -> float:
        """Distance of a point from its plane for a noise."""
        return min(max(self.growing_noises * sigma_m, self.min_growing_m), self.max_growing_m)


class PlaneRefinementSettings(Parameters):
    """Settings of the refinement; the paper publishes none of them."""

    rounds: int = parameter(5, "Rounds of regression, merging and assignment.", unit="rounds", minimum=1, maximum=50)
    voting_passes: int = parameter(4, "Passes of assignment a round.", unit="passes", minimum=1, maximum=50)
    vote_weight: float = parameter(
        0.04, "Share of the largest squared distance that one vote of a neighbour outweighs.", minimum=0.0, maximum=1.0
    )
    assignment: str = parameter(
        "neighbours",
        "Planes that a point chooses among: its neighbours' planes, or all planes of the building (the nearest).",
        choices=("neighbours", "all_planes"),
    )
    min_area_m2: float = parameter(
        1.5,
        "A plane has at least as many points as this area holds in plan, within the two bounds below.",
        unit="m2",
        minimum=0.0,
        maximum=1000.0,
    )
    min_points: int = parameter(6, "Fewest points of a plane, however sparse the cloud.", minimum=3, maximum=10_000)
    max_min_points: int = parameter(
        25, "Points that make a plane, however dense the cloud.", minimum=3, maximum=100_000
    )
    max_slope_deg: float = parameter(
        70.0, "Planes steeper than this are not roof.", unit="deg", minimum=1.0, maximum=89.0
    )
    outlier_factor: float = parameter(
        2.0,
        "Points beyond this many times the threshold leave their cluster before it is fitted again.",
        minimum=1.0,
        maximum=100.0,
    )
    merge_residual_m: float = parameter(
        0.10,
        "Two clusters are one plane where it adds less systematic residual than this to both.",
        unit="m",
        minimum=0.0,
        maximum=10.0,
    )
    merge_angle_deg: float = parameter(
        12.0,
        "Largest angle between two planes that merge; twice as much for small clusters.",
        unit="deg",
        minimum=0.0,
        maximum=45.0,
    )
    small_cluster_points: int = parameter(
        15, "Clusters with fewer points have a poorly known plane.", minimum=3, maximum=10_000
    )
    merge_reach_m: float = parameter(
        10.0,
        "Parts of one plane that do not touch merge up to this distance of their boxes in plan.",
        unit="m",
        minimum=0.0,
        maximum=1e6,
    )
    plane_cost: float = parameter(
        6.0,
        "A plane stays if without it this many points more would be unexplained; a point that another plane explains "
        "badly counts in part.",
        unit="points",
        minimum=0.0,
        maximum=1e6,
    )
    refinement_work_limit: int = parameter(
        200_000_000,
        "Comparisons of planes with planes, and of points with all planes, after which a building is too complex.",
        minimum=1,
        maximum=10**15,
    )
    min_plane_distance_m: float = parameter(
        0.15, "Least distance up to which a point belongs to a plane.", unit="m", minimum=0.0, maximum=10.0
    )
    max_plane_distance_m: float = parameter(0.30, "Largest such distance.", unit="m", minimum=0.0, maximum=10.0)
    noise_factor: float = parameter(
        3.0,
        "Distances that follow the noise are this many standard deviations of it, within their bounds.",
        minimum=0.0,
        maximum=100.0,
    )
    neighbours: int = parameter(
        9, "Nearest points whose planes a point chooses among.", unit="points", minimum=3, maximum=64
    )
    leftover_rounds: int = parameter(
        2,
        "Rounds of refinement with clusters that grow among the points no plane explains; 0 for none (as the papers).",
        unit="rounds",
        minimum=0,
        maximum=50,
    )
    ridge_reach_spacings: float = parameter(
        1.5, "Distance in plan up to which points are near a ridge, in mean point spacings.", minimum=0.0, maximum=10.0
    )

    def cross_faults(self) -> list[str]:
        """Bounds must be ranges."""
        return [
            *super().cross_faults(),
            *self.range_faults("min_points", "max_min_points"),
            *self.range_faults("min_plane_distance_m", "max_plane_distance_m"),
        ]

    def fewest_points(self, spacing_m: float) -> int:
        """Fewest points of a plane at a mean spacing in plan."""
        if spacing_m * spacing_m * self.max_min_points <= self.min_area_m2:
            return self.max_min_points
        points = self.min_area_m2 / (spacing_m * spacing_m)
        return int(min(max(points, self.min_points), self.max_min_points))

    def plane_distance_m(self, sigma_m: float) -> float:
        """Distance of a point from its plane for a noise; at least 1 mm, the grid of the points."""
        bounded = min(max(self.noise_factor * sigma_m, self.min_plane_distance_m), self.max_plane_distance_m)
        return max(bounded, _GRID_M)
