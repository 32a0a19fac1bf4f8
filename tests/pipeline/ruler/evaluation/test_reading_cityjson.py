"""CityJSON that others write: parts, levels, semantics, templates, versions, units, and what is broken."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from model_files import Json
from shapely import Polygon

from pipeline.errors import CrsError, InputError
from pipeline.model import FaceKind, RoofType, Status
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reading.cityjson_models import features
from pipeline.ruler.evaluation.reading.collected import Collected

SQUARE = [[0, 0], [8, 0], [8, 6], [0, 6]]
SIDES = [[[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]


def box(low: float, high: float, east: float = 0.0) -> list[list[float]]:
    """Eight vertices: the floor, then the roof."""
    return [[x + east, y, z] for z in (low, high) for x, y in SQUARE]


def box_faces(first: int = 0) -> list[list[list[int]]]:
    """Roof, floor and four walls of a box whose vertices start at a number, facing outward."""
    faces = [[[4, 5, 6, 7]], [[3, 2, 1, 0]], *SIDES]
    return [[[first + index for index in ring] for ring in face] for face in faces]


SEMANTICS = {
    "surfaces": [{"type": "RoofSurface"}, {"type": "GroundSurface"}, {"type": "WallSurface"}],
    "values": [[0, 1, 2, 2, 2, 2]],
}


def solid(first: int = 0, lod: object = "2.2", **more: object) -> Json:
    return {"type": "Solid", "lod": lod, "boundaries": [box_faces(first)], **more}


def document(objects: Json, vertices: list, version: str = "1.1", **more: object) -> Json:
    """A CityJSON whose vertices are given in metres, stored to the centimetre."""
    shift = [1000.0, 2000.0, 5.0]
    return {
        "type": "CityJSON",
        "version": version,
        "transform": {"scale": [0.01, 0.01, 0.01], "translate": shift},
        "CityObjects": objects,
        "vertices": [[round(value * 100) for value in vertex] for vertex in vertices],
        **more,
    }


def read(tmp_path: Path, text: Json | str, name: str = "of_others.city.json") -> ModelSet:
    path = tmp_path / name
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return read_models(path)


def building(geometry: list[Json], **more: object) -> Json:
    return {"type": "Building", "geometry": geometry, **more}


def test_parts_become_one_model_with_their_building(tmp_path: Path) -> None:
    objects = {
        "west": {"type": "BuildingPart", "parents": ["house"], "geometry": [solid(0, semantics=SEMANTICS)]},
        "house": building([], children=["west", "east"], attributes={"roof_type": "flat"}),
        "east": {"type": "BuildingPart", "parents": ["house"], "geometry": [solid(8)]},
        "tree": {"type": "SolitaryVegetationObject", "geometry": []},
    }
    models = read(tmp_path, document(objects, box(0, 3) + box(0, 5, east=8)))
    (house,) = models.models
    assert (house.building_id, house.roof_type, house.lod, len(house.solids)) == ("house", RoofType.FLAT, "2.2", 2)
    assert house.footprint.equals(shapely.box(1000, 2000, 1016, 2006))
    assert sorted(float(s.elevation(np.array([1001.0]), np.array([2001.0]))[0]) for s in house.surfaces) == [8.0, 10.0]
    assert (models.kind, models.name, models.failed) == ("cityjson", "of_others", ())
    assert any("1 objects" in note for note in models.notes)
    assert any("metres" in note for note in models.notes)


def test_null_semantics_leave_it_to_the_normal(tmp_path: Path) -> None:
    values = [[None, 0, None, None, None, None]]
    semantics = {"surfaces": [{"type": "GroundSurface"}], "values": values}
    objects = {
        "some": building([solid(0, semantics=semantics)]),
        "none": building([solid(8, semantics={"surfaces": [], "values": None})]),
        "shell": building([solid(16, semantics={"surfaces": [], "values": [None]})]),
    }
    models = read(tmp_path, document(objects, box(0, 3) + box(0, 4, east=20) + box(0, 5, east=40)))
    assert [model.building_id for model in models.models] == ["none", "shell", "some"]
    for model in models.models:
        assert [face.kind for face in model.solids[0].faces] == [
            FaceKind.ROOF,
            FaceKind.GROUND,
            *[FaceKind.WALL] * 4,
        ]
        assert [surface.polygon.area for surface in model.surfaces] == [48.0]


def test_a_solid_that_faces_inward_has_its_roof_on_top_all_the_same(tmp_path: Path) -> None:
    inside_out = solid()
    inside_out["boundaries"] = [[[ring[::-1] for ring in face] for face in box_faces()]]
    (model,) = read(tmp_path, document({"house": building([inside_out])}, box(0, 3))).models
    (roof,) = model.surfaces
    assert roof.elevation(np.array([1001.0]), np.array([2001.0])) == pytest.approx([8.0])
    assert model.solids[0].faces[0].rings == ((7, 6, 5, 4),)


def test_what_looks_up_beneath_a_roof_is_no_roof(tmp_path: Path) -> None:
    floor = {"type": "MultiSurface", "lod": "2.2", "boundaries": [*box_faces(), [[8, 9, 10, 11]]]}
    storey = [[1, 1, 1], [7, 1, 1], [7, 5, 1], [1, 5, 1]]
    (model,) = read(tmp_path, document({"house": building([floor])}, [*box(0, 3), *storey])).models
    assert [surface.polygon.area for surface in model.surfaces] == [48.0]
    terrace = [[9, 1, 1], [13, 1, 1], [13, 5, 1], [9, 5, 1]]
    (model,) = read(tmp_path, document({"house": building([floor])}, [*box(0, 3), *terrace])).models
    assert sorted(surface.polygon.area for surface in model.surfaces) == [16.0, 48.0]


def test_the_underside_of_a_roof_is_no_roof_though_the_file_says_so(tmp_path: Path) -> None:
    upper = [[4, 5, 6, 7]]
    semantics = {"surfaces": [{"type": "RoofSurface"}], "values": [0, 0]}
    cases = {(3, 2, 1, 0): [8.0], (0, 1, 2, 3): [7.5, 8.0]}  # looking down, looking up
    for lower, wanted in cases.items():
        faces = [[list(lower)], upper]
        geometry = {"type": "MultiSurface", "lod": "2.2", "boundaries": faces, "semantics": semantics}
        (model,) = read(tmp_path, document({"house": building([geometry])}, box(2.5, 3))).models
        elevations = [float(s.elevation(np.array([1001.0]), np.array([2001.0]))[0]) for s in model.surfaces]
        assert sorted(elevations) == pytest.approx(wanted)


def test_the_highest_level_counts_and_solids_before_surfaces(tmp_path: Path) -> None:
    def roof_only(lod: object) -> Json:
        return {"type": "MultiSurface", "lod": lod, "boundaries": [[[4, 5, 6, 7]]]}

    footprint = {"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}
    part = {"type": "BuildingPart", "parents": ["house"]}
    vertices = box(0, 3) + box(0, 5)
    for low, high in (("1.2", "1.3"), ("1.3", "2"), ("2.0", "2.1"), ("2.1", "2.2"), (1, 2)):
        objects = {
            "house": building([footprint], children=["part"]),
            "part": {**part, "geometry": [roof_only(high), solid(0, high), solid(8, low)]},
        }
        (model,) = read(tmp_path, document(objects, vertices)).models
        assert (model.lod, len(model.surfaces), len(model.solids)) == (str(high), 1, 1)
        assert float(model.surfaces[0].elevation(np.array([0.0]), np.array([0.0]))[0]) == pytest.approx(8.0)
    objects = {"house": building([solid(8, "2.2")], children=["part"]), "part": {**part, "geometry": [solid(0, "1.2")]}}
    (model,) = read(tmp_path, document(objects, vertices)).models
    assert float(model.surfaces[0].elevation(np.array([0.0]), np.array([0.0]))[0]) == pytest.approx(10.0)


def test_a_footprint_alone_or_nothing_is_a_failed_model(tmp_path: Path) -> None:
    footprint = {"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}
    objects = {"plan": building([footprint]), "bare": building([]), "older": {"type": "Building"}}
    models = read(tmp_path, document(objects, box(0, 3)))
    assert models.models == ()
    assert {model.building_id: model.footprint.area for model in models.failed} == {"bare": 0, "older": 0, "plan": 48}
    assert {model.status for model in models.failed} == {Status.FAILED}


@pytest.mark.parametrize("kind", ["MultiSurface", "CompositeSurface", "MultiSolid", "CompositeSolid"])
def test_every_kind_of_geometry_is_read(tmp_path: Path, kind: str) -> None:
    boundaries = box_faces() if kind.endswith("Surface") else [[box_faces()]]
    values = SEMANTICS["values"][0] if kind.endswith("Surface") else [SEMANTICS["values"]]
    semantics = {"surfaces": SEMANTICS["surfaces"], "values": values}
    geometry = {"type": kind, "lod": "2", "boundaries": boundaries, "semantics": semantics}
    (model,) = read(tmp_path, document({"house": building([geometry])}, box(0, 3))).models
    assert len(model.solids) == (0 if kind.endswith("Surface") else 1)
    assert model.footprint.equals(shapely.box(1000, 2000, 1008, 2006))


def test_templates_are_turned_and_put_where_their_instance_says(tmp_path: Path) -> None:
    quarter_turn = [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    instance = {"type": "GeometryInstance", "template": 0, "boundaries": [0], "transformationMatrix": quarter_turn}
    templates = {"templates": [solid(0, "2.1")], "vertices-templates": box(0, 3)}
    made = document({"hut": building([instance])}, [[50, 60, 1]], **{"geometry-templates": templates})
    (model,) = read(tmp_path, made).models
    assert model.lod == "2.1"
    assert model.footprint.equals(shapely.box(1044, 2060, 1050, 2068))
    assert model.surfaces[0].elevation(np.array([1045.0]), np.array([2061.0])) == pytest.approx([9.0])


def test_holes_in_a_roof_are_holes_in_the_footprint(tmp_path: Path) -> None:
    court = [[2, 2, 3], [2, 4, 3], [6, 4, 3], [6, 2, 3]]
    roof = {"type": "MultiSurface", "lod": "2.2", "boundaries": [[[4, 5, 6, 7], [8, 9, 10, 11]]]}
    (model,) = read(tmp_path, document({"house": building([roof])}, [*box(0, 3), *court])).models
    assert model.footprint.area == 40.0
    assert isinstance(model.footprint, Polygon)
    assert len(model.footprint.interiors) == 1


def test_the_roof_type_is_what_the_file_says(tmp_path: Path) -> None:
    found = {
        "b3_dak_type": {
            "horizontal": "flat",
            "multiple horizontal": "flat",
            "slanted": "unknown",
            "no points": "unknown",
        },
        "rf_roof_type": {"horizontal": "flat", "slanted": "unknown"},
        "roof_type": {"gable": "gable", "combination": "combination", "dome": "dome", "onion": "unknown"},
        "roofType": {"1000": "flat", 1030: "gable", "1040": "hip", "9999": "unknown"},
    }
    for attribute, values in found.items():
        for value, wanted in values.items():
            house = building([solid()], attributes={attribute: value})
            (model,) = read(tmp_path, document({"house": house}, box(0, 3))).models
            assert model.roof_type is RoofType(wanted), (attribute, value)


def test_models_of_given_footprints_are_known_as_such(tmp_path: Path) -> None:
    cases = [
        ({"rf_success": True}, True),
        ({"source_id": "b1"}, True),
        ({"name": "hall"}, False),
    ]
    for attributes, wanted in cases:
        house = building([solid()], attributes=attributes)
        models = read(tmp_path, document({"house": house}, box(0, 3)))
        assert models.has_footprints is wanted
        assert models.models[0].source_id == attributes.get("source_id")


def test_units_of_the_reference_system_become_metres(tmp_path: Path) -> None:
    feet = document({"house": building([solid()])}, box(0, 3))
    feet["metadata"] = {"referenceSystem": "urn:ogc:def:crs:EPSG::2225"}
    models = read(tmp_path, feet)
    (model,) = models.models
    foot = 1200.0 / 3937.0
    assert model.footprint.area == pytest.approx(48.0 * foot**2, abs=0.01)
    assert model.surfaces[0].elevation(np.array([0.0]), np.array([0.0])) == pytest.approx([8.0 * foot], abs=0.001)
    assert models.crs == "EPSG:2225"
    assert any("vertical unit" in note for note in models.notes)


@pytest.mark.parametrize("system", ["EPSG:4326", "https://www.opengis.net/def/crs/EPSG/0/4979", "no such thing"])
def test_degrees_and_unknown_systems_are_refused(tmp_path: Path, system: str) -> None:
    made = document({"house": building([solid()])}, box(0, 3), metadata={"referenceSystem": system})
    with pytest.raises(CrsError, match=r"of_others\.city\.json"):
        read(tmp_path, made)


@pytest.mark.parametrize("version", ["1.0", "1.1", "2.0", "2.0.1"])
def test_versions_are_read(tmp_path: Path, version: str) -> None:
    made = document({"house": building([solid(0, 2.2 if version == "1.0" else "2.2")])}, box(0, 3), version)
    assert read(tmp_path, made).models[0].lod == "2.2"


def test_vertices_without_transform_are_coordinates(tmp_path: Path) -> None:
    made = document({"house": building([solid()])}, box(0, 3), "1.0")
    del made["transform"]
    made["vertices"] = box(0, 3)
    assert read(tmp_path, made).models[0].footprint.equals(shapely.box(0, 0, 8, 6))


def _broken() -> dict[str, tuple[Json | str, str]]:
    sound = document({"house": building([solid(semantics=SEMANTICS)])}, box(0, 3))

    def changed(way: list, value: object) -> Json:
        made = copy.deepcopy(sound)
        inner = made
        for step in way[:-1]:
            inner = inner[step]
        inner[way[-1]] = value
        return made

    shape = ["CityObjects", "house", "geometry", 0]
    return {
        "no JSON": ("{", "no JSON"),
        "another type": ({"type": "FeatureCollection"}, "FeatureCollection"),
        "an old version": (changed(["version"], "0.9"), "0.9"),
        "no objects": ({key: value for key, value in sound.items() if key != "CityObjects"}, "CityObjects"),
        "a vertex that is not there": (changed([*shape, "boundaries", 0, 0, 0, 0], 99), "vertex 99"),
        "a negative vertex": (changed([*shape, "boundaries", 0, 0, 0, 0], -1), "vertex -1"),
        "a semantic surface that is not there": (changed([*shape, "semantics", "values", 0, 0], 7), "7"),
        "too few semantic values": (changed([*shape, "semantics", "values", 0], [0]), "house"),
        "pairs of coordinates": (changed(["vertices"], [[0, 0]]), "triples"),
        "a text in place of a vertex": (changed(["vertices", 0, 0], "x"), "x"),
        "a scale of two": (changed(["transform", "scale"], [0.1, 0.1]), "triples"),
        "no transform": ({key: value for key, value in sound.items() if key != "transform"}, "transform"),
        "semantics of another kind": (changed([*shape, "semantics"], ["Wall"]), "semantics"),
        "a vertex beyond the earth": (changed(["vertices", 0, 0], 10**20), "farther"),
        "an infinite vertex": (json.dumps(changed(["vertices", 0, 0], 1e999)), "finite"),
        "a geometry without type": (changed(shape, {"lod": "2"}), "type"),
        "a part of itself": (changed(["CityObjects", "house", "parents"], ["house"]), "own parent"),
    }


@pytest.mark.parametrize("fault", sorted(_broken()))
def test_broken_files_tell_what_is_wrong(tmp_path: Path, fault: str) -> None:
    text, found = _broken()[fault]
    with pytest.raises(InputError, match=r"of_others\.city\.json") as caught:
        read(tmp_path, text)
    assert found in caught.value.problem


def test_a_broken_line_of_a_sequence_is_named(tmp_path: Path) -> None:
    first = document({}, [])
    feature = {"type": "CityJSONFeature", "id": "house", "CityObjects": {"house": building([solid()])}}
    feature["vertices"] = document({}, box(0, 3))["vertices"]
    sound = [json.dumps(first), json.dumps(feature)]
    assert len(read(tmp_path, "\n".join([*sound, "", ""]), "s.city.jsonl").models) == 1
    wrong = copy.deepcopy(feature)
    wrong["CityObjects"]["house"]["geometry"][0]["boundaries"][0][0][0][0] = 8
    cases = {
        "line 3: a face names vertex 8": [*sound, json.dumps(wrong)],
        "line 3: 'vertices' is missing": [*sound, '{"type": "CityJSONFeature"}'],
        "line 4: ": [*sound, "", "{"],
        "line 1: no line of metadata": sound[1:],
        "line 2: type is None": [sound[0], "{}"],
        "the file is empty": [],
    }
    for found, lines in cases.items():
        with pytest.raises(InputError, match=r"s\.city\.jsonl") as caught:
            read(tmp_path, "\n".join(lines), "s.city.jsonl")
        assert caught.value.problem.startswith(found), (found, caught.value.problem)


def test_a_sequence_is_read_feature_by_feature(tmp_path: Path) -> None:
    feature = {"type": "CityJSONFeature", "id": "house", "CityObjects": {}, "vertices": [[0, 0, 0]]}
    path = tmp_path / "s.city.jsonl"
    path.write_text("\n".join([json.dumps(document({}, [])), json.dumps(feature), "{ broken"]))
    lines = features(path, Collected())
    entry, places, where = next(lines)
    assert (entry["id"], where, places.vertices.tolist()) == ("house", "line 2: ", [[1000.0, 2000.0, 5.0]])
    with pytest.raises(InputError, match="line 3"):
        next(lines)


def test_one_id_twice_is_two_models_and_a_note(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        read(tmp_path / folder, document({"house": building([solid()])}, box(0, 3)))
    (tmp_path / "b" / "settings.json").write_text('{"type": "settings"}')
    models = read_models(tmp_path)
    assert [model.building_id for model in models.models] == ["house", "house#2"]
    assert any("1 models had the id of another" in note for note in models.notes)


def test_a_bent_roof_is_two_faces_and_a_nearly_flat_one_is_one(tmp_path: Path) -> None:
    plan = [[0, 0], [5, 0], [10, 0], [10, 6], [5, 6], [0, 6]]
    for rise, count in ((0.0, 1), (0.004, 1), (0.2, 2), (2.0, 2)):
        vertices = [[x, y, 3.0 + (rise if x == 5 else 0.0)] for x, y in plan]
        for faces in (
            [[[0, 1, 4, 5]], [[1, 2, 3, 4]]],
            [[[a, b, c]] for a, b, c in ((0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4))],
        ):
            roof = {"type": "MultiSurface", "lod": "2.2", "boundaries": faces}
            made = document({"house": building([roof])}, vertices)
            made["transform"]["scale"], made["vertices"] = [0.001] * 3, [[round(v * 1000) for v in p] for p in vertices]
            (model,) = read(tmp_path, made).models
            assert len(model.surfaces) == count, (rise, len(faces))
            assert sum(surface.polygon.area for surface in model.surfaces) == pytest.approx(60.0)
