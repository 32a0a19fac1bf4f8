"""Every code has a solid that shows it, and verdicts depend on the geometry alone."""

import dataclasses
import random
from collections.abc import Callable

import numpy as np
import pytest
from candidates_by_hand import turned_plan
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.model import FaceKind, Solid, SolidFace
from pipeline.quality import validity
from pipeline.quality.validity import ValidityTolerances, check_solid

Codes = tuple[int, ...]
Case = tuple[Codes, Solid]


def test_a_sound_solid_has_no_code(valid_solid: Solid) -> None:
    assert check_solid(valid_solid) == ()


def test_a_broken_solid_shows_its_codes_and_no_other(broken_solid: Case) -> None:
    codes, solid = broken_solid
    assert check_solid(solid) == codes


def test_every_documented_code_but_the_last_resort_is_shown_by_a_broken_solid(
    all_broken: dict[str, tuple[Codes, Callable[[], Solid]]],
) -> None:
    documented = {int(line[:3]) for line in str(validity.__doc__).splitlines() if line[:3].isdigit()}
    shown = {code for codes, _ in all_broken.values() for code in codes}
    assert documented - shown == {300}
    assert shown <= documented


def test_several_solids_are_judged_one_by_one(valid_solid: Solid, broken_solid: Case) -> None:
    codes, broken = broken_solid
    assert [check_solid(solid) for solid in (valid_solid, broken, valid_solid)] == [(), codes, ()]


def _turned(solid: Solid, quarters: int, axis: int) -> Solid:
    """Exact quarter turns about an axis."""
    vertices = solid.vertices.copy()
    first, second = (axis + 1) % 3, (axis + 2) % 3
    for _ in range(quarters):
        vertices[:, [first, second]] = np.column_stack([-vertices[:, second], vertices[:, first]])
    return dataclasses.replace(solid, vertices=vertices)


def _mirrored(solid: Solid) -> Solid:
    """Mirrored in x, with the rings turned so that outside stays outside."""
    faces = tuple(dataclasses.replace(face, rings=tuple(ring[::-1] for ring in face.rings)) for face in solid.faces)
    return Solid(vertices=solid.vertices * np.array([-1.0, 1.0, 1.0]), faces=faces)


def _relabelled(solid: Solid, chance: random.Random) -> Solid:
    """Other vertex numbers with unused vertices between them, other order of faces and holes, other ring starts."""
    order = list(range(len(solid.vertices) + 2))
    chance.shuffle(order)
    vertices = np.full((len(order), 3), 1.5)
    vertices[order[: len(solid.vertices)]] = solid.vertices
    faces = []
    for face in solid.faces:
        rings = []
        for ring in face.rings:
            start = chance.randrange(len(ring))
            rings.append(tuple(order[i] for i in ring[start:] + ring[:start]))
        holes = rings[1:]
        chance.shuffle(holes)
        faces.append(SolidFace(rings=(rings[0], *holes), kind=face.kind))
    chance.shuffle(faces)
    return Solid(vertices=vertices, faces=tuple(faces))


millimetres = st.integers(-3_000_000, 3_000_000)
moves = st.tuples(millimetres, millimetres, millimetres, st.integers(0, 3), st.integers(0, 2), st.booleans())


@given(move=moves, chance=st.randoms(use_true_random=False), which=st.integers(0, 10_000))
@settings(max_examples=examples(200), deadline=None)
def test_moves_and_relabelling_keep_the_verdict(
    move: tuple[int, int, int, int, int, bool], chance: random.Random, which: int, all_cases: list[Case]
) -> None:
    codes, solid = all_cases[which % len(all_cases)]
    *shift, quarters, axis, mirror = move
    there = _turned(_mirrored(solid) if mirror else solid, quarters, axis)
    there = dataclasses.replace(there, vertices=np.rint(there.vertices * 1000 + np.array(shift)) / 1000)
    assert check_solid(_relabelled(there, chance)) == codes


@given(angle=st.floats(0.0, 2.0 * np.pi), which=st.integers(0, 10_000))
@settings(max_examples=examples(100), deadline=None)
def test_a_sound_solid_stays_sound_when_turned_and_rounded(angle: float, which: int, all_cases: list[Case]) -> None:
    sound = [solid for codes, solid in all_cases if not codes]
    solid = sound[which % len(sound)]
    turned = np.column_stack([turned_plan(solid.vertices[:, :2], np.degrees(angle)), solid.vertices[:, 2]]).round(3)
    assert check_solid(dataclasses.replace(solid, vertices=turned)) == ()


def test_vertices_at_the_snapping_distance_must_be_sound_both_as_one_and_as_two(valid_solid: Solid) -> None:
    doubled = np.vstack([valid_solid.vertices, valid_solid.vertices[0] + [0.0, 0.0, 0.001]])
    faces = list(valid_solid.faces)
    first = next(i for i, face in enumerate(faces) if 0 in face.rings[0])
    rings = tuple(tuple(len(doubled) - 1 if i == 0 else i for i in ring) for ring in faces[first].rings)
    faces[first] = dataclasses.replace(faces[first], rings=rings)
    apart = Solid(vertices=doubled, faces=tuple(faces))
    assert 302 in check_solid(apart)
    assert check_solid(apart, ValidityTolerances(snap_m=0.002)) == ()


def test_tolerances_decide_what_is_planar(valid_solid: Solid) -> None:
    solid = dataclasses.replace(valid_solid, vertices=valid_solid.vertices.copy())
    face = max(solid.faces, key=lambda face: len(face.rings[0]))
    solid.vertices[face.rings[0][0]] += [0.0, 0.0, 0.012]
    solid.vertices[face.rings[0][0]] += [0.012, 0.0, 0.0]
    assert check_solid(solid, ValidityTolerances(planarity_m=0.1, normals_deg=45.0)) == ()
    assert check_solid(solid, ValidityTolerances(planarity_m=0.001)) == (203,)
    assert check_solid(solid, ValidityTolerances(planarity_m=0.1, normals_deg=0.01)) == (204,)


def test_tolerances_out_of_range_are_reported_all_at_once() -> None:
    with pytest.raises(SettingsError, match=r"snap_m is -1.*normals_deg is 120"):
        ValidityTolerances(snap_m=-1.0, normals_deg=120.0)


def test_the_arrays_are_not_changed(valid_solid: Solid) -> None:
    before = valid_solid.vertices.copy()
    check_solid(valid_solid)
    assert (valid_solid.vertices == before).all()


def test_a_solid_without_faces_has_too_few() -> None:
    assert check_solid(Solid(vertices=np.empty((0, 3)), faces=())) == (301,)
    assert check_solid(Solid(vertices=np.zeros((1, 3)), faces=(SolidFace(rings=(), kind=FaceKind.ROOF),))) == (101,)
