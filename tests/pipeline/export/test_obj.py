"""OBJ files, read again by a small reader of their own: closed, grouped, at full coordinates."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
import small_buildings as small
from faces_by_hand import assert_closed
from small_buildings import Builder, Contexts

from pipeline.export.dimensions import volume
from pipeline.export.obj import obj_text
from pipeline.model import FaceKind, Solid, SolidFace

CRSES = ["compound", "feet and metres", "US feet", "unknown"]
BUILT = (small.gable, small.courtyard, small.two_parts, small.pent)


@dataclasses.dataclass
class ReadObject:
    """One `o` of a file: faces as (group, material, vertex numbers)."""

    name: str
    faces: list[tuple[str, str, tuple[int, ...]]]


def read_obj(text: str) -> tuple[np.ndarray, list[ReadObject]]:
    """Vertices and objects of an OBJ file."""
    vertices, objects, group, material = [], [], "", ""
    for line in text.splitlines():
        word, *rest = line.split()
        if word == "v":
            vertices.append([float(v) for v in rest])
        elif word == "o":
            objects.append(ReadObject(rest[0], []))
        elif word == "g":
            group = rest[0]
        elif word == "usemtl":
            material = rest[0]
        elif word == "f":
            objects[-1].faces.append((group, material, tuple(int(i) - 1 for i in rest)))
        else:
            assert word == "#", line
    return np.array(vertices), objects


@pytest.mark.parametrize("crs", CRSES)
@pytest.mark.parametrize("build", BUILT)
def test_every_object_is_closed_every_edge_twice_in_opposite_directions(
    contexts: Contexts, build: Builder, crs: str
) -> None:
    _, objects = read_obj(obj_text([build()], contexts[crs].reference))
    assert len(objects) == len(build().solids)
    for read in objects:
        assert_closed(face for _, _, face in read.faces)


def test_objects_share_no_vertices(contexts: Contexts) -> None:
    _, objects = read_obj(obj_text([small.two_parts(), small.gable()], contexts["compound"].reference))
    used = [{i for _, _, face in read.faces for i in face} for read in objects]
    assert [read.name for read in objects] == ["two_parts-0", "two_parts-1", "gable-0"]
    assert sum(len(one) for one in used) == len(set().union(*used))


@pytest.mark.parametrize("crs", CRSES)
@pytest.mark.parametrize("build", BUILT)
def test_vertices_are_the_full_coordinates_of_the_crs(contexts: Contexts, build: Builder, crs: str) -> None:
    reference = contexts[crs].reference
    vertices, _ = read_obj(obj_text([build()], reference))
    metres = vertices * [reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m]
    wanted = np.vstack([solid.vertices for solid in build().solids])
    assert np.array_equal(np.round(metres - small.ORIGIN, 3), wanted)


def test_millimetres_are_written_to_the_last_digit(contexts: Contexts) -> None:
    solid = small.gable_solid()
    shifted = dataclasses.replace(solid, vertices=solid.vertices + np.array([0.001, 0.0, 0.127]))
    text = obj_text([small.building("a", shifted)], contexts["compound"].reference)
    assert "\nv 85000.001 447000.000 5.127\n" in text
    assert "e+" not in text


def test_groups_and_materials_tell_roof_planes_walls_and_ground(contexts: Contexts) -> None:
    _, objects = read_obj(obj_text([small.two_parts()], contexts["compound"].reference))
    named = [Counter((group, material) for group, material, _ in read.faces) for read in objects]
    shared = {("wall", "wall"): 6, ("ground", "ground"): 1}
    assert named[0] == {("roof", "roof_0"): 1, ("roof", "roof_1"): 1, **shared}
    assert named[1] == {("roof", "roof_2"): 1, ("roof", "roof_3"): 1, **shared}


def test_faces_with_holes_become_triangles_that_keep_volume_and_orientation(contexts: Contexts) -> None:
    result = small.courtyard()
    vertices, (read,) = read_obj(obj_text([result], contexts["compound"].reference))
    assert {len(face) for group, _, face in read.faces if group != "wall"} == {3}
    again = Solid(
        vertices=vertices - small.ORIGIN,
        faces=tuple(SolidFace(rings=(face,), kind=FaceKind(group)) for group, _, face in read.faces),
    )
    assert volume(again) == pytest.approx(volume(result.solids[0]))


def test_buildings_without_a_solid_leave_no_object(contexts: Contexts) -> None:
    vertices, objects = read_obj(obj_text([small.failed()], contexts["compound"].reference))
    assert (len(vertices), objects) == (0, [])


def test_undersides_are_a_group_of_their_own(contexts: Contexts) -> None:
    reference = contexts["compound"].reference
    _, (one,) = read_obj(obj_text([small.overhung()], reference, "2.3"))
    assert Counter(group for group, _, _ in one.faces) == {"roof": 2, "wall": 12, "ground": 1, "ceiling": 2}
    own = obj_text([small.overhung("gable")], reference)
    assert own == obj_text([small.gable()], reference)


def test_a_coarser_level_takes_the_place_of_the_records_own_and_a_fallback_block_stays(contexts: Contexts) -> None:
    results = [small.levelled(), small.courtyard(), small.gable()]
    tops = {}
    for lod in (None, "1.3", "1.2"):
        vertices, objects = read_obj(obj_text(results, contexts["compound"].reference, lod))
        tops[lod] = {
            o.name: float(max(vertices[i, 2] for _, _, ring in o.faces for i in ring)) - small.ORIGIN[2]
            for o in objects
        }
    # the gable has no coarser model: it is in the file of its own level only
    assert tops[None] == {"levelled-0": 6.0, "levelled-1": 3.0, "courtyard-0": 9.0, "gable-0": 6.0}
    assert tops["1.3"] == {"levelled-0": 4.75, "levelled-1": 3.0, "courtyard-0": 9.0}
    assert tops["1.2"] == {"levelled-0": 4.5, "levelled-1": 4.5, "courtyard-0": 9.0}


def test_boxes_on_a_roof_are_objects_of_their_own_in_lod22_alone(contexts: Contexts) -> None:
    reference = contexts["compound"].reference
    _, (building, *boxes) = read_obj(obj_text([small.boxed()], reference))
    assert [building.name, *(box.name for box in boxes)] == ["boxed-0", "boxed-box0", "boxed-box1"]
    for box in boxes:
        assert_closed(numbers for _, _, numbers in box.faces)
        assert {(group, material) for group, material, _ in box.faces} == {
            (name, name) for name in ("roof", "wall", "closure")
        }
    coarse = dataclasses.replace(small.boxed(), lod="1.2")
    assert len(read_obj(obj_text([coarse], reference))[1]) == 1
