"""K-means on facet normals (Zeng, Lai, Li, Mao and Liu 2008): from the points of one building to its model.

The order of the steps is the paper's: TIN of the building's points, k-means of its facets' normals with the cosine as
similarity, points to planes (2.1), least squares and convex hulls (2.2), the line of intersection, the minimal
rectangle on it that holds the hull of either side, both made equal by the larger one (2.3), the model of ten vertices
and fifteen parameters (2.4), or its flat and pent counterparts.

`KMeansSettings.faithful` does just that. The defaults choose the number of clusters, refine their planes, and
draw the paper's model only where it explains the building; other roofs are drawn from the labels of their points.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import shapely

from pipeline.errors import BuildingError
from pipeline.extras.papers.building_tin import check_extent
from pipeline.extras.papers.facet_clusters import connected_parts
from pipeline.extras.papers.facet_smoothing import passes_for_noise, smoothed_normals
from pipeline.extras.papers.kmeans_normals import FacetClusters, choose_clusters, labels_around
from pipeline.extras.papers.paper_settings import KMeansSettings
from pipeline.extras.papers.primitives import BuildingPrimitive, fit_box, fit_gable
from pipeline.extras.papers.refinement import planes_of_clusters
from pipeline.extras.papers.surrounding_ground import far_from
from pipeline.geometry import nearest_neighbours, point_spacing_m
from pipeline.model import FloatArray, LabelArray, Plane, PlanFace, PreparedCloud, Reason, Segmentation, Tin
from pipeline.prepared_cloud import require_visible
from pipeline.segmentation.facet_geometry import (
    best_fit_planes,
    facet_areas_m2,
    facet_normals,
    noise_sigma_m,
    vertical_residuals_m,
)
from pipeline.segmentation.plane_regression import describe_planes
from pipeline.tin.delaunay import triangulate

_MIN_FACETS = 3
"""Fewer facets do not make two groups."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingTop:
    """The points of a building that see the sky, one a position, and their TIN."""

    points: FloatArray
    """(n, 3) float64, metres about the origin of the cloud."""
    spacing_m: float
    """Mean point spacing in plan."""
    sigma_m: float
    """Standard deviation of the vertical noise."""
    distance_m: float
    """Up to which a point belongs to a plane, by the noise."""
    tin: Tin
    """Planar Delaunay triangulation; vertex i is point i."""


def segment(cloud: PreparedCloud, settings: KMeansSettings) -> Segmentation:
    """Find the roof planes of one building, and the model that they make.

    Points that a higher point of the building hides (facades, returns from below the roof) take no part and keep the
    label -1, as do points that neither a plane nor the model explains.

    Returns
    -------
    Segmentation
        With `faces` where the building is a model of ten or eight vertices; its planes are then the model's own.

    Raises
    ------
    BuildingError
        Reason ``too_few_points`` or ``no_plane`` where there is too little to cluster; ``no_partition`` where two
        planes must make a model and meet beside the building; ``too_complex`` beyond a limit of work.
    """
    top = building_top(cloud, settings)
    planes, labels = planes_of(top, settings)
    described = describe_planes(top.points, planes, labels)
    faces: tuple[PlanFace, ...] | None = None
    roof_type = None
    keeps_footprint = settings.outline == "footprint" and cloud.candidate.footprint is not None
    if settings.model != "never" and not keeps_footprint:
        model = model_of(top, described, labels, cloud.ground_z_m, settings)
        if model is not None:
            labels = sides_of(model, top.points, settings.model_distance_m)
            described = describe_planes(top.points, np.array([plane.coefficients for plane in model.planes]), labels)
            roof_type = model.roof_type if settings.model == "always" else None
            x, y, _ = cloud.shift_m.tolist()
            faces = tuple(_moved(face, x, y) for face in model.faces)
    return cloud.segmentation(described, cloud.highest, labels, faces=faces, roof_type=roof_type)


def building_top(cloud: PreparedCloud, settings: KMeansSettings) -> BuildingTop:
    """The TIN of a building's visible points, at least one: the highest one of every position.

    Raises BuildingError ``too_few_points`` or ``too_complex``.
    """
    require_visible(cloud, cloud.highest, settings.min_points, f"min_points is {settings.min_points}")
    top = cloud.points[cloud.highest]
    check_extent(top)
    sigma_m = noise_sigma_m(top)
    return BuildingTop(
        points=top,
        spacing_m=point_spacing_m(top),
        sigma_m=sigma_m,
        distance_m=settings.plane_distance_m(sigma_m),
        tin=triangulate(cloud.points_mm[cloud.highest, :2]),
    )


def cluster_facets(top: BuildingTop, settings: KMeansSettings) -> tuple[LabelArray, FacetClusters]:
    """Section 2.1: the facets of the TIN in clusters of one direction.

    Returns the cluster of every facet, (m,) int32, -1 for those that are too steep or too long, and the clusters of the
    others, in their order. Raises BuildingError ``no_plane`` where fewer than three facets are left; ``too_complex``.
    """
    facets = top.tin.facets
    normals, areas_m2 = facet_normals(top.points, facets), facet_areas_m2(top.points, facets)
    gentle = normals[:, 2] > math.cos(math.radians(settings.max_slope_deg))
    usable = gentle & (_longest_edges_m(top) <= settings.longest_edge_spacings * top.spacing_m)
    if settings.longest_edge_spacings == 0.0 or usable.sum() < _MIN_FACETS:
        usable = gentle
    if usable.sum() < _MIN_FACETS:
        raise BuildingError(
            Reason.NO_PLANE,
            f"{int(usable.sum())} of {len(facets)} facets are not steeper than max_slope_deg, "
            f"{settings.max_slope_deg:g}; clusters need {_MIN_FACETS}",
        )
    passes = passes_for_noise(top.sigma_m, top.spacing_m, settings.normal_noise_deg, settings.smoothing_passes)
    normals = smoothed_normals(normals, areas_m2, top.tin.neighbours, usable, passes)
    index = np.flatnonzero(usable)
    fewest_points = settings.fewest_points(top.spacing_m)

    def on_all_facets(labels: LabelArray) -> LabelArray:
        everywhere = np.full(len(facets), -1, np.int32)
        everywhere[index] = labels
        return everywhere

    def explained(labels: LabelArray) -> float:
        return _share_explained(top, connected_parts(on_all_facets(labels), top.tin.neighbours), fewest_points)

    weights = areas_m2[index] if settings.facet_weights == "area" else np.ones(len(index))
    clusters = choose_clusters(normals[index], weights, explained, settings)
    return on_all_facets(clusters.labels), clusters


def planes_of(top: BuildingTop, settings: KMeansSettings) -> tuple[FloatArray, LabelArray]:
    """Sections 2.1 and 2.2: points in sets of one plane, and the planes by least squares.

    Returns the planes (a, b, c), (k, 3), none where no cluster has one, and the plane of every point of the top, (n,)
    int32, -1 for none. Raises as `cluster_facets`, and ``too_complex`` beyond the work of the refinement.
    """
    clusters, _ = cluster_facets(top, settings)
    if settings.refine:
        return _refined_planes(top, clusters, settings)
    labels = labels_around(top.points, top.tin.facets, clusters)
    shares = np.bincount(labels[labels >= 0], minlength=int(labels.max()) + 1) / len(labels)
    labels = np.where((labels >= 0) & (shares[labels] < settings.min_plane_share), -1, labels).astype(np.int32)
    planes, labels = best_fit_planes(top.points, labels, int(labels.max()) + 1)
    if len(planes) == 2 and _angle_deg(planes[0], planes[1]) < settings.one_plane_deg:
        # one plane: the clusters differed by noise alone
        planes, labels = best_fit_planes(top.points, np.zeros(len(labels), np.int32), 1)
    return planes, labels


def _refined_planes(top: BuildingTop, clusters: LabelArray, settings: KMeansSettings) -> tuple[FloatArray, LabelArray]:
    """Parts that hang together, best-fit planes, merging, reassignment, straight ridges."""
    parts = connected_parts(clusters, top.tin.neighbours)
    return planes_of_clusters(
        top.points,
        nearest_neighbours(top.points, settings.neighbours),
        labels_around(top.points, top.tin.facets, parts),
        spacing_m=top.spacing_m,
        distance_m=top.distance_m,
        settings=settings,
    )


def model_of(
    top: BuildingTop,
    planes: tuple[Plane, ...],
    labels: LabelArray,
    ground_z_m: float,
    settings: KMeansSettings,
) -> BuildingPrimitive | None:
    """Sections 2.3 and 2.4: the gable of two planes, or the flat or pent counterpart of one.

    None for no plane or more than two; with `model: fitting` also where the model does not explain the building. With
    `model: always` raises BuildingError ``no_partition`` where the planes make none.
    """
    if not 1 <= len(planes) <= 2:
        return None
    try:
        model = _box_or_gable(top, planes, labels, ground_z_m, settings)
    except BuildingError:
        if settings.model == "always":
            raise
        return None
    if settings.model == "always" or _explains(model, top, settings):
        return model
    return None


def _box_or_gable(
    top: BuildingTop, planes: tuple[Plane, ...], labels: LabelArray, ground_z_m: float, settings: KMeansSettings
) -> BuildingPrimitive:
    """The model of one plane or of two."""
    margin_m = settings.margin_spacings * top.spacing_m
    if len(planes) == 1:
        return fit_box(
            top.points[labels == 0], planes[0], ground_z_m, flat_below_deg=settings.flat_below_deg, margin_m=margin_m
        )
    fit = fit_gable(
        top.points,
        labels,
        (planes[0], planes[1]),
        ground_z_m,
        min_side_share=settings.min_side_share,
        margin_m=margin_m,
    )
    if fit.is_valley:
        raise BuildingError(
            Reason.NO_PARTITION,
            f"the two planes rise from the line in which they meet, {fit.model.top_z_m:.2f} m, to "
            f"{max(fit.eave_z_m):.2f} m: no ridge",
        )
    return fit.model


def sides_of(model: BuildingPrimitive, points: FloatArray, distance_m: float) -> LabelArray:
    """The plane of the model at every point, (n,) int32: by the side of the ridge; -1 beyond a vertical distance."""
    labels = np.zeros(len(points), np.int32)
    planes = model.planes
    if len(planes) == 2:
        (x1, y1), (x2, y2) = model.corners[:2]
        left = (x2 - x1) * (points[:, 1] - y1) - (y2 - y1) * (points[:, 0] - x1)
        labels[left > 0.0] = 1
    residuals = np.stack([vertical_residuals_m(points, plane.coefficients) for plane in planes])
    own = residuals[labels, np.arange(len(points))]
    labels[np.abs(own) > distance_m] = -1
    return labels


def _explains(model: BuildingPrimitive, top: BuildingTop, settings: KMeansSettings) -> bool:
    """Whether a model is near the roof points, and has them near everywhere."""
    if float(np.mean(sides_of(model, top.points, top.distance_m) >= 0)) < settings.fitting_share:
        return False
    corners = np.array(model.corners[-4:])
    along, up = corners[1] - corners[0], corners[3] - corners[0]
    columns, rows = (max(2, math.ceil(math.hypot(*side) / top.spacing_m)) for side in (along.tolist(), up.tolist()))
    # a sample lies at least half a spacing from the next, so a point is near to at most this many
    near_to_one = (4.0 * settings.fill_gap_spacings + 2.0) ** 2
    if settings.fitting_fill * columns * rows > near_to_one * len(top.points):
        return False
    s, t = (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows
    samples = corners[0] + s[:, None, None] * along + t[None, :, None] * up
    flat = np.column_stack([samples.reshape(-1, 2), np.zeros(columns * rows)])
    empty = far_from(flat, top.points, settings.fill_gap_spacings * top.spacing_m)
    return float(1.0 - empty.mean()) >= settings.fitting_fill


def _longest_edges_m(top: BuildingTop) -> FloatArray:
    """Longest edge of every facet in plan, (m,) float64."""
    corners = top.points[top.tin.facets, :2]
    edges = corners - np.roll(corners, 1, axis=1)
    return np.asarray(np.hypot(edges[:, :, 0], edges[:, :, 1]).max(axis=1, initial=0.0))


def _share_explained(top: BuildingTop, parts: LabelArray, fewest_points: int) -> float:
    """Share of the points that lie on the best-fit plane of their part of the TIN, where it has points enough."""
    labels = labels_around(top.points, top.tin.facets, parts)
    counts = np.bincount(labels[labels >= 0], minlength=int(parts.max()) + 1)
    labels[(labels >= 0) & (counts[labels] < fewest_points)] = -1
    planes, labels = best_fit_planes(top.points, labels, int(labels.max()) + 1)
    labelled = np.flatnonzero(labels >= 0)
    a, b, c = planes[labels[labelled]].T
    x, y, z = top.points[labelled].T
    off = np.abs(z - (a * x + b * y + c)) / np.sqrt(1.0 + a * a + b * b)
    return float((off <= top.distance_m).sum()) / len(top.points)


def _angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Angle between two planes (a, b, c)."""
    (a, b), (p, q) = first[:2].tolist(), second[:2].tolist()
    across = math.sqrt((b - q) ** 2 + (a - p) ** 2 + (a * q - b * p) ** 2)
    return math.degrees(math.atan2(across, 1.0 + a * p + b * q))


def _moved(face: PlanFace, x: float, y: float) -> PlanFace:
    """The face over the candidate's own origin, on whole millimetres."""
    shift = np.array([x, y])
    polygon = shapely.transform(face.polygon, lambda xy: np.rint((xy + shift) * 1000.0) / 1000.0)
    return dataclasses.replace(face, polygon=polygon)
