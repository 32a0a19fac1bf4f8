"""Exact roofs: bodies with planes over polygons, sampled with their true labels."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.model import Candidate, FloatArray, LabelArray, Plane, Solid
from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPlan, RoofPoints, partition_roof, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.solid import SolidPart, solid_parts
from pipeline.roof.traced_forms import plan_forms

FLOOR_M = 0.0

Body = tuple[shapely.Polygon, tuple[tuple[float, float, float], ...]]
"""A polygon and planes (a, b, c): the body's roof is the lowest of the planes; the building's the highest body."""


ROOFS: dict[str, tuple[Body, ...]] = {
    "flat": ((shapely.box(0, 0, 12, 8), ((0.0, 0.0, 5.0),)),),
    "pent": ((shapely.box(0, 0, 12, 8), ((0.3, 0.0, 4.0),)),),
    "gable": ((shapely.box(0, 0, 12, 8), ((0.0, 0.7, 3.0), (0.0, -0.7, 8.6))),),
    "hip": ((shapely.box(0, 0, 14, 8), ((0.0, 0.6, 3.0), (0.0, -0.6, 7.8), (0.6, 0.0, 3.0), (-0.6, 0.0, 11.4))),),
    "l": (
        (shapely.box(0, 0, 16, 8), ((0.0, 0.7, 3.0), (0.0, -0.7, 8.6))),
        (shapely.box(0, 0, 6, 16), ((0.7, 0.0, 3.0), (-0.7, 0.0, 7.2))),
    ),
    "stepped": (
        (shapely.box(0, 0, 7, 8), ((0.0, 0.0, 9.0),)),
        (shapely.box(7, 0, 14, 8), ((0.0, 0.0, 5.0),)),
    ),
    "courtyard": ((shapely.box(0, 0, 20, 20).difference(shapely.box(6, 6, 14, 14)), ((0.0, 0.1, 5.0),)),),
    "dormer": (
        (shapely.box(0, 0, 12, 10), ((0.0, 0.8, 3.0), (0.0, -0.8, 11.0))),
        (shapely.box(4, 1, 7, 5), ((0.0, 0.1, 5.6),)),
    ),
    "tower": (
        (shapely.box(0, 0, 16, 12), ((0.0, 0.0, 5.0),)),
        (shapely.box(6, 4, 10, 8), ((0.0, 0.0, 14.0),)),
    ),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExactRoof:
    """A sampled roof and its truth."""

    candidate: Candidate
    """Points without noise unless asked for; the floor at 0."""
    labels: LabelArray
    """True plane of every point."""
    planes: tuple[Plane, ...]
    """The true planes."""
    volume_m3: float
    """The true volume."""
    footprint: shapely.Polygon
    """The true footprint."""

    def partition(self, settings: RoofSettings | None = None) -> tuple[RoofPlan, RoofPoints, RoofSettings]:
        """The roof's plan from its true labels."""
        settings = settings or RoofSettings()
        roof = roof_points(prepare_cloud(self.candidate), settings)
        roof = dataclasses.replace(roof, labels=self.labels[roof.index])
        return partition_roof(roof, self.planes, settings), roof, settings

    def drawn(self, settings: RoofSettings | None = None) -> RoofPartition:
        """The first form of the plan."""
        return next(plan_forms(*self.partition(settings)))()

    def parts(self, settings: RoofSettings | None = None) -> list[SolidPart]:
        """Its solids from the true labels, in the first form."""
        return solid_parts(self.drawn(settings), self.planes, FLOOR_M)


def heights(bodies: tuple[Body, ...], xy: FloatArray) -> tuple[FloatArray, LabelArray]:
    """True roof height (nan outside) and plane number at positions."""
    z = np.full(len(xy), -np.inf)
    labels = np.full(len(xy), -1, np.int32)
    first = 0
    for polygon, planes in bodies:
        inside = shapely.intersects_xy(polygon, xy[:, 0], xy[:, 1])
        each = np.array([a * xy[:, 0] + b * xy[:, 1] + c for a, b, c in planes])
        top = np.where(inside, each.min(axis=0), -np.inf)
        higher = top > z
        labels[higher] = first + each.argmin(axis=0)[higher]
        z[higher] = top[higher]
        first += len(planes)
    z[labels < 0] = np.nan
    return z, labels


def sample(
    kind: str,
    *,
    density: float = 8.0,
    noise_m: float = 0.0,
    seed: int = 0,
    turn_deg: float = 0.0,
    with_footprint: bool = False,
) -> ExactRoof:
    """Strew points over a roof; the roof can be turned about the origin."""
    bodies = ROOFS[kind]
    footprint = shapely.union_all([polygon for polygon, _ in bodies])
    x0, y0, x1, y1 = footprint.bounds
    rng = np.random.default_rng(seed)
    n = round(density * (x1 - x0) * (y1 - y0))
    xy = np.column_stack((rng.uniform(x0, x1, n), rng.uniform(y0, y1, n)))
    z, labels = heights(bodies, xy)
    xy, z, labels = xy[labels >= 0], z[labels >= 0], labels[labels >= 0]
    z = z + rng.normal(0.0, noise_m, len(z))
    cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    turned = np.column_stack((cosine * xy[:, 0] - sine * xy[:, 1], sine * xy[:, 0] + cosine * xy[:, 1]))
    points = np.rint(np.column_stack((turned, z)) * 1e3) / 1e3
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0]))
    made = candidate(points, origin=(0.0, 0.0, 0.0))
    outline = shapely.affinity.rotate(footprint, turn_deg, origin=(0.0, 0.0))
    step = 0.05
    lattice = np.stack(np.meshgrid(np.arange(x0 + step / 2, x1, step), np.arange(y0 + step / 2, y1, step)), -1)
    planes = [(cosine * a - sine * b, sine * a + cosine * b, c) for _, group in bodies for a, b, c in group]
    return ExactRoof(
        candidate=dataclasses.replace(made, footprint=outline if with_footprint else None),
        labels=labels[order],
        planes=tuple(Plane(a=a, b=b, c=c, n_points=1, rmse_m=0.0) for a, b, c in planes),
        volume_m3=float(np.nansum(heights(bodies, lattice.reshape(-1, 2))[0]) * step * step),
        footprint=outline,
    )


@pytest.fixture(scope="session")
def exact_roof() -> Callable[..., ExactRoof]:
    """`exact_roof(kind, density=, noise_m=, seed=, turn_deg=, with_footprint=)`."""
    return sample


def volume_m3(solid: Solid) -> float:
    """Volume by the divergence theorem over planar faces."""
    total = 0.0
    for face in solid.faces:
        area = np.zeros(3)
        for ring in face.rings:
            p = solid.vertices[list(ring)]
            area += 0.5 * np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)
        total += float(solid.vertices[face.rings[0][0]] @ area)
    return total / 3.0


@pytest.fixture(scope="session")
def volume() -> Callable[[Solid], float]:
    """`volume(solid)` in cubic metres."""
    return volume_m3
