"""Wavefront OBJ: full coordinates, one `o` per closed solid, groups by the kind of face, one material per roof plane.

The groups are roof, wall, ground, ceiling (undersides of overhangs) and closure (feet of boxes on roofs). There is no
`mtllib`: a material's name says which roof plane a face belongs to (`roof_3` is plane_id 3), and the viewer chooses its
colour. Programs make a default material of each name.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pipeline.export.solid_geometry import model_at
from pipeline.export.stored_coordinates import SpatialReference, crs_coordinates, decimals
from pipeline.model import BuildingResult, FaceKind, FloatArray, Solid, SolidFace

_KINDS = (FaceKind.ROOF, FaceKind.WALL, FaceKind.GROUND, FaceKind.CEILING, FaceKind.CLOSURE)


def obj_text(results: Iterable[BuildingResult], reference: SpatialReference, lod: str | None = None) -> str:
    """The solids of one or more buildings as one OBJ file; buildings without a solid are left out.

    Every solid has its own vertices, so it is closed. Faces without holes stay polygons, those with holes become
    triangles on the same vertices. `lod` is another level of detail in place of the records' own (`model_at`).
    """
    unit = f"{reference.horizontal_unit_m:.12g} m horizontally, {reference.vertical_unit_m:.12g} m vertically"
    lines = [f"# coordinates are easting, northing, elevation; one unit is {unit}"]
    written = 0
    for result in results:
        model = model_at(result, lod)
        solids = [(part_id(result, part), solid) for part, solid in enumerate(model.solids if model else ())]
        if model and model.lod == "2.2":
            solids += [(box_id(result, number), solid) for number, solid in enumerate(result.boxes or ())]
        for name, solid in solids:
            lines.append(f"o {name}")
            lines.extend(vertex_lines(crs_coordinates(solid.vertices, result.origin, reference), reference))
            lines.extend(_face_lines(solid, written + 1))
            written += len(solid.vertices)
    return "\n".join(lines) + "\n"


def part_id(result: BuildingResult, part: int) -> str:
    """The name of one of a building's solids, in OBJ and CityJSON alike."""
    return f"{result.building_id}-{part}"


def box_id(result: BuildingResult, number: int) -> str:
    """The name of one of the boxes on a building's roof, in OBJ and CityJSON alike."""
    return f"{result.building_id}-box{number}"


def vertex_lines(xyz: FloatArray, reference: SpatialReference) -> list[str]:
    """The `v` lines of coordinates (n, 3) in the units of the CRS."""
    plan, up = decimals(reference.horizontal_unit_m), decimals(reference.vertical_unit_m)
    return [f"v {x:.{plan}f} {y:.{plan}f} {z:.{up}f}" for x, y, z in xyz.tolist()]


def _material(face: SolidFace) -> str:
    """The material's name: a roof plane's own, else the kind's."""
    return f"roof_{face.plane}" if face.plane >= 0 else face.kind.value


def _face_lines(solid: Solid, first: int) -> list[str]:
    """The `g`, `usemtl` and `f` lines of a solid whose first vertex has the number `first`."""
    lines: list[str] = []
    for kind in _KINDS:
        faces = sorted((f for f in solid.faces if f.kind is kind), key=lambda f: f.plane)
        if faces:
            lines.append(f"g {kind.value}")
        material = ""
        for face in faces:
            if _material(face) != material:
                material = _material(face)
                lines.append(f"usemtl {material}")
            lines.extend("f " + " ".join(str(first + int(i)) for i in polygon) for polygon in _polygons(solid, face))
    return lines


def _polygons(solid: Solid, face: SolidFace) -> Sequence[Sequence[int]]:
    """The face's outer ring, or its triangles where it has holes."""
    if len(face.rings) == 1:
        return face.rings
    from pipeline.triangulation.one_face import triangulate_face  # few faces have holes

    triangles: list[list[int]] = triangulate_face(solid.vertices, face.rings).tolist()
    return triangles
