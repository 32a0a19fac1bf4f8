"""Small buildings with known dimensions: what the exports are fed in tests."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from shapely import Polygon, unary_union

from pipeline.export.record_rows import RecordContext, RejectedObject
from pipeline.extras.lods.overhangs import overhanging_solids
from pipeline.extras.superstructures.boxes import box_solid
from pipeline.extras.superstructures.finding import FoundBox
from pipeline.model import (
    BuildingResult,
    FaceKind,
    LodModel,
    ModelQuality,
    Overhangs,
    OverhangSource,
    Plane,
    Reason,
    RoofFace,
    RoofType,
    Solid,
    SolidFace,
    Status,
)
from pipeline.quality.validity import check_solid
from pipeline.roof.solid import SolidPart

ORIGIN = (85_000.0, 447_000.0, 2.0)

Corner = tuple[float, float, float]
Builder = Callable[[], BuildingResult]
Contexts = dict[str, RecordContext]
RejectedObjects = list[RejectedObject]


@dataclasses.dataclass(frozen=True)
class Reference:
    """A coordinate reference system as the exports see it."""

    epsg: int | None = None
    horizontal_unit_m: float = 1.0
    vertical_unit_m: float = 1.0
    projjson: dict[str, Any] | None = None


def _loops(edges: set[tuple[int, int]]) -> list[list[int]]:
    """Closed rings of directed edges with one way on at every vertex."""
    following = dict(sorted(edges))
    loops = []
    while following:
        loop = [min(following)]
        while (after := following.pop(loop[-1])) != loop[0]:
            loop.append(after)
        loops.append(loop)
    return loops


def roofed_solid(
    corners: Sequence[Corner], roof: Sequence[Sequence[Sequence[int]]], floor_z: float, first_plane: int = 0
) -> Solid:
    """A closed solid: roof faces (rings counter-clockwise from above), a wall under every outer edge, one floor."""
    vertices = np.array(corners, dtype=np.float64)
    faces = [
        SolidFace(rings=tuple(tuple(ring) for ring in rings), kind=FaceKind.ROOF, plane=first_plane + plane)
        for plane, rings in enumerate(roof)
    ]
    edges = {(ring[i - 1], ring[i]) for rings in roof for ring in rings for i in range(len(ring))}
    boundary = {(a, b) for a, b in edges if (b, a) not in edges}
    below = {index: len(vertices) + n for n, index in enumerate(sorted({a for a, _ in boundary}))}
    vertices = np.vstack([vertices, [(*vertices[index, :2], floor_z) for index in below]])
    faces += [SolidFace(rings=((b, a, below[a], below[b]),), kind=FaceKind.WALL) for a, b in sorted(boundary)]
    loops = sorted(_loops(boundary), key=lambda loop: -float(np.ptp(vertices[loop, 0])))
    floor = tuple(tuple(below[index] for index in reversed(loop)) for loop in loops)
    return Solid(vertices=vertices, faces=(*faces, SolidFace(rings=floor, kind=FaceKind.GROUND)))


QUALITY = ModelQuality(
    point_spacing_m=0.48,
    noise_m=0.029,
    share_within=0.981,
    share_below_roof=0.0625,
    unexplained_m2=1.25,
    extrapolated_share=0.0625,
    largest_hole_m=1.4,
    ridge_z_sigma_m=0.017,
    bic_margin=12.5,
    is_curved=False,
)


def plane_of(solid: Solid, face: SolidFace) -> Plane:
    """The plane through a roof face."""
    xyz = solid.vertices[list(face.rings[0])]
    design = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    a, b, c = np.linalg.lstsq(design, xyz[:, 2], rcond=None)[0].round(12) + 0.0
    return Plane(a=float(a), b=float(b), c=float(c), n_points=100, rmse_m=0.03)


def building(
    building_id: str, *solids: Solid, origin: Corner = ORIGIN, floor_z: float = 0.0, **changes: Any
) -> BuildingResult:
    """The result of a building with these solids, whose roof planes are numbered through."""
    roof = {face.plane: (solid, face) for solid in solids for face in solid.faces if face.kind is FaceKind.ROOF}
    faces = [
        RoofFace(
            plane=face.plane,
            polygon=Polygon(
                solid.vertices[list(face.rings[0])], [solid.vertices[list(hole)] for hole in face.rings[1:]]
            ),
        )
        for solid in solids
        for face in solid.faces
        if face.kind is FaceKind.ROOF
    ]
    outline = unary_union([Polygon(face.polygon).buffer(0) for face in faces]) if faces else None
    fields: dict[str, Any] = {
        "building_id": building_id,
        "origin": origin,
        "source_id": None,
        "status": Status.OK,
        "reason": None,
        "reason_detail": "",
        "method": "fuzzy-sart",
        "roof_type": RoofType.GABLE,
        "lod": "2.2",
        "footprint": outline,
        "planes": tuple(plane_of(*roof[index]) for index in sorted(roof)),
        "faces": tuple(faces),
        "solids": solids,
        "validity_codes": (),
        "ground_z_m": floor_z,
        "n_points": 320,
        "density_per_m2": 4.0,
        "rmse_m": 0.0312,
        "p95_m": 0.0641,
        "coverage": 0.995,
        "quality": QUALITY,
        "touches_data_edge": False,
    }
    return BuildingResult(**{**fields, **changes})


def gable(building_id: str = "gable", east: float = 0.0, **changes: Any) -> BuildingResult:
    """10 m by 8 m, eaves at 3 m, ridge along the middle of the long way at 6 m."""
    return building(building_id, gable_solid(east), **changes)


def gable_solid(east: float = 0.0, first_plane: int = 0) -> Solid:
    corners = [(0, 0, 3), (10, 0, 3), (10, 8, 3), (0, 8, 3), (0, 4, 6), (10, 4, 6)]
    moved = [(x + east, float(y), float(z)) for x, y, z in corners]
    return roofed_solid(moved, [[[0, 1, 5, 4]], [[2, 3, 4, 5]]], 0.0, first_plane)


def pent(building_id: str = "pent") -> BuildingResult:
    """6 m by 6 m, rising from 3 m in the west to 5 m in the east."""
    corners = [(0.0, 0.0, 3.0), (6.0, 0.0, 5.0), (6.0, 6.0, 5.0), (0.0, 6.0, 3.0)]
    return building(building_id, roofed_solid(corners, [[[0, 1, 2, 3]]], 0.0), roof_type=RoofType.PENT)


def courtyard(building_id: str = "courtyard") -> BuildingResult:
    """A flat block of 20 m by 20 m, 9 m high, around a court of 10 m by 10 m."""
    outer = [(20.0, 0.0, 9.0), (40.0, 0.0, 9.0), (40.0, 20.0, 9.0), (20.0, 20.0, 9.0)]
    inner = [(25.0, 5.0, 9.0), (25.0, 15.0, 9.0), (35.0, 15.0, 9.0), (35.0, 5.0, 9.0)]
    solid = roofed_solid([*outer, *inner], [[[0, 1, 2, 3], [4, 5, 6, 7]]], 0.0)
    return building(
        building_id,
        solid,
        status=Status.FALLBACK,
        reason=Reason.INVALID_SOLID,
        reason_detail="code 203, 0.02 m off the plane",
        validity_codes=(203, 104),
        lod="1.2",
        roof_type=RoofType.FLAT,
    )


def two_parts(building_id: str = "two_parts") -> BuildingResult:
    """Two touching gables, a solid each."""
    return building(building_id, gable_solid(), gable_solid(10.0, 2))


def overhung(building_id: str = "overhung") -> BuildingResult:
    """The gable with its walls 0.5 m inside the eaves: LoD2.3 beside LoD2.2."""
    result = building(building_id, gable_solid())
    plan = shapely.box(0.0, 0.0, 10.0, 8.0)
    part = SolidPart(solid=result.solids[0], faces=result.faces, footprint=plan)
    walls_mm = shapely.MultiPolygon([shapely.box(500, 500, 9500, 7500)])
    solids = overhanging_solids([part], result.planes, walls_mm, 0.2, 0.1, lambda solid: not check_solid(solid))
    return dataclasses.replace(result, overhangs=Overhangs(solids=tuple(solids), source=OverhangSource.SEEN))


def boxed(building_id: str = "boxed") -> BuildingResult:
    """The gable with two boxes on its roof, one of them across the ridge, and its main roof, which is the same."""
    result = building(building_id, gable_solid())
    places = (2.0, 1.0, 2.7, 1.8), (6.0, 3.5, 7.0, 4.5)
    found = [
        FoundBox(corners=np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), top_z_m=9.0) for x0, y0, x1, y1 in places
    ]
    solids = [box_solid(box, result.faces, result.planes) for box in found]
    main = LodModel(lod="2.0", planes=result.planes, solids=result.solids)
    return dataclasses.replace(result, boxes=tuple(solid for solid in solids if solid is not None), coarser=(main,))


def levelled(building_id: str = "levelled") -> BuildingResult:
    """A gable and, 10 m east of it, a flat annexe of 4 m by 8 m: all levels of detail, all figures of quality."""
    corners = [(20.0, 0.0, 3.0), (24.0, 0.0, 3.0), (24.0, 8.0, 3.0), (20.0, 8.0, 3.0)]
    detailed = gable_solid(), roofed_solid(corners, [[[0, 1, 2, 3]]], 0.0, 2)
    quality = ModelQuality(
        point_spacing_m=0.5, noise_m=0.03, share_within=0.98, unexplained_m2=1.5, extrapolated_share=0.01,
        largest_hole_m=1.2,
        ridge_z_sigma_m=0.02, bic_margin=14.0,
    )  # fmt: skip
    coarser = levels("1.3", 4.75, 3.0), levels("1.2", 4.5, 4.5)
    return building(building_id, *detailed, coarser=coarser, quality=quality, footprint_share=0.98)


def levels(lod: str, *heights: float) -> LodModel:
    """Blocks under `levelled`: over the gable, and over the annexe."""
    plans = [(0.0, 10.0), (20.0, 24.0)]
    solids = []
    for number, ((west, east), z) in enumerate(zip(plans, heights, strict=True)):
        corners = [(west, 0.0, z), (east, 0.0, z), (east, 8.0, z), (west, 8.0, z)]
        solids.append(roofed_solid(corners, [[[0, 1, 2, 3]]], 0.0, number))
    planes = tuple(Plane(a=0.0, b=0.0, c=z, n_points=100, rmse_m=0.5) for z in heights)
    return LodModel(lod=lod, planes=planes, solids=tuple(solids))


def failed(building_id: str = "failed") -> BuildingResult:
    """A candidate without model and without outline."""
    return building(
        building_id,
        status=Status.FAILED,
        reason=Reason.TOO_FEW_POINTS,
        reason_detail="2 points, at least 6",
        roof_type=RoofType.NONE,
        lod="",
        density_per_m2=float("nan"),
        rmse_m=float("nan"),
        p95_m=float("nan"),
        coverage=0.0,
        quality=ModelQuality(),
        n_points=2,
    )
