"""Settings of the methods, and their presets. No kernels here: settings are read without them.

The defaults are what measured better; `faithful()` keeps to the method's paper, as far as it is printed.
"""

from __future__ import annotations

from pipeline.extras.papers.clustering_settings import (
    ClusterMembershipSettings,
    FuzzySartClusteringSettings,
    NormalClusteringSettings,
    ParameterBoxSettings,
    RoofTreeSettings,
    SingleLinkageSettings,
)
from pipeline.parameters import Parameters, parameter
from pipeline.segmentation.refinement_settings import PlaneRefinementSettings, RegionGrowingSettings


class RoofFaceSettings(Parameters):
    """How the planes of a method become roof faces; a method without this setting arranges them.

    No paper says how the borders of roof faces are drawn: they end with planes, clusters or labelled points. Borders
    traced between the labels keep the method's label of every point. An arrangement of the lines in which planes meet
    (`roof.arrangement`) fills the outline with the faces that explain the points best.
    """

    faces: str = parameter(
        "arranged",
        "How the plan is cut into roof faces: along the lines in which the planes meet, or between the labels of the "
        "points.",
        choices=("arranged", "traced"),
    )


class FuzzySartSettings(RoofFaceSettings, FuzzySartClusteringSettings, PlaneRefinementSettings):
    """Settings of the recipe; those of the clustering, of the refinement and of the roof faces are among them."""

    absorption: str = parameter(
        "bucket",
        "Absorbed points are kept in their facet, or inserted at its elevation (the paper's way, slower).",
        choices=("bucket", "insert"),
    )
    min_absorption_m: float = parameter(
        0.10, "Least distance up to which a facet absorbs points (Eq. 1).", unit="m", minimum=0.0, maximum=10.0
    )
    max_absorption_m: float = parameter(0.30, "Largest such distance.", unit="m", minimum=0.0, maximum=10.0)
    max_absorption_slope_deg: float = parameter(
        60.0, "Facets that are steeper absorb nothing (Eq. 2) and are not roof.", unit="deg", minimum=1.0, maximum=89.0
    )
    ground_gap_spacings: float = parameter(
        1.3,
        "Terrain samples nearer to a roof point than this many mean point spacings count as beneath the roof.",
        minimum=0.0,
        maximum=100.0,
    )
    min_ground_gap_m: float = parameter(
        1.0, "Terrain samples nearer to a roof point than this count so too.", unit="m", minimum=0.01, maximum=100.0
    )
    height_rule: str = parameter(
        "separated",
        "Which facets can be roof: those that touch no terrain, or those above the Z_avg of the scene.",
        choices=("separated", "scene"),
    )
    wall_height_m: float = parameter(
        2.0, "Elevation difference from which a facet is a wall, for Z_avg.", unit="m", minimum=0.0, maximum=100.0
    )
    split_by_connectivity: bool = parameter(
        True, "Whether a cluster is cut into the parts that hang together in the TIN."
    )

    @classmethod
    def faithful(cls) -> FuzzySartSettings:
        """The paper's words: scaled spherical vectors, V = 0.7, 0.2 m and 60 degrees, Z_avg, fixed thresholds."""
        return cls(
            vectors="spherical_scaled",
            vigilance=0.7,
            absorption="insert",
            min_absorption_m=0.2,
            max_absorption_m=0.2,
            min_plane_distance_m=0.2,
            max_plane_distance_m=0.2,
            height_rule="scene",
            split_by_connectivity=False,
            assignment="all_planes",
            rounds=1,
            leftover_rounds=0,
            faces="traced",
        )

    def cross_faults(self) -> list[str]:
        """Bounds must be ranges."""
        return [*super().cross_faults(), *self.range_faults("min_absorption_m", "max_absorption_m")]

    def absorption_distance_m(self, sigma_m: float) -> float:
        """Distance of Eq. 1 for a noise."""
        return min(max(self.noise_factor * sigma_m, self.min_absorption_m), self.max_absorption_m)


class ParameterSpaceSettings(RoofFaceSettings, RegionGrowingSettings, RoofTreeSettings):
    """Settings that both methods share."""

    tin_spacing_m: float = parameter(
        0.7,
        "The TIN takes one roof point a square of this size, since noise tilts the facets of a dense cloud most; "
        "0 takes all.",
        unit="m",
        minimum=0.0,
        maximum=10.0,
    )
    surroundings_m: float = parameter(
        5.0, "Terrain takes part up to this distance from the roof's points.", unit="m", minimum=0.0, maximum=1000.0
    )
    ground_gap_spacings: float = parameter(
        0.7,
        "Terrain samples nearer to a roof point than this many mean point spacings count as beneath the roof.",
        minimum=0.01,
        maximum=100.0,
    )
    ground_clusters: str = parameter(
        "leave_out",
        "Clusters of terrain and walls: all kept but those that the paper eliminates; dropped where fewer than half of "
        "their facets touch roof points alone; or facets that touch terrain not clustered at all.",
        choices=("keep", "drop", "leave_out"),
    )
    point_groups: str = parameter(
        "region_growing",
        "Points of a roof face: the points of a cluster's facets, or a region grown from its mean.",
        choices=("membership", "region_growing"),
    )
    growing_vote: float = parameter(
        0.04,
        "Between regions a point takes the nearer plane; share of the largest squared distance that one neighbour's "
        "vote outweighs.",
        minimum=0.0,
        maximum=1.0,
    )
    min_area_m2: float = parameter(
        3.0, "A region has at least as many points as this area holds in plan.", unit="m2", minimum=0.0, maximum=1000.0
    )
    min_points: int = parameter(
        5, "Fewest points of a roof face, however sparse the cloud.", unit="points", minimum=3, maximum=10_000
    )
    type_from: str = parameter(
        "faces",
        "Source of the roof type: the paper's decision tree, or the rule over the delivered faces.",
        choices=("tree", "faces"),
    )


class ParameterSpace2dSettings(ParameterSpaceSettings, SingleLinkageSettings):
    """Settings of the method in slope and orientation."""

    min_slope_deg: float = parameter(
        0.0, "Clusters with less mean slope are not roof.", unit="deg", minimum=0.0, maximum=90.0
    )
    max_slope_deg: float = parameter(
        75.0, "Clusters with more mean slope are not roof.", unit="deg", minimum=0.0, maximum=90.0
    )

    @classmethod
    def faithful(cls) -> ParameterSpace2dSettings:
        """The paper's words: terrain is clustered too, at least 11 facets, points by membership, its own tree."""
        return cls(
            tin_spacing_m=0.0,
            ground_clusters="keep",
            min_slope_deg=7.0,
            min_members=11,
            point_groups="membership",
            type_from="tree",
            faces="traced",
        )


class ParameterSpace3dSettings(ParameterSpaceSettings, ParameterBoxSettings, ClusterMembershipSettings):
    """Settings of the method in slope, orientation and O-distance."""

    @classmethod
    def faithful(cls) -> ParameterSpace3dSettings:
        """The paper's words: terrain is clustered too, at least 11 facets, points by membership, its own tree."""
        return cls(
            tin_spacing_m=0.0,
            ground_clusters="keep",
            dense_box_facets=5,
            min_members=11,
            point_groups="membership",
            type_from="tree",
            faces="traced",
        )


class KMeansSettings(RoofFaceSettings, NormalClusteringSettings, PlaneRefinementSettings):
    """Settings of the recipe; those of the clustering, of the refinement and of the roof faces are among them."""

    longest_edge_spacings: float = parameter(
        4.0,
        "Facets with a longer edge in plan, in mean point spacings, bridge gaps and are left out; 0 keeps all.",
        minimum=0.0,
        maximum=1000.0,
    )
    normal_noise_deg: float = parameter(
        6.0,
        "Normals are averaged over the facets around until the noise turns them by about this angle.",
        unit="deg",
        minimum=0.1,
        maximum=45.0,
    )
    smoothing_passes: int = parameter(
        6, "Most passes of that, by one ring of facets each; 0 for none (as the paper).", minimum=0, maximum=100
    )
    refine: bool = parameter(
        True,
        "Whether clusters are split where they do not hang together, merged where they are one plane, and their points "
        "reassigned; without it there is one least-squares fit per cluster (as the paper).",
    )
    one_plane_deg: float = parameter(
        6.0,
        "Two planes of unrefined clusters with a smaller angle between them are one plane.",
        unit="deg",
        minimum=0.0,
        maximum=45.0,
    )
    min_plane_share: float = parameter(
        0.1,
        "An unrefined cluster with a smaller share of the points is not a roof plane.",
        minimum=0.0,
        maximum=0.5,
    )
    flat_below_deg: float = parameter(
        3.0, "The model of one plane is level below this slope, pent above.", unit="deg", minimum=0.0, maximum=45.0
    )
    model: str = parameter(
        "fitting",
        "When one or two planes become the paper's model: where it explains the building, always, or never.",
        choices=("fitting", "always", "never"),
    )
    outline: str = parameter(
        "footprint",
        "Whether a given footprint is kept, its roof drawn from the labels, or the model's rectangle is the outline.",
        choices=("footprint", "rectangle"),
    )
    min_side_share: float = parameter(
        0.5,
        "Share of a plane's points that must lie on its side of the line in which the two planes meet.",
        minimum=0.0,
        maximum=1.0,
    )
    margin_spacings: float = parameter(
        0.13,
        "By how much the rectangles go beyond the outermost points, in mean point spacings.",
        minimum=0.0,
        maximum=2.0,
    )
    model_distance_m: float = parameter(
        0.5,
        "Points farther than this above or below the model are not explained by it.",
        unit="m",
        minimum=0.0,
        maximum=100.0,
    )
    fitting_share: float = parameter(
        0.9,
        "The model explains a building where this share of its roof points lies within the distance of a plane.",
        minimum=0.0,
        maximum=1.0,
    )
    fitting_fill: float = parameter(
        0.9,
        "The model explains a building where this share of its rectangle has roof points near.",
        minimum=0.0,
        maximum=1.0,
    )
    fill_gap_spacings: float = parameter(
        1.2, "Distance that counts as near, in mean point spacings.", minimum=0.1, maximum=10.0
    )

    @classmethod
    def faithful(cls) -> KMeansSettings:
        """The paper's words: k = 2, equal facets, one fit a cluster, the model always, its own outline."""
        return cls(
            clusters=2,
            facet_weights="equal",
            longest_edge_spacings=0.0,
            smoothing_passes=0,
            refine=False,
            leftover_rounds=0,
            model="always",
            outline="rectangle",
            margin_spacings=0.0,
            faces="traced",
        )
