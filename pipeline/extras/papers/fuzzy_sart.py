"""Fuzzy SART (Shorter and Kasparis): from the points of one building to its roof planes.

The order of the steps is the paper's: TIN by greedy insertion with absorption of noise (3.1), clustering of the facets
(3.2), best-fit planes, merging, absorption of outliers and straight ridges (3.3). The defaults are the form that
measured better (unit normals, thresholds that follow the noise, clusters split into connected parts);
`FuzzySartSettings.faithful` is the paper to the letter, as far as it is printed.
"""

from __future__ import annotations

import numpy as np

from pipeline.extras.papers.building_tin import check_extent, ground_around
from pipeline.extras.papers.facet_clusters import connected_parts, labels_of_points
from pipeline.extras.papers.fuzzy_sart_clusters import centre_of_building, cluster, facet_vectors
from pipeline.extras.papers.height_rule import facets_above_z_avg
from pipeline.extras.papers.paper_settings import FuzzySartSettings
from pipeline.extras.papers.refinement import planes_of_clusters
from pipeline.geometry import nearest_neighbours, point_spacing_m
from pipeline.model import BoolArray, FloatArray, PreparedCloud, Segmentation
from pipeline.prepared_cloud import require_visible
from pipeline.segmentation.facet_geometry import facet_areas_m2, facet_centroids, facet_normals, noise_sigma_m
from pipeline.segmentation.plane_regression import describe_planes
from pipeline.tin.greedy_insertion import GreedyInsertionSettings, GreedyTin, insert_greedily


def segment(cloud: PreparedCloud, settings: FuzzySartSettings) -> Segmentation:
    """Find the roof planes of one building; none where no cluster has one.

    Points that a higher point of the building hides (facades, returns from below the roof) take no part and keep the
    label -1, as do points that no plane explains.

    Raises
    ------
    BuildingError
        Reason ``too_few_points`` below the fewest points of a plane; ``too_complex`` beyond a limit of work.
    """
    require_visible(cloud, cloud.visible, settings.min_points, f"min_points is {settings.min_points}")
    roof = cloud.points[cloud.visible]
    spacing_m = point_spacing_m(roof)
    sigma_m = noise_sigma_m(roof)
    neighbours = nearest_neighbours(roof, settings.neighbours)
    distance_m = settings.plane_distance_m(sigma_m)

    # 3.1: the TIN of the building with its ground; points near a facet are absorbed by it.
    gap_m = max(settings.ground_gap_spacings * spacing_m, settings.min_ground_gap_m)
    ground = ground_around(cloud, roof, gap_m)
    building_with_ground = np.concatenate([roof, ground])
    check_extent(building_with_ground)
    insertion = GreedyInsertionSettings(
        absorption=settings.absorption,
        absorption_distance_m=settings.absorption_distance_m(sigma_m),
        absorption_slope_deg=settings.max_absorption_slope_deg,
    )
    greedy = insert_greedily(building_with_ground, insertion, cloud.ground_z_m)
    facets = greedy.tin.facets
    normals = facet_normals(greedy.vertices, facets)
    areas_m2 = facet_areas_m2(greedy.vertices, facets)
    can_be_roof = _roof_facets(greedy, normals, len(roof), settings)

    # 3.2: facets with alike vectors are one cluster.
    centre = centre_of_building(greedy.vertices[greedy.vertex_point >= 0])
    vectors = facet_vectors(
        settings.vectors,
        normals[can_be_roof],
        facet_centroids(greedy.vertices, facets[can_be_roof]),
        centre,
        scaled_min=settings.scaled_min,
    )
    clusters = np.full(len(facets), -1, np.int32)
    clusters[can_be_roof] = cluster(vectors, areas_m2[can_be_roof], settings).labels
    if settings.split_by_connectivity:
        clusters = connected_parts(clusters, greedy.tin.neighbours)
    rough = labels_of_points(facets, clusters, areas_m2, greedy.vertex_point, greedy.facet_of_point)[: len(roof)]

    # 3.3: best-fit planes on the original elevations, merging, absorption of outliers, straight ridges.
    planes, labels = planes_of_clusters(
        roof,
        neighbours,
        rough,
        spacing_m=spacing_m,
        distance_m=distance_m,
        settings=settings,
    )

    return cloud.segmentation(describe_planes(roof, planes, labels), cloud.visible, labels)


def _roof_facets(greedy: GreedyTin, normals: FloatArray, n_roof: int, settings: FuzzySartSettings) -> BoolArray:
    """Facets that may be roof: not too steep, and by the height rule."""
    facets = greedy.tin.facets
    gentle = normals[:, 2] > np.cos(np.radians(settings.max_absorption_slope_deg))
    if settings.height_rule == "scene":
        z_m = greedy.vertices[:, 2]
        return np.asarray(gentle & facets_above_z_avg(z_m, facets, wall_height_m=settings.wall_height_m))
    is_roof_vertex = (greedy.vertex_point >= 0) & (greedy.vertex_point < n_roof)
    return np.asarray(gentle & is_roof_vertex[facets].all(axis=1))
