"""Wavefront OBJ: objects are buildings; names of groups and materials mark roofs, walls and ground."""

from __future__ import annotations

import dataclasses
import math
import re
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from pipeline.errors import EmptyInputError, UnreadableInputError
from pipeline.model import FaceKind, FloatArray
from pipeline.ruler.evaluation.reading.collected import Collected, model_of
from pipeline.ruler.evaluation.reading.model_surfaces import assemble
from pipeline.ruler.evaluation.reading.raw import (
    RawFace,
    RawPart,
    connected,
    grouped,
    is_closed,
    kind_in_name,
    raw_part,
)

_OWN_HEADER = re.compile(
    rb"^# coordinates are easting, northing, elevation; one unit is (\S+) m horizontally, (\S+) m vertically"
)
"""First line of the files of this program: it states the units, and objects are then parts of buildings."""
_OWN_MATERIAL = re.compile(r"^roof_(\d+)$")
_COARSER_STEM = re.compile(r"^(.+)-lod\d+$")
"""Name of a file of this program with a coarser level of detail than the file of the name before the suffix."""
_MIN_SOLID_FACES = 4
"""A tetrahedron: a group with fewer faces is not a building."""


@dataclasses.dataclass(kw_only=True)
class _Mesh:
    """The content of a file: all vertices, faces by object and group."""

    coordinates: array[float] = dataclasses.field(default_factory=lambda: array("d"))
    """x, y, z of all vertices, one after the other."""
    objects: dict[str, list[RawFace]] = dataclasses.field(default_factory=dict)
    """Faces by the name of their `o`; empty name before the first."""
    groups: dict[str, list[RawFace]] = dataclasses.field(default_factory=dict)
    """Faces by the name of their `g` if it does not name a kind, for files without `o`; else by the empty name."""
    units_m: tuple[float, float] | None = None
    """Metres per horizontal and per vertical unit, in files of this program."""

    @property
    def is_own(self) -> bool:
        """True where this program wrote the file."""
        return self.units_m is not None

    def vertices(self) -> FloatArray:
        """(n, 3) float64 metres."""
        horizontal, vertical = self.units_m or (1.0, 1.0)
        xyz: FloatArray = np.frombuffer(self.coordinates, np.float64).reshape(-1, 3)
        return xyz * [horizontal, horizontal, vertical]


def read_obj_files(paths: Sequence[Path], into: Collected) -> None:
    """Read the buildings of some OBJ files.

    Each `o` is a building; in files of this program, a part of one. Without `o`, each group is a building if it does
    not name a kind and has enough faces for a solid. Otherwise a file is a building, or if it is the only one, all
    faces that touch in plan are a building. Coarser levels of detail are skipped if the finest is there. An InputError
    names file and line of what is broken.
    """
    pieces: dict[str, list[RawPart]] = {}
    known = set(paths)
    coarser = {path for path in paths if (m := _COARSER_STEM.match(path.stem)) and path.with_stem(m[1]) in known}
    for path in paths:
        if path in coarser:
            into.count("{n} files of coarser levels of detail are passed over")
            continue
        mesh = _read(path)
        if not mesh.is_own:
            into.note("an OBJ has no units and no reference system: coordinates are taken as metres")
        try:
            named = _buildings(mesh, path, into, alone=len(paths) == 1)
        except ValueError as fault:
            raise UnreadableInputError(str(path), str(fault), "Write the file again") from fault
        for name, parts in named.items():
            if mesh.is_own:
                pieces.setdefault(name, []).extend(parts)
            else:
                into.add(model_of(name, assemble(parts)))
    for name, parts in pieces.items():
        into.add(model_of(name, assemble(parts)))


def _buildings(mesh: _Mesh, path: Path, into: Collected, *, alone: bool) -> dict[str, list[RawPart]]:
    """The parts of each building of a file by its name."""
    vertices = mesh.vertices()
    objects = {name: faces for name, faces in mesh.objects.items() if faces}
    if not objects:
        raise EmptyInputError(str(path), "the file has no faces", "Give an OBJ with `f` lines")
    if set(objects) != {""}:
        buildings: dict[str, list[RawPart]] = {}
        for name, faces in objects.items():
            building = name.rpartition("-")[0] or name if mesh.is_own else name or path.stem
            parts = [_part(vertices, faces)] if mesh.is_own else _parts(vertices, faces)
            buildings.setdefault(building, []).extend(parts)
        return buildings
    groups = {name: faces for name, faces in mesh.groups.items() if faces}
    if len(groups) > 1 and all(name and len(faces) >= _MIN_SOLID_FACES for name, faces in groups.items()):
        into.note("an OBJ without `o`: each of its groups is taken as a building")
        return {name: _parts(vertices, faces) for name, faces in groups.items()}
    parts = _parts(vertices, objects[""])
    touching = _touching(parts) if alone else [parts]
    if len(touching) == 1:
        return {path.stem: parts}
    into.note("an OBJ without names of objects: what touches in plan is taken as one building")
    return {f"{path.stem}-{number}": members for number, members in enumerate(touching)}


def _part(vertices: FloatArray, faces: Sequence[RawFace]) -> RawPart:
    """Faces as one part; a solid if they are closed."""
    part = raw_part(vertices, faces, is_solid=False)
    return dataclasses.replace(part, is_solid=is_closed(part.xyz, (face.rings for face in part.faces)))


def _parts(vertices: FloatArray, faces: Sequence[RawFace]) -> list[RawPart]:
    """Connected pieces, one part each."""
    return [_part(piece.xyz, piece.faces) for piece in connected(raw_part(vertices, faces, is_solid=False))]


def _touching(parts: Sequence[RawPart]) -> list[list[RawPart]]:
    """Parts whose plans touch, together, in the order of their first ones."""
    plans = []
    for part in parts:
        rings = [part.xyz[list(face.rings[0]), :2] for face in part.faces if len(face.rings[0]) >= 3]
        polygons = shapely.make_valid([shapely.Polygon(ring) for ring in rings])
        plans.append(shapely.union_all(polygons, grid_size=0.001))
    pairs = shapely.STRtree(plans).query(plans, predicate="intersects").T.tolist()
    return [[parts[number] for number in members] for members in grouped(len(parts), pairs)]


def _read(path: Path) -> _Mesh:
    """The faces of a file."""
    mesh = _Mesh()
    number = 0
    try:
        with path.open("rb") as stream:
            state = _State(mesh)
            for number, line in enumerate(stream, start=1):
                if number == 1 and (own := _OWN_HEADER.match(line)):
                    mesh.units_m = (float(own[1]), float(own[2]))
                words = line.decode("utf-8", "replace").split()
                if words:
                    state.take(words)
    except OSError as error:
        raise UnreadableInputError(str(path), str(error), "Give a readable OBJ file") from error
    except (ValueError, IndexError) as fault:
        raise UnreadableInputError(str(path), f"line {number}: {fault}", "Write the file again as OBJ") from fault
    return mesh


class _State:
    """State of the reader: current object, group and material."""

    def __init__(self, mesh: _Mesh) -> None:
        self.mesh = mesh
        self.object = ""
        self.group = ""
        self.kind_of_group: FaceKind | None = None
        self.kind_of_material: FaceKind | None = None
        self.plane = -1
        self.vertices = 0

    def take(self, words: list[str]) -> None:
        """Read one line; statements without polygons are skipped. Raises ValueError if it is broken."""
        key = words[0]
        if key == "v":
            self._vertex(words)
        elif key == "f":
            self._face(words[1:])
        elif key == "o":
            self.object = " ".join(words[1:])
            self._enter_group("")
        elif key == "g":
            self._enter_group(" ".join(words[1:]))
        elif key == "usemtl":
            material = " ".join(words[1:])
            self.kind_of_material = kind_in_name(material)
            plane = _OWN_MATERIAL.match(material) if self.mesh.is_own else None
            self.plane = int(plane[1]) if plane else -1

    def _enter_group(self, name: str) -> None:
        self.kind_of_group = kind_in_name(name)
        self.group = "" if self.kind_of_group is not None else name

    def _vertex(self, words: list[str]) -> None:
        if len(words) < 4:
            raise ValueError(f"a vertex of {len(words) - 1} coordinates: three are needed")
        xyz = [float(word) for word in words[1:4]]
        if not all(map(math.isfinite, xyz)):
            raise ValueError(f"vertex {' '.join(words[1:4])} is not finite")
        self.mesh.coordinates.extend(xyz)
        self.vertices += 1

    def _face(self, words: list[str]) -> None:
        if len(words) < 3:
            raise ValueError(f"a face of {len(words)} vertices: three are needed")
        ring = []
        for word in words:
            index = int(word.partition("/")[0])
            place = index - 1 if index > 0 else self.vertices + index
            if index == 0 or not 0 <= place < self.vertices:
                raise ValueError(f"a face names vertex {index}, {self.vertices} are there so far")
            ring.append(place)
        kind = self.kind_of_group or self.kind_of_material
        face = RawFace((tuple(ring),), kind, self.plane if kind is FaceKind.ROOF else -1)
        self.mesh.objects.setdefault(self.object, []).append(face)
        self.mesh.groups.setdefault(self.group, []).append(face)
