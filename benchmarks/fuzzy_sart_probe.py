"""Observes the recipe of Fuzzy SART: houses with exact truth, and the result of each step.

Nothing is copied from the recipe: `observe` runs `pipeline.methods.fuzzy_sart.segment` itself and records the data
between its steps. Steps without a setting (the centring of Eq. 7, the scaling of spherical vectors) are turned off by
replacing their function.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest import mock

import numpy as np
import shapely

from benchmarks.fuzzy_sart_roofs import SyntheticRoof
from pipeline.geometry import facet_areas_m2, facet_normals
from pipeline.methods import fuzzy_sart
from pipeline.methods.settings import FuzzySartSettings
from pipeline.model import BoolArray, Candidate, FloatArray, IntArray, LabelArray, Plane, Segmentation
from pipeline.prepared_cloud import prepare_cloud
from pipeline.ruler.simulation.additions import random_dormers
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.scene import Terrain, place_building
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.segmentation import fuzzy_sart as clustering
from pipeline.segmentation.fuzzy_sart import centre_of_building, facet_vectors
from pipeline.segmentation.plane_regression import best_fit_plane, cluster_sums

HOUSES = ("flat", "gable", "hip", "l_shape")
"""Houses of 60 to 200 m2, 25 to 45 degrees."""
LARGE = "large simple"
"""Flat roofs and gables of 400 to 2500 m2, 8 to 25 degrees."""
HOUSE_AREA_M2 = (60.0, 200.0)
LARGE_AREA_M2 = (400.0, 2500.0)
LARGE_PITCH_DEG = (8.0, 25.0)

Vectors = Callable[..., FloatArray]
"""The signature of `facet_vectors`."""
Centre = Callable[[FloatArray], FloatArray]
"""The signature of `centre_of_building`."""
_OVER_GROUND_M = 2.0
"""Points so much over the lowest one are roof: the ground is level here, and eaves are 3 m or more over it."""


def log_uniform(random: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A draw whose logarithm is uniform."""
    return math.exp(float(random.uniform(math.log(bounds[0]), math.log(bounds[1]))))


def dimensions_of(kind: str, draw: int, random: np.random.Generator) -> tuple[RoofShape, RoofDimensions]:
    """Shape and size of a house of a kind: a roof shape, `large simple`, or a shape `with dormers`."""
    if kind == LARGE:
        shape = (RoofShape.FLAT, RoofShape.GABLE)[draw % 2]
        pitch = float(random.uniform(*LARGE_PITCH_DEG))
        return shape, random_dimensions(shape, random, area_m2=log_uniform(random, LARGE_AREA_M2), pitch_deg=pitch)
    shape = RoofShape(kind.removesuffix(" with dormers"))
    size = random_dimensions(shape, random, area_m2=log_uniform(random, HOUSE_AREA_M2))
    if kind.endswith(" with dormers"):
        size = dataclasses.replace(size, additions=random_dormers(shape, size, random))
    return shape, size


def strewn_house(
    kind: str,
    density_per_m2: float,
    noise_m: float,
    draw: int,
    *,
    split: str = "test",
    pitch_deg: float | None = None,
) -> SyntheticRoof:
    """A detached house on level terrain, strewn with points at random; building and ground are given.

    Parameters
    ----------
    kind : str
        As `dimensions_of` knows it.
    density_per_m2 : float
        Points per square metre in plan.
    noise_m : float
        Standard deviation of their elevations.
    draw : int
        Of the split.
    split : {"dev", "test"}
        Whose seeds.
    pitch_deg : float, optional
        In place of a random pitch.
    """
    random = np.random.default_rng([seed_of(split, draw), *kind.encode()])
    shape, size = dimensions_of(kind, draw, random)
    if pitch_deg is not None:
        size = dataclasses.replace(size, pitch_deg=pitch_deg)
    return strewn(kind, shape, size, density_per_m2, noise_m, random)


def strewn(
    name: str, shape: RoofShape, size: RoofDimensions, density: float, noise_m: float, random: np.random.Generator
) -> SyntheticRoof:
    """A roof of a size, turned at random, its eave 3 to 7 m above the ground."""
    building = place_building(
        name,
        shape,
        size,
        at=(0.0, 0.0),
        azimuth_deg=float(random.uniform(0.0, 360.0)),
        eave_height_m=float(random.uniform(3.0, 7.0)),
        terrain=Terrain(base_z_m=0.0),
    )
    low, high = building.vertices[:, :2].min(axis=0), building.vertices[:, :2].max(axis=0)
    xy = random.uniform(low, high, (random.poisson(density * float(np.prod(high - low))), 2))
    # faces of one plane (the sides of a wing that a cross cuts in two) are one: planes are looked for, not faces
    coefficients = np.array([plane.coefficients for plane in building.planes])
    _, first, plane_of = np.unique(np.round(coefficients, 6), axis=0, return_index=True, return_inverse=True)
    planes = coefficients[first]
    labels = np.full(len(xy), -1, np.int64)
    for polygon, plane in zip(building.roof_polygons(), plane_of, strict=True):
        labels[shapely.contains_xy(shapely.force_2d(polygon), xy[:, 0], xy[:, 1])] = plane
    xy, labels = xy[labels >= 0], labels[labels >= 0]
    z = (planes[labels, :2] * xy).sum(axis=1) + planes[labels, 2] + random.normal(0.0, noise_m, len(xy))
    points = np.rint(np.column_stack([xy, z]) * 1000.0) / 1000.0
    order = np.lexsort(points.T[::-1])
    x, y = np.meshgrid(*(np.arange(math.floor(a) - 4.0, math.ceil(b) + 5.0) for a, b in zip(low, high, strict=True)))
    ground = np.column_stack([x.ravel(), y.ravel(), np.rint(random.normal(0.0, 30.0, x.size)) / 1000.0])
    return SyntheticRoof(
        candidate=Candidate(
            building_id=name, origin=(0.0, 0.0, 0.0), points=points[order], ground=ground, ground_z_m=0.0
        ),
        planes=planes,
        labels=labels[order],
        density_per_m2=density,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Observed:
    """What passed between the steps of the recipe."""

    points: FloatArray
    """(n, 3) float64, what the TIN was made from: the points of the roof, then samples of the ground."""
    vertices: FloatArray
    """(v, 3) float64, of the TIN."""
    vertex_point: LabelArray
    """(v,) int32, point at every vertex, -1 for none."""
    facets: LabelArray
    """(m, 3) int32, of the TIN."""
    facet_clusters: LabelArray
    """(m,) int32, cluster of every facet, -1 for none."""
    vectors: FloatArray
    """(k, 3) float64, what was clustered."""
    vector_facets: LabelArray
    """(k,) int32, the facets that it belongs to."""
    clustered: Segmentation
    """The clusters as they are, each with its best-fit plane."""
    refined: Segmentation
    """After regression, merging and absorption of outliers."""
    looked_again: Segmentation
    """After the second look at what no plane explained; the same where the settings have none."""
    final: Segmentation
    """After the ridges: what the recipe gives."""


def observe(
    candidate: Candidate,
    settings: FuzzySartSettings,
    *,
    vectors: Vectors = facet_vectors,
    centre: Centre = centre_of_building,
) -> Observed:
    """Run the recipe and note what passes between its steps.

    Parameters
    ----------
    candidate : Candidate
        Without points that others hide.
    settings : FuzzySartSettings
        Of the recipe.
    vectors : callable
        In place of `facet_vectors`.
    centre : callable
        In place of `centre_of_building`.

    Raises
    ------
    ValueError
        Where points are hidden: steps could not be held against the truth point by point.
    """
    calls: dict[str, list[tuple[tuple[Any, ...], Any]]] = {}

    def noted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*positional: Any, **named: Any) -> Any:
            outcome = function(*positional, **named)
            calls.setdefault(name, []).append((positional, outcome))
            return outcome

        return call

    watched = {
        name: getattr(fuzzy_sart, name) for name in ("insert_greedily", "cluster", "labels_of_points", "refine_planes")
    }
    with ExitStack() as stack:
        for name, function in {**watched, "facet_vectors": vectors, "centre_of_building": centre}.items():
            stack.enter_context(mock.patch.object(fuzzy_sart, name, noted(name, function)))
        final = fuzzy_sart.segment(prepare_cloud(candidate), settings)
    (points, *_), greedy = calls["insert_greedily"][0]
    (facets, facet_clusters, *_), rough = calls["labels_of_points"][0]
    (_, normals, *_), clustered_vectors = calls["facet_vectors"][0]
    n = len(candidate.points)
    roof = points[:n]
    if not np.allclose(np.diff(roof, axis=0), np.diff(candidate.points, axis=0), atol=1e-6):
        raise ValueError(f"some of the {n} points of {candidate.building_id} are hidden by others")
    shift = candidate.points[0] - roof[0]
    planes, labels = calls["refine_planes"][0][1]
    again_planes, again_labels = calls["refine_planes"][-1][1]
    return Observed(
        points=points,
        vertices=greedy.vertices,
        vertex_point=greedy.vertex_point,
        facets=facets,
        facet_clusters=facet_clusters,
        vectors=clustered_vectors,
        vector_facets=_rows_of(normals, facet_normals(greedy.vertices, facets)),
        clustered=_fitted(roof, rough[:n], shift),
        refined=_segmentation(planes, labels, shift),
        looked_again=_segmentation(again_planes, again_labels, shift),
        final=final,
    )


def _rows_of(some: FloatArray, everything: FloatArray) -> LabelArray:
    """Where rows stand that were taken from others in their order."""
    rows, k = np.empty(len(some), np.int32), 0
    for m in range(len(everything)):
        if k < len(some) and (everything[m] == some[k]).all():
            rows[k] = m
            k += 1
    if k < len(some):
        raise ValueError(f"{len(some) - k} of {len(some)} normals are not those of the TIN")
    return rows


def _segmentation(planes: FloatArray, labels: LabelArray, shift: FloatArray) -> Segmentation:
    """Planes over the candidate's own origin."""
    moved = tuple(
        Plane(a=a, b=b, c=c + shift[2] - a * shift[0] - b * shift[1], n_points=0, rmse_m=0.0)
        for a, b, c in planes.tolist()
    )
    return Segmentation(planes=moved, labels=labels.astype(np.int32))


def _fitted(points: FloatArray, labels: LabelArray, shift: FloatArray) -> Segmentation:
    """Best-fit planes of clusters; one without a plane loses its points."""
    sums = cluster_sums(points, labels, int(labels.max()) + 1 if len(labels) else 0)
    fits = [best_fit_plane(row) for row in sums]
    fitted = np.array([good and row[0] > 0 for row, (*_, good) in zip(sums, fits, strict=True)], dtype=bool)
    number = np.where(fitted, np.cumsum(fitted) - 1, -1).astype(np.int32)
    planes = np.array([fit[:3] for fit, good in zip(fits, fitted, strict=True) if good]).reshape(-1, 3)
    return _segmentation(planes, np.where(labels >= 0, number[labels], -1) if len(number) else labels, shift)


def facet_truth(roof: SyntheticRoof, seen: Observed) -> IntArray:
    """(m,) int64, the true plane that a facet's three vertices lie on, -1 where there is none such."""
    label = np.append(roof.labels, -1)
    point = np.where((seen.vertex_point >= 0) & (seen.vertex_point < len(roof.labels)), seen.vertex_point, -1)
    of_vertex = label[point][seen.facets]
    return np.where((of_vertex == of_vertex[:, :1]).all(axis=1), of_vertex[:, 0], -1)


def normal_error_deg(roof: SyntheticRoof, seen: Observed) -> float:
    """Median over the roof's area of the angle between a facet's normal and the true one."""
    truth = facet_truth(roof, seen)
    mine = truth >= 0
    if not mine.any():
        return math.nan
    normals, areas = facet_normals(seen.vertices, seen.facets[mine]), facet_areas_m2(seen.vertices, seen.facets[mine])
    true = np.column_stack([-roof.planes[:, :2], np.ones(len(roof.planes))])
    true /= np.linalg.norm(true, axis=1)[:, None]
    angles = np.degrees(np.arccos(np.clip((normals * true[truth[mine]]).sum(axis=1), -1.0, 1.0)))
    order = np.argsort(angles)
    place = np.searchsorted(np.cumsum(areas[order]), areas.sum() / 2.0)
    return float(angles[order[min(int(place), len(order) - 1)]])


def clusters_a_plane(roof: SyntheticRoof, seen: Observed) -> float:
    """Clusters of facets for every true plane."""
    used = seen.facet_clusters[seen.facet_clusters >= 0]
    return len(np.unique(used)) / len(roof.planes)


def share_labelled_right(roof: SyntheticRoof, found: Segmentation, among: BoolArray) -> float:
    """Share of some points whose plane is the one that most points of their true plane carry."""
    right = np.zeros(len(roof.labels), bool)
    for plane in range(len(roof.planes)):
        mine = roof.labels == plane
        labels = found.labels[mine]
        if (labels >= 0).any():
            right |= mine & (found.labels == np.bincount(labels[labels >= 0]).argmax())
    return float(right[among].mean()) if among.any() else math.nan


def near_ridges(roof: SyntheticRoof, reach_m: float) -> BoolArray:
    """Points within a distance in plan of a point that lies on another true plane."""
    xy = roof.candidate.points[:, :2]
    tree = shapely.STRtree(shapely.points(xy))
    first, second = tree.query(shapely.points(xy), predicate="dwithin", distance=reach_m)
    near = np.zeros(len(xy), bool)
    near[first[roof.labels[first] != roof.labels[second]]] = True
    return near


def centre_elsewhere(place: str) -> Centre:
    """In place of the centre of Eq. 7: `roof` (without its ground), `corner`, or metres south-west of it (`1000`).

    The corner is the lowest of the building with its ground, so that all coordinates are positive, as the paper says
    they were at first.
    """
    if place == "roof":
        return lambda points: centre_of_building(points[points[:, 2] > points[:, 2].min() + _OVER_GROUND_M])
    away_m = 0.0 if place == "corner" else float(place) / math.sqrt(2.0)
    return lambda points: np.asarray(points.min(axis=0) - (away_m, away_m, 0.0))


def unscaled_spherical(angle_unit: float) -> Vectors:
    """In place of `facet_vectors`: (r, theta, phi) as they are, metres and multiples of an angle in radians."""

    def vectors(
        kind: str, normals: FloatArray, centroids: FloatArray, centre: FloatArray, *, scaled_min: float = 0.0
    ) -> FloatArray:
        with mock.patch.object(clustering, "_to_one_range", lambda values, _: values):
            spherical = facet_vectors(kind, normals, centroids, centre, scaled_min=scaled_min)
        return spherical * (1.0, 1.0 / angle_unit, 1.0 / angle_unit)

    return vectors


def degrees_of_match(vectors: FloatArray) -> FloatArray:
    """VDM (Eqs. 3 to 6) of all pairs, (k, k) float64; 0 for zero vectors."""
    modules = np.linalg.norm(vectors, axis=1)
    product = modules[:, None] * modules[None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        angles = np.arccos(np.clip(vectors @ vectors.T / product, -1.0, 1.0))
        modules_match = np.minimum.outer(modules, modules) / np.maximum.outer(modules, modules)
    return np.asarray(np.where(product > 0.0, modules_match * (1.0 - angles / math.pi), 0.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class FacetPairs:
    """Pairs of roof facets, each facet on one true plane."""

    match: FloatArray
    """(p,) float64, their VDM."""
    same: BoolArray
    """(p,) bool, whether they are of one plane."""
    apart: FloatArray
    """(p, 3) float64, absolute difference of their vectors in each dimension."""


def facet_pairs(roof: SyntheticRoof, seen: Observed, limit: int = 150) -> FacetPairs:
    """All pairs of at most `limit` facets, evenly taken."""
    truth = facet_truth(roof, seen)[seen.vector_facets]
    known = np.flatnonzero(truth >= 0)
    if len(known) > limit:
        known = known[np.linspace(0, len(known) - 1, limit).astype(int)]
    i, j = np.tril_indices(len(known), -1)
    vectors = seen.vectors[known]
    return FacetPairs(
        match=degrees_of_match(vectors)[i, j],
        same=truth[known[i]] == truth[known[j]],
        apart=np.abs(vectors[i] - vectors[j]),
    )
