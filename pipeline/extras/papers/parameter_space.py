"""Parameter spaces (Hofmann, Maas and Streilein 2003): from the facets of a building's TIN to roof type and planes.

The order of the steps is the paper's: TIN about the barycentre (2), slope, orientation and O-distance of its facets,
clusters in two (3.1, 3.2) or three dimensions (4.1), decision tree (3.3, 4.2), and the building primitive of the
outlook (5, Figure 5-1): planes interpolated in the groups of points that the clusters hold, closed by walls.
`faithful()` is the paper to the letter, as far as it is printed; the defaults are what measured better.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.extras.papers.building_tin import check_extent, ground_around
from pipeline.extras.papers.cluster_membership import may_be_roof, refine_clusters
from pipeline.extras.papers.facet_clusters import labels_of_points
from pipeline.extras.papers.facet_parameters import about_barycentre, cluster_means, facet_parameters
from pipeline.extras.papers.paper_settings import (
    ParameterSpace2dSettings,
    ParameterSpace3dSettings,
    ParameterSpaceSettings,
)
from pipeline.extras.papers.parameter_boxes import coarse_clusters
from pipeline.extras.papers.region_growing import grow_regions
from pipeline.extras.papers.roof_trees import classify_2d, classify_3d, plausible_slopes
from pipeline.extras.papers.single_linkage import cluster_by_linkage
from pipeline.geometry import nearest_neighbours, point_spacing_m
from pipeline.model import BoolArray, FloatArray, LabelArray, PreparedCloud, RoofType, Segmentation, Tin
from pipeline.prepared_cloud import require_visible
from pipeline.segmentation.facet_geometry import best_fit_planes, facet_areas_m2, kept_clusters, noise_sigma_m
from pipeline.segmentation.plane_regression import describe_planes
from pipeline.segmentation.point_votes import vote_among_neighbours
from pipeline.tin.delaunay import triangulate, unique_xy

_MIN_POINTS = 4
"""Fewest points with a spacing and a noise: a definition, not a setting."""
_VOTING_PASSES = 4
"""Most repetitions of the choice between regions. It ends earlier when nothing changes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingFacets:
    """The TIN of a building with its surroundings, and the parameters of its facets."""

    roof: FloatArray
    """(n, 3) float64, the points visible from above, metres about the origin of the cloud."""
    spacing_m: float
    """Mean point spacing of the roof."""
    tin_spacing_m: float
    """That of the TIN's vertices on it."""
    vertices: FloatArray
    """(v, 3) float64, roof points and terrain samples about their barycentre."""
    vertex_of_point: LabelArray
    """(n,) int32, the vertex that represents each roof point."""
    tin: Tin
    """Its facets."""
    parameters: FloatArray
    """(m, 3) float64, slope, orientation, O-distance."""
    is_roof: BoolArray
    """(m,) bool, True where all vertices are roof points."""


def segment_2d(cloud: PreparedCloud, settings: ParameterSpace2dSettings) -> Segmentation:
    """Roof planes and type of one building from clusters of its facets in slope and orientation (section 3).

    Parameters
    ----------
    cloud : PreparedCloud
        Its points, and the terrain around it.
    settings : ParameterSpace2dSettings
        `ParameterSpace2dSettings()` or `ParameterSpace2dSettings.faithful()`.

    Returns
    -------
    Segmentation
        Without planes where no cluster of roof points is left.

    Raises
    ------
    BuildingError
        Reason ``too_few_points`` where hardly any are visible; ``too_complex`` beyond a limit of work.
    """
    facets = facets_of(cloud, settings)
    labels, centres = roof_clusters_2d(facets, settings)
    return _primitive(cloud, facets, labels, centres, classify_2d(centres, settings).roof_type, settings)


def segment_3d(cloud: PreparedCloud, settings: ParameterSpace3dSettings) -> Segmentation:
    """Roof planes and type of one building from clusters of its facets in all three parameters (section 4).

    Parameters, planes and errors are those of `segment_2d`.
    """
    facets = facets_of(cloud, settings)
    labels, centres = roof_clusters_3d(facets, settings)
    return _primitive(cloud, facets, labels, centres, classify_3d(centres, settings).roof_type, settings)


def roof_clusters_2d(facets: BuildingFacets, settings: ParameterSpace2dSettings) -> tuple[LabelArray, FloatArray]:
    """Clusters of facets in slope and orientation that may be roof (sections 3.1 to 3.3).

    Returns the cluster of every facet, (m,) int32, -1 for none, and the mean slope, orientation and O-distance of the
    clusters, (k, 3).
    """
    taken = _facets_to_cluster(facets, settings)

    # 3.2: single linkage in slope and orientation; the distance shrinks while one cluster holds most of all facets.
    labels = np.full(len(facets.tin), -1, np.int32)
    if len(taken):
        slopes, orientations, _ = facets.parameters[taken].T
        labels[taken] = cluster_by_linkage(slopes, orientations, settings).labels
    centres = cluster_means(facets.parameters, labels, int(labels.max(initial=-1)) + 1)

    # 3.3: clusters with a plausible slope are faces.
    kept = plausible_slopes(centres, settings.min_slope_deg, settings.max_slope_deg)
    return kept_clusters(labels, centres, kept & _not_terrain(facets, labels, len(centres), settings))


def roof_clusters_3d(facets: BuildingFacets, settings: ParameterSpace3dSettings) -> tuple[LabelArray, FloatArray]:
    """Clusters of facets in all three parameters that may be roof (sections 4.1 and 4.2); as `roof_clusters_2d`."""
    taken = _facets_to_cluster(facets, settings)

    # 4.1: coarse clusters of dense boxes, then weighted centres and membership.
    parameters = facets.parameters[taken]
    refined = refine_clusters(parameters, coarse_clusters(parameters, settings), facets.tin_spacing_m, settings)
    labels = np.full(len(facets.tin), -1, np.int32)
    labels[taken] = refined.labels

    # 4.2: ground and walls are eliminated.
    kept = may_be_roof(refined.centres, settings)
    kept &= _not_terrain(facets, labels, len(refined.centres), settings)
    return kept_clusters(labels, refined.centres, kept)


def facets_of(cloud: PreparedCloud, settings: ParameterSpaceSettings) -> BuildingFacets:
    """Section 2: the Delaunay TIN of the building with some surrounding ground, about its barycentre.

    Raises BuildingError ``too_few_points`` where hardly any are visible; ``too_complex`` where they extend too far.
    """
    require_visible(cloud, cloud.visible, _MIN_POINTS, f"at least {_MIN_POINTS} are needed")
    roof = cloud.points[cloud.visible]
    spacing_m = max(point_spacing_m(roof), 1e-3)
    gap_m = max(settings.ground_gap_spacings * spacing_m, 1e-3)
    ground = ground_around(cloud, roof, gap_m, settings.surroundings_m)
    thinned, thinned_of_point = _one_a_square(roof, settings.tin_spacing_m)
    with_ground = np.concatenate([roof[thinned], ground])
    check_extent(with_ground)
    millimetres = np.rint(with_ground * 1000.0).astype(np.int64)
    kept, kept_of_point = unique_xy(millimetres[:, :2], millimetres[:, 2])
    tin = triangulate(millimetres[kept, :2])
    vertices, _ = about_barycentre(with_ground[kept])
    is_roof_vertex = kept < len(thinned)
    return BuildingFacets(
        roof=roof,
        spacing_m=spacing_m,
        tin_spacing_m=max(spacing_m, settings.tin_spacing_m),
        vertices=vertices,
        vertex_of_point=kept_of_point[: len(thinned)][thinned_of_point],
        tin=tin,
        parameters=facet_parameters(vertices, tin.facets),
        is_roof=np.asarray(is_roof_vertex[tin.facets].all(axis=1)),
    )


def _one_a_square(roof: FloatArray, size_m: float) -> tuple[LabelArray, LabelArray]:
    """Indices of the points nearest to the middle of each square, ascending, and which of them represents each point.

    The lower index of equally near ones; all points where the size is 0.
    """
    every = np.arange(len(roof), dtype=np.int32)
    if size_m <= 0.0:
        return every, every
    squares = np.floor(roof[:, :2] / size_m)
    away = ((roof[:, :2] - (squares + 0.5) * size_m) ** 2).sum(axis=1)
    _, square = np.unique(squares, axis=0, return_inverse=True)
    order = np.lexsort((away, square.ravel()))
    first = np.ones(len(roof), np.bool_)
    first[1:] = np.diff(square.ravel()[order]) > 0
    chosen = order[first]
    kept = np.sort(chosen).astype(np.int32)
    return kept, np.searchsorted(kept, chosen).astype(np.int32)[square.ravel()]


def _facets_to_cluster(facets: BuildingFacets, settings: ParameterSpaceSettings) -> LabelArray:
    """Indices of the facets whose parameters are clustered."""
    if settings.ground_clusters == "leave_out":
        return np.flatnonzero(facets.is_roof).astype(np.int32)
    return np.arange(len(facets.tin), dtype=np.int32)


def _not_terrain(
    facets: BuildingFacets, labels: LabelArray, n_clusters: int, settings: ParameterSpaceSettings
) -> BoolArray:
    """Clusters that are not mostly facets of terrain and walls: (k,) bool; all where they are to be kept."""
    if settings.ground_clusters == "keep":
        return np.ones(n_clusters, np.bool_)
    own = np.bincount(labels[(labels >= 0) & facets.is_roof], minlength=n_clusters)
    return np.asarray(2 * own >= np.bincount(labels[labels >= 0], minlength=n_clusters))


def _primitive(
    cloud: PreparedCloud,
    facets: BuildingFacets,
    labels: LabelArray,
    centres: FloatArray,
    roof_type: RoofType,
    settings: ParameterSpaceSettings,
) -> Segmentation:
    """Section 5, Figure 5-1: planes interpolated in the groups of points; the faces are closed by walls later."""
    areas_m2 = facet_areas_m2(facets.vertices, facets.tin.facets)
    every = np.arange(len(facets.vertices), dtype=np.int32)
    of_vertices = labels_of_points(facets.tin.facets, labels, areas_m2, every, np.full_like(every, -1))
    groups = of_vertices[facets.vertex_of_point]
    if settings.point_groups == "region_growing":
        planes, groups = _grown(facets, groups, centres, settings)
    else:
        planes, groups = best_fit_planes(facets.roof, groups, len(centres), settings.min_points)
    described = describe_planes(facets.roof, planes, groups)
    named = roof_type if settings.type_from == "tree" and len(planes) else None
    return cloud.segmentation(described, cloud.visible, groups, roof_type=named)


def _grown(
    facets: BuildingFacets, groups: LabelArray, centres: FloatArray, settings: ParameterSpaceSettings
) -> tuple[FloatArray, LabelArray]:
    """Regions grown from the clusters' means; points between two of them go to the nearer plane."""
    roof = facets.roof
    sigma_m = noise_sigma_m(roof)
    distance_m = settings.growing_distance_m(sigma_m)
    neighbours = nearest_neighbours(roof, settings.growing_neighbours)
    fewest = max(settings.min_points, min(int(settings.min_area_m2 / facets.spacing_m**2), 10_000))
    tangent, turn = np.tan(np.radians(np.minimum(centres[:, 0], 89.0))), np.radians(centres[:, 1])
    gradients = np.column_stack([-tangent * np.sin(turn), -tangent * np.cos(turn)])
    planes, labels = grow_regions(
        roof, neighbours, groups, gradients, distance_m=distance_m, fewest_points=fewest, settings=settings
    )
    labels = vote_among_neighbours(
        roof,
        neighbours,
        labels,
        planes,
        np.ones(len(planes), np.bool_),
        distance_m,
        settings.growing_vote,
        _VOTING_PASSES,
    )
    return best_fit_planes(roof, labels, len(planes), settings.min_points)
