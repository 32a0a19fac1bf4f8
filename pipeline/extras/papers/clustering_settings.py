"""Settings of the steps that cluster facets. No kernels here: settings are read without them."""

from __future__ import annotations

from pipeline.parameters import Parameters, parameter


class FuzzySartClusteringSettings(Parameters):
    """Settings of the clustering; the paper publishes the vigilance alone."""

    vectors: str = parameter(
        "unit_normal",
        "Clustered vector of a facet: its unit normal, the foot of the perpendicular from the building's centre, "
        "or that foot in spherical coordinates scaled to one range.",
        choices=("unit_normal", "footpoint", "spherical_scaled"),
    )
    vigilance: float = parameter(
        0.95, "Vector degree of match below which an input starts a cluster of its own.", minimum=0.0, maximum=1.0
    )
    tau_epochs: int = parameter(5, "Epochs in which a neuron learns.", unit="epochs", minimum=1, maximum=100)
    epochs_per_tau: int = parameter(
        4, "The clustering ends after this many times tau epochs at the latest.", minimum=1, maximum=100
    )
    learning_rate_start: float = parameter(0.5, "Learning rate of a new neuron.", minimum=1e-6, maximum=1.0)
    learning_rate_end: float = parameter(0.005, "Learning rate of a neuron of age tau.", minimum=1e-6, maximum=1.0)
    neighbourhood_start: float = parameter(
        1.0,
        "Ranks over which the learning fades when a new winner wins.",
        minimum=1e-6,
        maximum=100.0,
    )
    neighbourhood_end: float = parameter(
        0.01, "The same for a winner of age tau: practically none but the winner learns.", minimum=1e-6, maximum=100.0
    )
    scaled_min: float = parameter(
        0.0, "Lower end of the one range, up to 1, of spherical_scaled vectors.", minimum=0.0, maximum=1.0
    )
    clustering_work_limit: int = parameter(
        1_500_000_000,
        "Comparisons of a vector with a neuron after which a building is given up as too complex.",
        minimum=1,
        maximum=10**15,
    )


class NormalClusteringSettings(Parameters):
    """Settings of the clustering of facets; the paper has k = 2 and publishes no others."""

    clusters: int = parameter(
        0,
        "The k of k-means: how many directions of roof planes there are (the paper: 2); 0 chooses it (k: auto).",
        minimum=0,
        maximum=32,
    )
    max_clusters: int = parameter(6, "Largest k that is tried where k is chosen.", minimum=1, maximum=32)
    residual_weight: float = parameter(
        2.0,
        "The k is chosen by the silhouette plus this many times the share of points that lie on their planes.",
        minimum=0.0,
        maximum=100.0,
    )
    one_cluster_silhouette: float = parameter(
        0.6, "Value that counts as the silhouette of a single cluster, which has none.", minimum=-1.0, maximum=1.0
    )
    facet_weights: str = parameter(
        "area", "Whether large facets count more in the centres of clusters.", choices=("area", "equal")
    )
    starts: int = parameter(
        8,
        "Starts of k-means, of which the one with the least inertia counts: each leaves out one more of the farthest "
        "normals, which may be alone.",
        minimum=1,
        maximum=1000,
    )
    kmeans_rounds: int = parameter(
        100, "Most rounds of k-means; it ends when no facet changes.", unit="rounds", minimum=1, maximum=10_000
    )
    kmeans_work_limit: int = parameter(
        2_000_000_000,
        "Products of facets with centres, for each number of clusters tried, after which a building is too complex.",
        minimum=1,
        maximum=10**15,
    )


class SingleLinkageSettings(Parameters):
    """Settings of the clustering in two dimensions."""

    linkage_start_deg: float = parameter(
        10.0, "Distance up to which two facets are linked, at first.", unit="deg", minimum=0.1, maximum=90.0
    )
    min_linkage_deg: float = parameter(4.0, "Least reasonable such distance.", unit="deg", minimum=0.1, maximum=90.0)
    linkage_factor: float = parameter(
        0.9, "The distance is multiplied by this while a cluster is too large.", minimum=0.1, maximum=0.99
    )
    largest_cluster_share: float = parameter(
        0.8, "A cluster that holds more of all facets than this is too large.", minimum=0.1, maximum=1.0
    )
    min_members: int = parameter(6, "Fewest facets of a cluster.", unit="facets", minimum=1, maximum=100_000)
    linkage_work_limit: int = parameter(
        200_000_000, "Comparisons of facets after which a building is too complex.", minimum=1, maximum=10**15
    )

    def cross_faults(self) -> list[str]:
        """The distances must be a range."""
        return [*super().cross_faults(), *self.range_faults("min_linkage_deg", "linkage_start_deg")]


class ParameterBoxSettings(Parameters):
    """Settings of the coarse clustering in three dimensions."""

    box_slope_deg: float = parameter(7.0, "Edge of a box in slope.", unit="deg", minimum=0.1, maximum=90.0)
    box_orientation_deg: float = parameter(
        10.0, "Edge of a box in orientation; rounded so that the circle is a whole number of them.", unit="deg",
        minimum=0.1, maximum=120.0,
    )  # fmt: skip
    box_o_distance_m: float = parameter(2.0, "Edge of a box in O-distance.", unit="m", minimum=0.01, maximum=1000.0)
    dense_box_facets: int = parameter(
        2,
        "A box is dense where it holds more facets than this, and more than the mean of the filled boxes.",
        unit="facets",
        minimum=0,
        maximum=100_000,
    )
    double_share: float = parameter(
        0.5, "Two coarse clusters that share more than this of the smaller one are one.", minimum=0.0, maximum=1.0
    )
    max_coarse_clusters: int = parameter(
        2000, "Coarse clusters beyond which a building is too complex.", minimum=1, maximum=10**6
    )


class ClusterMembershipSettings(Parameters):
    """Settings of the refinement of coarse clusters."""

    height_noise_m: float = parameter(
        0.08,
        "Standard deviation of heights within one building, from which the spread of slope and orientation follows.",
        unit="m",
        minimum=0.001,
        maximum=1.0,
    )
    close_spreads: float = parameter(
        1.0,
        "Facets within this many standard deviations of slope and orientation are close.",
        minimum=0.01,
        maximum=100.0,
    )
    member_spreads: float = parameter(
        2.5, "Farthest that a member lies from its centre, in standard deviations.", minimum=0.01, maximum=100.0
    )
    typical_o_range_m: float = parameter(
        2.0,
        "Range of the O-distance of a typical roof face: a quarter of it counts as a standard deviation, to which "
        "the mean cluster's is added.",
        unit="m",
        minimum=0.01,
        maximum=100.0,
    )
    min_members: int = parameter(4, "Fewest facets of a cluster.", unit="facets", minimum=1, maximum=100_000)
    max_o_deviation_m: float = parameter(
        1.3,
        "Clusters whose O-distance has this standard deviation or more are not roof.",
        unit="m",
        minimum=0.01,
        maximum=100.0,
    )
    ground_below_deg: float = parameter(
        4.0, "Clusters with less slope and a negative O-distance are not roof.", unit="deg", minimum=0.0, maximum=90.0
    )
    wall_above_deg: float = parameter(
        76.0, "Clusters with more slope are walls.", unit="deg", minimum=1.0, maximum=90.0
    )
    weight_sample: int = parameter(
        500, "Most facets of a cluster that weights are counted against.", unit="facets", minimum=10, maximum=100_000
    )
    membership_work_limit: int = parameter(
        500_000_000, "Comparisons of facets with facets and centres after which a building is too complex.",
        minimum=1, maximum=10**15,
    )  # fmt: skip


class RoofTreeSettings(Parameters):
    """Settings of both trees."""

    flat_below_deg: float = parameter(
        7.0,
        "A single roof plane with less slope is flat, with more a pent roof.",
        unit="deg",
        minimum=0.0,
        maximum=45.0,
    )
    opposite_tolerance_deg: float = parameter(
        20.0, "Orientations about 180 degrees apart are so within this.", unit="deg", minimum=0.0, maximum=90.0
    )
    similar_slope_deg: float = parameter(
        10.0, "Slopes of a pair among several clusters are similar within this.", unit="deg", minimum=0.0, maximum=90.0
    )
    pent_beside: str = parameter(
        "below_origin",
        "In three dimensions, a pent roof is the one cluster above the origin, whatever is left below it, or the one "
        "cluster that is left at all.",
        choices=("below_origin", "nothing"),
    )
