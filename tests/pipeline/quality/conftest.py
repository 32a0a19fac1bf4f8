"""Solids that are valid, and the same broken on purpose, for every test of this layer."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from pipeline.model import FaceKind, Solid, SolidFace

Place = tuple[float, float, float]
Rings = list[list[Place]]


def solid_of(faces: Sequence[Sequence[Sequence[Place]]]) -> Solid:
    """A solid from faces as rings of places in metres; equal places are one vertex."""
    numbers: dict[Place, int] = {}
    for face in faces:
        for ring in face:
            for place in ring:
                numbers.setdefault(place, len(numbers))
    return Solid(
        vertices=np.array(list(numbers), dtype=float),
        faces=tuple(
            SolidFace(rings=tuple(tuple(numbers[place] for place in ring) for ring in face), kind=FaceKind.WALL)
            for face in faces
        ),
    )


def places_of(solid: Solid) -> list[Rings]:
    """The inverse of `solid_of`."""
    places = [tuple(map(float, vertex)) for vertex in solid.vertices]
    return [[[places[i] for i in ring] for ring in face.rings] for face in solid.faces]  # type: ignore[misc]


def extruded(outer: Sequence[tuple[float, float]], holes: Sequence[Sequence[tuple[float, float]]], top: float) -> Solid:
    """A prism from z = 0 to its top over an outer ring (counter-clockwise) and holes (clockwise)."""
    rings = [list(outer), *map(list, holes)]
    faces: list[Rings] = [
        [[(x, y, top) for x, y in ring] for ring in rings],
        [[(x, y, 0.0) for x, y in reversed(ring)] for ring in rings],
    ]
    for ring in rings:
        for (x0, y0), (x1, y1) in zip(ring, [*ring[1:], ring[0]], strict=True):
            faces.append([[(x0, y0, 0.0), (x1, y1, 0.0), (x1, y1, top), (x0, y0, top)]])
    return solid_of(faces)


def moved(solid: Solid, x: float, y: float, z: float) -> Solid:
    """The solid elsewhere."""
    return dataclasses.replace(solid, vertices=solid.vertices + np.array([x, y, z]))


def cube(x: float = 0.0, y: float = 0.0, z: float = 0.0, size: float = 4.0) -> Solid:
    """An axis-parallel cube with its lowest corner at x, y, z."""
    return moved(extruded([(0.0, 0.0), (size, 0.0), (size, size), (0.0, size)], [], size), x, y, z)


def gable() -> Solid:
    """A house of 10 m by 8 m with its ridge 3 m above eaves of 4 m."""
    a, b, c, d = (0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (0.0, 8.0)
    ridge_west, ridge_east = (0.0, 4.0, 7.0), (10.0, 4.0, 7.0)
    low, high = [(*p, 0.0) for p in (a, b, c, d)], [(*p, 4.0) for p in (a, b, c, d)]
    return solid_of(
        [
            [[high[0], high[1], ridge_east, ridge_west]],
            [[high[2], high[3], ridge_west, ridge_east]],
            [[low[0], low[1], high[1], high[0]]],
            [[low[1], low[2], high[2], ridge_east, high[1]]],
            [[low[2], low[3], high[3], high[2]]],
            [[low[3], low[0], high[0], ridge_west, high[3]]],
            [low[::-1]],
        ]
    )


def ell() -> Solid:
    """A prism over an L."""
    return extruded([(0.0, 0.0), (9.0, 0.0), (9.0, 4.0), (4.0, 4.0), (4.0, 11.0), (0.0, 11.0)], [], 5.0)


def courtyard() -> Solid:
    """A prism with a courtyard: holes in roof and ground."""
    return extruded(
        [(0.0, 0.0), (12.0, 0.0), (12.0, 10.0), (0.0, 10.0)], [[(3.0, 3.0), (3.0, 7.0), (9.0, 7.0), (9.0, 3.0)]], 6.0
    )


def stepped() -> Solid:
    """Two flat roofs of 6 m and 3 m; the step's lower ends are vertices within the long walls' straight edges."""
    return solid_of(
        [
            [[(0, 0, 6), (5, 0, 6), (5, 8, 6), (0, 8, 6)]],
            [[(5, 0, 3), (10, 0, 3), (10, 8, 3), (5, 8, 3)]],
            [[(5, 0, 3), (5, 8, 3), (5, 8, 6), (5, 0, 6)]],
            [[(0, 0, 0), (5, 0, 0), (5, 0, 3), (5, 0, 6), (0, 0, 6)]],
            [[(5, 0, 0), (10, 0, 0), (10, 0, 3), (5, 0, 3)]],
            [[(10, 0, 0), (10, 8, 0), (10, 8, 3), (10, 0, 3)]],
            [[(10, 8, 0), (5, 8, 0), (5, 8, 3), (10, 8, 3)]],
            [[(5, 8, 0), (0, 8, 0), (0, 8, 6), (5, 8, 6), (5, 8, 3)]],
            [[(0, 8, 0), (0, 0, 0), (0, 0, 6), (0, 8, 6)]],
            [[(0, 8, 0), (5, 8, 0), (10, 8, 0), (10, 0, 0), (5, 0, 0), (0, 0, 0)]],
        ]
    )


def handle(gap: float = 1.0) -> Solid:
    """A tower with an arm that leaves its wall high up and comes back, but for a gap, to the same wall."""
    foot = 4.0 + gap
    profile = [(4.0, 9.0), (7.0, 9.0), (7.0, 3.0), (foot, 3.0), (foot, 5.0), (6.5, 5.0), (6.5, 7.0), (4.0, 7.0)]
    tower = places_of(extruded([(0.0, 0.0), (4.0, 0.0), (4.0, 8.0), (0.0, 8.0)], [], 10.0))
    tower[3].append([(4.0, 2.0, 7.0), (4.0, 2.0, 9.0), (4.0, 6.0, 9.0), (4.0, 6.0, 7.0)])
    arm: list[Rings] = [
        [[(x, 2.0, z) for x, z in reversed(profile)]],
        [[(x, 6.0, z) for x, z in profile]],
    ]
    for (x0, z0), (x1, z1) in itertools.pairwise(profile):
        arm.append([[(x0, 2.0, z0), (x1, 2.0, z1), (x1, 6.0, z1), (x0, 6.0, z0)]])
    return solid_of(tower + arm)


def terraces(cells: int) -> Solid:
    """A block of cells by cells rooms whose flat roofs rise in steps; every room has its own roof, floor and walls."""
    heights = {(i, j): 1 + (i + j) // 7 % 3 for i in range(cells) for j in range(cells)}

    def levels(corner: tuple[int, int], low: int, high: int) -> list[int]:
        around = {heights.get((corner[0] - a, corner[1] - b), 0) for a in (0, 1) for b in (0, 1)}
        return sorted(level for level in around if low <= level <= high)

    def place(corner: tuple[int, int], level: int) -> Place:
        return 3.0 * corner[0], 3.0 * corner[1], 2.5 * level

    faces: list[Rings] = []
    for (i, j), high in heights.items():
        plan = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        faces.append([[place(corner, high) for corner in plan]])
        faces.append([[place(corner, 0) for corner in reversed(plan)]])
        beside = [(i, j - 1), (i + 1, j), (i, j + 1), (i - 1, j)]
        for a, b, other in zip(plan, plan[1:] + plan[:1], beside, strict=True):
            low = heights.get(other, 0)
            if low < high:
                down, up = levels(a, low, high)[::-1], levels(b, low, high)
                faces.append([[*(place(a, level) for level in down), *(place(b, level) for level in up)]])
    return solid_of(faces)


VALID: dict[str, Callable[[], Solid]] = {
    "cube": cube,
    "gable": gable,
    "ell": ell,
    "courtyard": courtyard,
    "stepped": stepped,
    "handle": handle,
    "terraces": lambda: terraces(5),
}


def united(*solids: Solid) -> Solid:
    """The faces of several solids as one shell."""
    return solid_of([face for solid in solids for face in places_of(solid)])


def with_rings(solid: Solid, face: int, rings: Sequence[Sequence[Place]]) -> Solid:
    """The solid with other rings in one face."""
    faces = places_of(solid)
    faces[face] = [list(ring) for ring in rings]
    return solid_of(faces)


def with_vertex(solid: Solid, old: Place, new: Place) -> Solid:
    """The solid with one vertex moved."""
    index = int(np.flatnonzero((solid.vertices == old).all(axis=1))[0])
    vertices = solid.vertices.copy()
    vertices[index] = new
    return dataclasses.replace(solid, vertices=vertices)


def flipped(solid: Solid, faces: Sequence[int] | None = None) -> Solid:
    """The solid with some faces, or all, turned inside out."""
    chosen = range(len(solid.faces)) if faces is None else faces
    return dataclasses.replace(
        solid,
        faces=tuple(
            dataclasses.replace(face, rings=tuple(ring[::-1] for ring in face.rings)) if i in chosen else face
            for i, face in enumerate(solid.faces)
        ),
    )


def without_faces(solid: Solid, *faces: int) -> Solid:
    """The solid with some faces left out."""
    return dataclasses.replace(solid, faces=tuple(face for i, face in enumerate(solid.faces) if i not in faces))


def _roof_hole(*holes: Sequence[tuple[float, float]]) -> Solid:
    """The courtyard with other holes in its roof."""
    solid = courtyard()
    outer = places_of(solid)[0][0]
    return with_rings(solid, 0, [outer, *([(x, y, 6.0) for x, y in hole] for hole in holes)])


def _bulging_ridge() -> Solid:
    """A slope over its walls, with three corners on the ridge that lie on its line but for the rounding.

    Seen from above they do not bulge; in the plane of the slope the middle one does, and the sliver there is tilted.
    """
    roof = [
        (66.194, 21.735, 4.754),
        (53.817, 29.178, 4.897),
        (52.023, 26.195, 7.073),
        (58.845, 21.948, 7.070),
        (58.866, 21.935, 7.071),
        (59.009, 21.846, 7.070),
        (64.286, 18.562, 7.069),
    ]
    faces: list[Rings] = [[roof], [[(x, y, 0.0) for x, y, _ in reversed(roof)]]]
    for (x0, y0, z0), (x1, y1, z1) in zip(roof, [*roof[1:], roof[0]], strict=True):
        faces.append([[(x0, y0, 0.0), (x1, y1, 0.0), (x1, y1, z1), (x0, y0, z0)]])
    return solid_of(faces)


def _folded_roof() -> Solid:
    """A cube whose flat roof has a fold of 8 mm over 12 mm, too small for the distance to its plane."""
    xs, zs = [0.0, 2.0, 2.012, 4.0], [4.0, 4.0, 4.008, 4.008]
    south, north = (
        [(x, 0.0, z) for x, z in zip(xs, zs, strict=True)],
        [(x, 4.0, z) for x, z in zip(xs, zs, strict=True)],
    )
    low = [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (4.0, 4.0, 0.0), (0.0, 4.0, 0.0)]
    return solid_of(
        [
            [[*south, *north[::-1]]],
            [low[::-1]],
            [[low[0], low[1], *south[::-1]]],
            [[low[2], low[3], *north]],
            [[low[1], low[2], north[3], south[3]]],
            [[low[3], low[0], south[0], north[0]]],
        ]
    )


def _pit(bottom: float) -> Solid:
    """A cube whose roof falls from the eaves to a point."""
    roof, *others = places_of(cube())
    rim = roof[0]
    return solid_of([*([[a, b, (2.0, 2.0, bottom)]] for a, b in zip(rim, [*rim[1:], rim[0]], strict=True)), *others])


COURT = [(3.0, 3.0), (3.0, 7.0), (9.0, 7.0), (9.0, 3.0)]

BROKEN: dict[str, tuple[tuple[int, ...], Callable[[], Solid]]] = {
    "a ring of two vertices": ((101,), lambda: with_rings(cube(), 0, [[(0.0, 0.0, 4.0), (4.0, 0.0, 4.0)]])),
    "a hole of two vertices": ((101,), lambda: _roof_hole([(3.0, 3.0), (3.0, 7.0)])),
    "a vertex twice in a row": ((102,), lambda: with_rings(cube(), 0, [[*places_of(cube())[0][0], (0.0, 4.0, 4.0)]])),
    "two vertices within the snapping tolerance": (
        (102, 302),
        lambda: with_rings(cube(), 0, [[*places_of(cube())[0][0], (0.0, 3.999, 4.0)]]),
    ),
    "a bow tie": ((104,), lambda: with_rings(cube(), 0, [[places_of(cube())[0][0][i] for i in (0, 2, 1, 3)]])),
    "a spike": (
        (104,),
        lambda: with_rings(cube(), 0, [[*places_of(cube())[0][0], (-2.0, 4.0, 4.0), (0.0, 4.0, 4.0)]]),
    ),
    "a triangle without area": (
        (104,),
        lambda: solid_of([*places_of(cube()), [[(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (8.0, 0.0, 0.0)]]]),
    ),
    "walls of 2 mm along 40 m": (
        (104,),
        lambda: extruded([(0.0, 0.0), (40.0, 0.0), (40.0, 10.0), (0.0, 10.0)], [], 0.002),
    ),
    "a ring that touches itself": (
        (104,),
        lambda: with_rings(ell(), 0, [[*places_of(ell())[0][0][:3], (0.0, 4.0, 5.0), *places_of(ell())[0][0][4:]]]),
    ),
    "a hole across the outer ring": ((201,), lambda: _roof_hole([(3.0, 3.0), (3.0, 7.0), (15.0, 7.0), (15.0, 3.0)])),
    "a hole along the outer ring": ((201,), lambda: _roof_hole([(3.0, 0.0), (3.0, 7.0), (9.0, 7.0), (9.0, 0.0)])),
    "a hole that leaves through common vertices": (
        (201,),
        lambda: _roof_hole([(12.0, 0.0), (6.0, 5.0), (12.0, 10.0), (14.0, 5.0)]),
    ),
    "two holes that cross": (
        (201,),
        lambda: _roof_hole(COURT, [(2.0, 4.0), (2.0, 5.0), (5.0, 5.0), (5.0, 4.0)]),
    ),
    "a hole twice": ((202,), lambda: _roof_hole(COURT, COURT)),
    "a hole that fills the outer ring": (
        (202,),
        lambda: _roof_hole([(0.0, 0.0), (0.0, 10.0), (12.0, 10.0), (12.0, 0.0)]),
    ),
    "a corner 5 cm off the plane": ((203,), lambda: with_vertex(ell(), (9.0, 4.0, 5.0), (9.0, 4.0, 5.05))),
    "a fold of 8 mm": ((204,), _folded_roof),
    "a sliver where a ridge bulges by half a millimetre": ((204,), _bulging_ridge),
    "a hole from corner to corner": (
        (205,),
        lambda: _roof_hole([(0.0, 0.0), (4.0, 5.0), (12.0, 10.0), (6.0, 3.0)]),
    ),
    "three holes in a ring": (
        (205,),
        lambda: _roof_hole(
            [(3.0, 3.0), (6.0, 4.0), (9.0, 3.0)],
            [(9.0, 3.0), (7.0, 5.0), (6.0, 8.0)],
            [(6.0, 8.0), (5.0, 5.0), (3.0, 3.0)],
        ),
    ),
    "a hole outside": ((206,), lambda: _roof_hole([(13.0, 3.0), (13.0, 7.0), (15.0, 7.0), (15.0, 3.0)])),
    "a hole in a hole": ((207,), lambda: _roof_hole(COURT, [(4.0, 4.0), (4.0, 6.0), (8.0, 6.0), (8.0, 4.0)])),
    "a hole the same way round": ((208,), lambda: _roof_hole(COURT[::-1])),
    "three faces": ((301,), lambda: without_faces(cube(), 0, 1, 2)),
    "no roof": ((302,), lambda: without_faces(gable(), 0)),
    "a vertex missing in the neighbour": (
        (302,),
        lambda: with_rings(stepped(), 3, [[(0, 0, 0), (5, 0, 0), (5, 0, 6), (0, 0, 6)]]),
    ),
    "two cubes that share an edge": ((303,), lambda: united(cube(), cube(4.0, 4.0, 0.0))),
    "two cubes that share a vertex": ((303, 305), lambda: united(cube(), cube(4.0, 4.0, 4.0))),
    "a face twice": ((303,), lambda: solid_of([*places_of(cube()), places_of(cube())[0]])),
    "two cubes apart": ((305,), lambda: united(cube(), cube(9.0, 0.0, 0.0))),
    "a cavity": ((305,), lambda: united(cube(size=8.0), moved(flipped(cube(size=2.0)), 3.0, 3.0, 3.0))),
    "a pit through the floor": ((306,), lambda: _pit(-1.0)),
    "a pit that touches the floor": ((306,), lambda: _pit(0.0)),
    "an arm that touches the wall": ((306,), lambda: handle(0.0)),
    "an arm that runs into the wall": ((306,), lambda: handle(-0.5)),
    "a face inward": ((307,), lambda: flipped(cube(), [2])),
    "all faces inward": ((405,), lambda: flipped(courtyard())),
}


@pytest.fixture(params=sorted(VALID))
def valid_solid(request: pytest.FixtureRequest) -> Solid:
    """Each of the valid solids."""
    return VALID[request.param]()


@pytest.fixture(params=sorted(BROKEN))
def broken_solid(request: pytest.FixtureRequest) -> tuple[tuple[int, ...], Solid]:
    """Each broken solid with the codes of its faults."""
    codes, make = BROKEN[request.param]
    return codes, make()


@pytest.fixture(scope="session")
def block() -> Solid:
    """A city block of more than five thousand faces."""
    return terraces(47)


@pytest.fixture(scope="session")
def all_broken() -> dict[str, tuple[tuple[int, ...], Callable[[], Solid]]]:
    """The table of broken solids."""
    return BROKEN


@pytest.fixture(scope="session")
def all_cases() -> list[tuple[tuple[int, ...], Solid]]:
    """Valid and broken solids with their codes."""
    return [((), make()) for make in VALID.values()] + [(codes, make()) for codes, make in BROKEN.values()]
