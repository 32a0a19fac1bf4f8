"""GLB files, read by an independent reader: whole by the rules, closed, oriented, placed to the millimetre."""

import dataclasses
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import small_buildings as small
from glb_rules import Glb, Node, chunks, read_glb
from small_buildings import Builder, Contexts

from pipeline.export.cityjson import cityjson_lines
from pipeline.export.dimensions import area_vector, volume
from pipeline.export.glb import glb_bytes
from pipeline.export.record_rows import RecordContext, building_row
from pipeline.export.tile import write_tile
from pipeline.model import BuildingResult, FaceKind

CRSES = ["compound", "feet and metres", "US feet", "unknown"]
BUILT = (small.gable, small.courtyard, small.two_parts, small.pent)
SURFACES = {"RoofSurface": FaceKind.ROOF, "WallSurface": FaceKind.WALL, "GroundSurface": FaceKind.GROUND}


def lines_of(results: list[BuildingResult], context: RecordContext) -> list[str]:
    return list(cityjson_lines([(r, building_row(r, context)) for r in results], context.reference, "some buildings"))


def written(results: list[BuildingResult], context: RecordContext) -> bytes:
    reference = context.reference
    return glb_bytes(lines_of(results, context), reference.horizontal_unit_m, reference.vertical_unit_m)


def triangles_of(node: Node, part: str | None = None, surface: str | None = None) -> np.ndarray:
    """Corners of a node's triangles, shape (t, 3, 3), of one part or surface where these are given."""
    wanted = [
        primitive.triangles
        for primitive in node.primitives
        if part in {None, primitive.extras["part"]} and surface in {None, primitive.material}
    ]
    return np.concatenate(wanted)


def area(triangles: np.ndarray) -> float:
    """Sum of the triangles' areas."""
    sides = triangles[:, 1:] - triangles[:, :1]
    return float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2.0)


def signed_volume(triangles: np.ndarray) -> float:
    """Volume inside of closed triangles: positive where they are counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


@pytest.fixture(scope="module")
def glb(contexts: Contexts) -> Glb:
    """A file of four buildings, one of them of two solids."""
    return read_glb(written([build() for build in BUILT], contexts["compound"]))


@pytest.mark.parametrize("crs", CRSES)
@pytest.mark.parametrize("build", BUILT)
def test_every_part_is_closed_and_bounds_its_solid_by_whole_surfaces_from_outside(
    contexts: Contexts, build: Builder, crs: str
) -> None:
    result = build()
    (node,) = read_glb(written([result], contexts[crs])).nodes.values()
    for index, solid in enumerate(result.solids):
        part = f"{result.building_id}-{index}"
        triangles = triangles_of(node, part)
        edges = Counter(
            (tuple(t[i]), tuple(t[(i + 1) % 3])) for t in triangles.tolist() for i in range(3)
        )  # corners of one place are equal to the last bit
        assert all(edges[b, a] == count for (a, b), count in edges.items())
        assert signed_volume(triangles) == pytest.approx(volume(solid), rel=1e-6)
        for name, kind in SURFACES.items():
            vectors = [area_vector(solid.vertices, face.rings) for face in solid.faces if face.kind is kind]
            wanted = sum(float(np.linalg.norm(vector)) for vector in vectors)
            assert area(triangles_of(node, part, name)) == pytest.approx(wanted, rel=1e-6)


def test_roofs_look_up_the_ground_looks_down_and_walls_stand_upright(glb: Glb) -> None:
    for node in glb.nodes.values():
        for primitive in node.primitives:
            sides = primitive.triangles[:, 1:] - primitive.triangles[:, :1]
            drawn = np.cross(sides[:, 0], sides[:, 1])
            drawn /= np.linalg.norm(drawn, axis=1)[:, None]
            reported = primitive.normals[primitive.indices]
            assert np.allclose(reported, drawn[:, None, :], atol=1e-5)
            up = drawn[:, 1]
            wanted = {"RoofSurface": up > 0.1, "WallSurface": np.abs(up) < 1e-6, "GroundSurface": up < -0.999}
            assert wanted[primitive.material].all()


@pytest.mark.parametrize("crs", CRSES)
def test_the_reported_origin_leads_back_to_the_coordinates_of_the_crs(contexts: Contexts, crs: str) -> None:
    results = [build() for build in BUILT]
    reference = contexts[crs].reference
    units = [reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m]
    found = read_glb(written(results, contexts[crs]))
    for result in results:
        node = found.nodes[result.building_id]
        wanted = {
            tuple(v) for solid in result.solids for v in np.round((solid.vertices + result.origin) * 1000).tolist()
        }
        metres = found.crs_coordinates(node, triangles_of(node).reshape(-1, 3)) * units
        assert {tuple(v) for v in np.round(metres * 1000).tolist()} == wanted
        assert np.abs(metres * 1000 - np.round(metres * 1000)).max() < 0.01
    assert found.place["crs"] == (None if crs == "unknown" else found.place["crs"])
    assert crs == "unknown" or found.place["crs"].endswith(f"/{reference.epsg}")
    assert found.document["nodes"][0]["extras"] == {k: v for k, v in found.place.items() if k != "title"}


def test_millimetres_survive_far_from_the_tile_s_origin(contexts: Contexts) -> None:
    far = small.gable("far", 60_000.0)
    solids = tuple(dataclasses.replace(s, vertices=s.vertices + np.array([0.001, 0.0, 0.127])) for s in far.solids)
    found = read_glb(written([small.gable(), dataclasses.replace(far, solids=solids)], contexts["compound"]))
    corners = found.crs_coordinates(found.nodes["far"], triangles_of(found.nodes["far"]).reshape(-1, 3))
    assert np.abs(corners[:, 0].min() - 145_000.001) < 1e-6
    assert np.abs(corners[:, 2] * 1000 % 1000 - 127).max() < 1e-3


def test_a_node_a_building_holds_its_record_and_a_primitive_its_part(contexts: Contexts, glb: Glb) -> None:
    _, *features = map(json.loads, lines_of([build() for build in BUILT], contexts["compound"]))
    assert list(glb.nodes) == [feature["id"] for feature in features]
    for feature in features:
        node = glb.nodes[feature["id"]]
        attributes = feature["CityObjects"][feature["id"]]["attributes"]
        assert node.extras == {"building_id": feature["id"], **attributes}
        assert {primitive.extras["part"] for primitive in node.primitives} == set(feature["CityObjects"]) - {node.name}
    assert [glb.nodes[name].extras["lod"] for name in ("gable", "courtyard")] == ["2.2", "1.2"]


def test_roof_planes_are_reported_a_vertex_and_nothing_else_has_one(glb: Glb) -> None:
    planes = {}
    for primitive in glb.nodes["two_parts"].primitives:
        reported = set(primitive.planes[primitive.indices].ravel().tolist())
        planes[primitive.extras["part"], primitive.material] = reported
    assert planes["two_parts-0", "RoofSurface"] == {0.0, 1.0}
    assert planes["two_parts-1", "RoofSurface"] == {2.0, 3.0}
    assert all(reported == {-1.0} for (_, name), reported in planes.items() if name != "RoofSurface")


def test_materials_are_the_three_surfaces_and_none_is_seen_from_both_sides(glb: Glb) -> None:
    assert [material["name"] for material in glb.document["materials"]] == list(SURFACES)
    assert not any(material.get("doubleSided", False) for material in glb.document["materials"])


def test_a_building_lies_the_same_way_whatever_others_the_file_holds(contexts: Contexts, glb: Glb) -> None:
    alone = read_glb(written([small.pent()], contexts["compound"])).nodes["pent"]
    among = glb.nodes["pent"]
    assert np.array_equal(triangles_of(alone), triangles_of(among))
    assert (alone.translation.tolist(), among.translation.tolist()) == ([0, 0, 0], [0, 0, 0])
    court = glb.nodes["courtyard"]
    assert court.translation.tolist() == [20.0, 0.0, 0.0]


def test_buildings_without_a_solid_are_left_out_and_without_any_there_is_no_file(contexts: Contexts) -> None:
    both = read_glb(written([small.failed(), small.gable()], contexts["compound"]))
    assert set(both.nodes) == {"gable"}
    assert written([small.failed()], contexts["compound"]) == b""
    assert written([], contexts["compound"]) == b""


def test_texts_of_any_language_are_reported_as_they_are(contexts: Contexts) -> None:
    context = contexts["compound"]
    row = {**building_row(small.gable(), context), "source_attributes": '{"straat":"Één \\"hofje\\" 路"}'}
    data = glb_bytes(cityjson_lines([(small.gable(), row)], context.reference, "Zürich"))
    found = read_glb(data)
    assert found.nodes["gable"].extras["source_attributes"] == {"straat": 'Één "hofje" 路'}
    assert found.place["title"] == "Zürich"


def test_the_same_buildings_give_the_same_bytes(contexts: Contexts) -> None:
    results = [build() for build in BUILT]
    assert written(results, contexts["US feet"]) == written(results, contexts["US feet"])


def test_a_face_that_crosses_itself_is_an_error_that_names_the_part(contexts: Contexts) -> None:
    lines = lines_of([small.gable()], contexts["compound"])
    feature = json.loads(lines[1])
    shell = feature["CityObjects"]["gable-0"]["geometry"][0]["boundaries"][0]
    shell[0] = [[shell[0][0][0], shell[0][0][1], shell[0][0][0]]]
    with pytest.raises(ValueError, match="face 0 of gable-0, a RoofSurface, cannot be cut"):
        glb_bytes([lines[0], json.dumps(feature)])


def test_the_rules_would_find_a_fault(contexts: Contexts) -> None:
    data = written([small.gable()], contexts["compound"])
    document, binary = chunks(data)
    read_glb(data)
    with pytest.raises(AssertionError):
        read_glb(data[:-4])
    start = len(data) - len(binary)
    with pytest.raises(AssertionError):  # a vertex beyond the stated bounds
        read_glb(data[:start] + np.float32(1e3).tobytes() + data[start + 4 :])
    indices = start + document["bufferViews"][3]["byteOffset"]
    with pytest.raises(AssertionError):  # an index of no vertex
        read_glb(data[:indices] + b"\xff\xff\0\0" + data[indices + 4 :])


def test_a_tile_is_published_with_one_file_that_its_rows_name(tmp_path: Path, contexts: Contexts) -> None:
    results = [build() for build in (*BUILT, small.failed)]
    reported = write_tile(tmp_path, "t1", results, [], contexts["compound"], "glb")
    assert [path for path in reported.digests if path.startswith("meshes/")] == ["meshes/t1/t1.glb"]
    found = read_glb((tmp_path / "meshes" / "t1" / "t1.glb").read_bytes())
    assert set(found.nodes) == {"gable", "courtyard", "two_parts", "pent"}
    assert {node.extras["mesh_path"] for node in found.nodes.values()} == {"meshes/t1/t1.glb"}
    again = write_tile(tmp_path / "again", "t1", results[::-1], [], contexts["compound"], "glb")
    assert again == reported
    nothing = write_tile(tmp_path, "t2", [small.failed()], [], contexts["compound"], "glb")
    assert not any(path.startswith("meshes/") for path in nothing.digests)


def test_a_file_holds_one_level_of_detail_and_says_it(contexts: Contexts) -> None:
    lines = lines_of([small.levelled(), small.courtyard(), small.gable()], contexts["compound"])
    volumes = {}
    for lod in (None, "1.3", "1.2"):
        nodes = read_glb(glb_bytes(lines, 1.0, 1.0, lod)).nodes
        volumes[lod] = {n.name: (n.extras["lod"], round(signed_volume(triangles_of(n)), 3)) for n in nodes.values()}
    court = ("1.2", 2700.0)
    assert volumes[None] == {"levelled": ("2.2", 456.0), "courtyard": court, "gable": ("2.2", 360.0)}
    assert volumes["1.3"] == {"levelled": ("1.3", 476.0), "courtyard": court}
    assert volumes["1.2"] == {"levelled": ("1.2", 504.0), "courtyard": court}
    assert glb_bytes(lines_of([small.gable()], contexts["compound"]), lod="1.3") == b""


def test_boxes_on_a_roof_are_parts_of_their_building_in_lod22_alone(contexts: Contexts) -> None:
    result = small.boxed()
    (node,) = read_glb(written([result], contexts["compound"])).nodes.values()
    for number, box in enumerate(result.boxes or ()):
        tops = [area_vector(box.vertices, face.rings) for face in box.faces if face.kind is FaceKind.ROOF]
        wanted = sum(float(np.linalg.norm(vector)) for vector in tops)
        assert area(triangles_of(node, f"boxed-box{number}", "RoofSurface")) == pytest.approx(wanted, rel=1e-6)
    rows = [(result, building_row(result, contexts["compound"]))]
    lines = list(cityjson_lines(rows, contexts["compound"].reference, "test"))
    (main,) = read_glb(glb_bytes(lines, lod="2.0")).nodes.values()
    assert {primitive.extras["part"] for primitive in main.primitives} == {"boxed-0"}
