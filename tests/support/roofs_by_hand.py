"""Small buildings built by hand for the tests of the evaluation, known damage, and simulated scenes as models."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import shapely
from shapely import affinity

from pipeline.model import RoofType
from pipeline.ruler.evaluation.measure import Measure
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import Conditions, Reference, ReferencePoints
from pipeline.ruler.evaluation.residual_scores import BIAS, COVERAGE, RMSE, WITHIN, Tallies
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import RoofShape
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain, place_building

ORIGIN = (1000.0, 2000.0, 0.0)
EXTENT = shapely.box(900.0, 1900.0, 1600.0, 2300.0)


def rows(columns: Mapping[str, Any]) -> list[SimpleNamespace]:
    """Columns of one length, row by row."""
    return [SimpleNamespace(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def tally_rows(tallies: Tallies, **more: Any) -> list[SimpleNamespace]:
    """The sums and figures of each building; its own columns replace them."""
    figures = {"rmse_m": RMSE, "bias_m": BIAS, "share_within": WITHIN, "coverage": COVERAGE}
    figures |= {"median_m": tallies.quantile(0.5), "p95_m": tallies.quantile(0.95)}
    columns = {name: tallies.figure(of) for name, of in figures.items()}
    return rows({**tallies.columns(), "histogram": tallies.histogram, **columns, **more})


def surface(ring: Any, coefficients: tuple[float, float, float], plane_id: int = 0, group: int = -1) -> RoofSurface:
    """A face over a ring in metres from ORIGIN, its plane about ORIGIN."""
    polygon = affinity.translate(shapely.Polygon(ring), ORIGIN[0], ORIGIN[1])
    return RoofSurface(polygon=polygon, coefficients=coefficients, origin=ORIGIN, plane_id=plane_id, group=group)


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def model(name: str, roof_type: RoofType, surfaces: Sequence[RoofSurface], **more: Any) -> RoofModel:
    """A model whose footprint is what its faces cover."""
    footprint = shapely.union_all([one.polygon for one in surfaces])
    return RoofModel(building_id=name, footprint=footprint, roof_type=roof_type, surfaces=tuple(surfaces), **more)


def gable(name: str, x: float = 0.0, *, slope: float = 0.7, lift: float = 0.0, **more: Any) -> RoofModel:
    """A gable of 12 x 8 m in plan, eave at 4 m, its ridge along x in the middle of it; two faces of 48 m2 in plan."""
    sides = [
        surface(rectangle(x, 0, x + 12, 4), (0.0, slope, 4.0 + lift), 0),
        surface(rectangle(x, 4, x + 12, 8), (0.0, -slope, 4.0 + 8 * slope + lift), 1),
    ]
    return model(name, RoofType.GABLE, sides, **more)


def flat(
    name: str, x: float = 0.0, *, width: float = 10.0, depth: float = 8.0, z: float = 6.0, **more: Any
) -> RoofModel:
    return model(name, RoofType.FLAT, [surface(rectangle(x, 0, x + width, depth), (0.0, 0.0, z), 0)], **more)


def hip(name: str, x: float = 0.0, *, slope: float = 0.7, **more: Any) -> RoofModel:
    """A hip roof of 14 x 8 m in plan, eave at 4 m: two sides of 40 m2 and two ends of 16 m2 in plan."""
    sides = [
        surface([(x, 0), (x + 14, 0), (x + 10, 4), (x + 4, 4)], (0.0, slope, 4.0), 0),
        surface([(x + 14, 8), (x, 8), (x + 4, 4), (x + 10, 4)], (0.0, -slope, 4.0 + 8 * slope), 1),
        surface([(x, 8), (x, 0), (x + 4, 4)], (slope, 0.0, 4.0 - slope * x), 2),
        surface([(x + 14, 0), (x + 14, 8), (x + 10, 4)], (-slope, 0.0, 4.0 + slope * (x + 14)), 3),
    ]
    return model(name, RoofType.HIP, sides, **more)


def bent_gable(name: str, *, lower: float = 0.4, upper: float = 0.6, bend: float = 2.0) -> RoofModel:
    """A gable of 12 x 12 m whose sides are flatter below the bend: each side is a group of two faces."""
    eave, break_z = 4.0, 4.0 + lower * bend
    sides = [
        surface(rectangle(0, 0, 12, bend), (0.0, lower, eave), 0, 0),
        surface(rectangle(0, bend, 12, 6), (0.0, upper, break_z - upper * bend), 1, 0),
        surface(rectangle(0, 12 - bend, 12, 12), (0.0, -lower, eave + 12 * lower), 2, 1),
        surface(rectangle(0, 6, 12, 12 - bend), (0.0, -upper, break_z + upper * (12 - bend)), 3, 1),
    ]
    return model(name, RoofType.GABLE, sides)


def reference(buildings: Sequence[RoofModel], **more: Any) -> Reference:
    """True buildings, complete in EXTENT."""
    settings: dict[str, Any] = {"extent": EXTENT, "has_faces": True} | more
    return Reference(name="by hand", kind="truth", buildings=tuple(buildings), outlines="truth", tiles=(), **settings)


def points_of(xyz: np.ndarray, classification: Any, name: str = "t", **fields: Any) -> ReferencePoints:
    """Points of a reference; by default last returns on no building and no roof."""
    values = {"building": -1, "face": -1, "is_roof": False, "last": True} | fields
    whole = {
        key: np.full(len(xyz), value, bool if key in ("is_roof", "last") else np.int32) for key, value in values.items()
    }
    return ReferencePoints(name=name, xyz=xyz, classification=np.full(len(xyz), classification, np.int32), **whole)


def conditions(*, good: bool, shape: str = "gable") -> Conditions:
    defects = () if good else ("wet_spot",)
    return Conditions(shape=shape, good=good, defects=defects, pitch_deg=35.0, terrain_slope_deg=0.0)


def with_face(one: RoofModel, place: int, face: RoofSurface | None) -> RoofModel:
    """The model with another face in a place, or without it; its footprint stays."""
    rest = [*one.surfaces[:place], *([] if face is None else [face]), *one.surfaces[place + 1 :]]
    return dataclasses.replace(one, surfaces=tuple(rest))


def lifted(face: RoofSurface, metres: float) -> RoofSurface:
    a, b, c = face.coefficients
    return dataclasses.replace(face, coefficients=(a, b, c + metres))


def turned(face: RoofSurface, degrees: float) -> RoofSurface:
    """The face steeper by an angle, about the horizontal line through its middle."""
    a, b, _ = face.coefficients
    rise, middle = math.hypot(a, b), face.polygon.centroid
    steeper = math.tan(math.atan(rise) + math.radians(degrees))
    a, b = (a * steeper / rise, b * steeper / rise) if rise else (0.0, steeper)
    z = float(face.elevation(np.array([middle.x]), np.array([middle.y]))[0])
    return dataclasses.replace(face, coefficients=(a, b, z), origin=(middle.x, middle.y, 0.0))


def shrunk(one: RoofModel, metres: float) -> RoofModel:
    """The model with its footprint drawn in all round, its faces cut to it."""
    footprint = one.footprint.buffer(-metres, join_style="mitre")
    faces = [dataclasses.replace(face, polygon=face.polygon.intersection(footprint)) for face in one.surfaces]
    return dataclasses.replace(one, footprint=footprint, surfaces=tuple(faces))


def moved(one: RoofModel, x: float, y: float, z: float, turn_deg: float = 0.0) -> RoofModel:
    """The model turned about the origin of coordinates and then shifted."""
    cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))

    def placed(geometry: Any) -> Any:
        return affinity.affine_transform(geometry, [cosine, -sine, sine, cosine, x, y])

    faces = []
    for face in one.surfaces:
        a, b, c = face.coefficients
        at_x, at_y, at_z = face.origin
        origin = cosine * at_x - sine * at_y + x, sine * at_x + cosine * at_y + y, at_z + z
        slope = cosine * a - sine * b, sine * a + cosine * b
        faces.append(dataclasses.replace(face, polygon=placed(face.polygon), coefficients=(*slope, c), origin=origin))
    return dataclasses.replace(one, footprint=placed(one.footprint), surfaces=tuple(faces))


def scene_of_all_shapes(seed: int) -> Scene:
    """One building of every shape, of random size and direction, in a row."""
    random, terrain = np.random.default_rng(seed), Terrain(base_z_m=10.0)
    buildings = tuple(
        place_building(
            shape.value,
            shape,
            random_dimensions(shape, random),
            at=(60.0 * number, 0.0),
            azimuth_deg=random.uniform(0.0, 360.0),
            eave_height_m=random.uniform(3.0, 9.0),
            terrain=terrain,
        )
        for number, shape in enumerate(RoofShape)
    )
    return Scene(
        name="shapes",
        origin=(5000.0, 7000.0, 0.0),
        crs=None,
        extent=(-60.0, -60.0, 60.0 * len(buildings), 60.0),
        terrain=terrain,
        buildings=buildings,
    )


def models_of_scene(scene: Scene) -> list[RoofModel]:
    """The buildings of a simulated scene, in its CRS."""
    x, y, _ = scene.origin
    found = []
    for building in scene.buildings:
        faces = [
            RoofSurface(
                polygon=affinity.translate(shapely.force_2d(polygon), x, y),
                coefficients=plane.coefficients,
                origin=scene.origin,
                plane_id=number,
                group=group,
            )
            for number, (polygon, plane, group) in enumerate(
                zip(building.roof_polygons(), building.planes, building.groups, strict=True)
            )
        ]
        found.append(
            RoofModel(
                building_id=building.building_id,
                footprint=affinity.translate(building.footprint, x, y),
                roof_type=building.roof_type,
                surfaces=tuple(faces),
                source_id=building.block_id,
            )
        )
    return found


def values(measures: Sequence[Measure]) -> dict[str, float]:
    """Figures by the last part of their name."""
    return {one.name.split(".", 1)[1]: one.value for one in measures}
