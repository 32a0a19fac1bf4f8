"""CityJSONSeq: its rules, the official schema, cjio, and the geometry that comes back."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cityjson_rules
import jsonschema
import numpy as np
import pyproj
import pytest
import referencing
import small_buildings as small
from faces_by_hand import assert_closed
from small_buildings import Builder, Contexts

from pipeline.export.cityjson import cityjson_lines
from pipeline.export.record_rows import RecordContext, building_row
from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.export.stored_coordinates import one_unit
from pipeline.export.tile import write_tile
from pipeline.extras.publish.cityjson_file import city_of

CRSES = ["compound", "feet and metres", "US feet", "unknown"]
BUILT = (small.gable, small.courtyard, small.two_parts, small.failed, small.pent, small.levelled, small.boxed)
SCHEMAS = "GABLEWORK_CITYJSON_SCHEMAS"
"""Names a folder with the schema files of CityJSON 2.0 as its maintainers publish them."""


def sequence(context: RecordContext, builders: Sequence[Builder] = BUILT) -> list[dict]:
    """The objects of a file with these buildings."""
    rows = [(build(), building_row(build(), context, mesh_path="meshes/t/a.obj")) for build in builders]
    return [json.loads(line) for line in cityjson_lines(rows, context.reference, "test")]


def cjio(*words: str, lines: Sequence[dict] = ()) -> str:
    """Run the command line of cjio in a process of its own, since it changes Python's json on import."""
    command = [sys.executable, "-c", "from cjio.cjio import cli; cli()", *words]
    fed = "".join(json.dumps(line) + "\n" for line in lines)
    result = subprocess.run(command, input=fed, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.parametrize("crs", CRSES)
def test_a_sequence_follows_the_rules(contexts: Contexts, crs: str) -> None:
    assert cityjson_rules.faults(sequence(contexts[crs])) == []
    assert cityjson_rules.faults(sequence(contexts[crs], ())) == []


@pytest.mark.skipif(SCHEMAS not in os.environ, reason=f"{SCHEMAS} names no folder with the official schema files")
@pytest.mark.parametrize("crs", CRSES)
def test_every_line_and_their_file_fit_the_official_schema(contexts: Contexts, crs: str) -> None:
    files = {path.name: json.loads(path.read_text()) for path in Path(os.environ[SCHEMAS]).glob("*.schema.json")}
    registry = referencing.Registry().with_resources(
        (schema["$id"], referencing.Resource.from_contents(schema)) for schema in files.values()
    )
    lines = sequence(contexts[crs])
    for line in [*lines, city_of(json.dumps(line) for line in lines)]:
        name = f"{line['type'].lower()}.schema.json"
        validator = jsonschema.Draft7Validator(files[name], registry=registry)
        assert [error.message[:300] for error in validator.iter_errors(line)] == []


@pytest.mark.parametrize("crs", CRSES)
def test_integer_vertices_give_back_the_coordinates(contexts: Contexts, crs: str) -> None:
    reference = contexts[crs].reference
    first, *features = sequence(contexts[crs])
    units = np.array([reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m])
    built = {build().building_id: build() for build in BUILT}
    for feature in features:
        result = built[feature["id"]]
        solids = [*result.solids, *(solid for model in result.coarser for solid in model.solids), *(result.boxes or ())]
        xyz = (
            np.array(feature["vertices"]).reshape(-1, 3) * first["transform"]["scale"] + first["transform"]["translate"]
        )
        wanted = np.vstack([solid.vertices for solid in solids]) if solids else np.empty((0, 3))
        assert np.array_equal(np.round(xyz * units - small.ORIGIN, 3), wanted)


@pytest.mark.parametrize("crs", CRSES)
def test_the_files_of_a_tile_have_one_unit_for_all_axes_and_attributes(
    contexts: Contexts, tmp_path: Path, crs: str
) -> None:
    context = contexts[crs]
    unit_m = context.reference.horizontal_unit_m
    results = [build() for build in BUILT]
    write_tile(tmp_path, "t", results, [], context, meshes="glb")
    lines = (tmp_path / "cityjson/tile=t/part-0.city.jsonl").read_text().splitlines()
    first, *features = map(json.loads, lines)
    built = {result.building_id: result for result in results}
    checked = 0
    for feature in features:
        solids = built[feature["id"]].solids
        if not solids:
            continue
        z = np.array(feature["vertices"])[:, 2] * first["transform"]["scale"][2] + first["transform"]["translate"][2]
        wanted = np.concatenate([solid.vertices[:, 2] for solid in solids]) + small.ORIGIN[2]
        assert np.abs(z[: len(wanted)] * unit_m - wanted).max() < 5.1e-4
        attributes = feature["CityObjects"][feature["id"]]["attributes"]
        assert attributes["ridge_z"] * unit_m == pytest.approx(wanted.max(), abs=1e-3)
        assert attributes["mesh_path"] == "meshes/t/t.glb"
        checked += 1
    assert checked > 3
    data = (tmp_path / "meshes/t/t.glb").read_bytes()
    place = re.search(rb'"vertical_unit_m":([0-9.]+)', data)
    assert place is not None
    assert float(place[1]) == unit_m
    # without a code for the CRS the title is where a reader can find the unit
    stated = dataclasses.replace(context.reference, epsg=None, projjson=None)
    write_tile(tmp_path / "own", "t", results, [], dataclasses.replace(context, reference=stated))
    heading = json.loads((tmp_path / "own/cityjson/tile=t/part-0.city.jsonl").read_text().splitlines()[0])
    assert (f"one unit is {unit_m:.12g} m" in heading["metadata"]["title"]) == (unit_m != 1.0)
    assert "referenceSystem" not in heading["metadata"]


def test_a_code_with_a_vertical_axis_keeps_its_own_units() -> None:
    wkt = pyproj.CRS("EPSG:26910+6360").to_json_dict()
    feet = small.Reference(epsg=1, vertical_unit_m=0.3048, projjson=wkt)  # as if the registry had a code for it
    assert one_unit(feet) is feet
    assert one_unit(dataclasses.replace(feet, epsg=None)).vertical_unit_m == 1.0
    flat = pyproj.CRS("EPSG:26910").to_json_dict()
    assert one_unit(dataclasses.replace(feet, projjson=flat)).vertical_unit_m == 1.0
    solid = dataclasses.replace(feet, projjson=pyproj.CRS("EPSG:26910").to_3d().to_json_dict())
    assert one_unit(solid) is solid


def test_solids_are_closed_and_one_part_each(contexts: Contexts) -> None:
    for feature in sequence(contexts["compound"])[1:]:
        parts = [entry for entry in feature["CityObjects"].values() if entry["type"] == "BuildingPart"]
        assert len(parts) == {"two_parts": 2, "levelled": 2, "failed": 0}.get(feature["id"], 1)
        for part in parts:
            for geometry in part["geometry"]:
                (shell,) = geometry["boundaries"]
                assert_closed(ring for surface in shell for ring in surface)


def test_levels_of_detail_are_geometries_of_the_same_parts(contexts: Contexts) -> None:
    feature = sequence(contexts["compound"], [small.levelled])[1]
    objects = feature["CityObjects"]
    assert objects["levelled"]["children"] == ["levelled-0", "levelled-1"]
    for part, heights in (("levelled-0", [6.0, 4.75, 4.5]), ("levelled-1", [3.0, 3.0, 4.5])):
        geometries = objects[part]["geometry"]
        assert [geometry["lod"] for geometry in geometries] == ["2.2", "1.3", "1.2"]
        for geometry, height in zip(geometries, heights, strict=True):
            used = {i for surface in geometry["boundaries"][0] for ring in surface for i in ring}
            assert max(feature["vertices"][i][2] for i in used) == round(1e3 * height)
        for geometry in geometries[1:]:
            roofs = [surface for surface in geometry["semantics"]["surfaces"] if surface["type"] == "RoofSurface"]
            assert roofs == [{"type": "RoofSurface", "slope_deg": 0.0, "aspect_deg": 0.0}]


def test_overhangs_are_a_further_geometry_with_undersides_and_the_planes_of_the_record(contexts: Contexts) -> None:
    feature = sequence(contexts["compound"], [small.overhung])[1]
    detailed, finer = feature["CityObjects"]["overhung-0"]["geometry"]
    assert (detailed["lod"], finer["lod"]) == ("2.2", "2.3")
    (shell,), semantics = finer["boundaries"], finer["semantics"]
    assert_closed(ring for surface in shell for ring in surface)
    kinds = Counter(semantics["surfaces"][value]["type"] for value in semantics["values"][0])
    assert kinds == {"RoofSurface": 2, "WallSurface": 12, "GroundSurface": 1, "OuterCeilingSurface": 2}
    roofs = [surface for surface in semantics["surfaces"] if surface["type"] == "RoofSurface"]
    assert [roof["plane_id"] for roof in roofs] == [0, 1]
    assert feature["CityObjects"]["overhung"]["attributes"]["overhang_source"] == "seen"


def test_semantic_surfaces_tell_slope_and_aspect_of_each_roof_plane(contexts: Contexts) -> None:
    feature = sequence(contexts["compound"], [small.two_parts])[1]
    (solid,) = feature["CityObjects"]["two_parts-1"]["geometry"]
    semantics = solid["semantics"]
    kinds = Counter(semantics["surfaces"][value]["type"] for value in semantics["values"][0])
    assert kinds == {"RoofSurface": 2, "WallSurface": 6, "GroundSurface": 1}
    roofs = [surface for surface in semantics["surfaces"] if surface["type"] == "RoofSurface"]
    assert [(roof["plane_id"], roof["aspect_deg"]) for roof in roofs] == [(2, 180.0), (3, 0.0)]
    assert [roof["slope_deg"] for roof in roofs] == pytest.approx([36.8699, 36.8699])


def test_attributes_are_the_record_without_what_is_unknown(contexts: Contexts) -> None:
    first = contexts["compound"]
    by_id = {feature["id"]: feature["CityObjects"][feature["id"]]["attributes"] for feature in sequence(first)[1:]}
    row = building_row(small.courtyard(), first, mesh_path="meshes/t/a.obj")
    wanted = {n: v for n, v in row.items() if v is not None and n not in {"geometry", "building_id", *SHAPE_COLUMNS}}
    reported = {name: value for name, value in wanted.items() if not name.startswith("acquired")}
    assert {n: v for n, v in by_id["courtyard"].items() if not n.startswith("acquired")} == reported
    assert by_id["courtyard"]["acquired_from"] == "2014-03-01T10:00:00.000125+00:00"
    assert by_id["failed"]["reason"] == "too_few_points"
    assert "ridge_z" not in by_id["failed"]


def test_the_reference_system_is_reported_where_it_is_known(contexts: Contexts) -> None:
    codes = {"compound": "7415", "feet and metres": "2992", "US feet": "2225"}
    for crs, code in codes.items():
        system = sequence(contexts[crs])[0]["metadata"]["referenceSystem"]
        assert system == f"https://www.opengis.net/def/crs/EPSG/0/{code}"
    assert "referenceSystem" not in sequence(contexts["unknown"])[0]["metadata"]


@pytest.mark.parametrize("crs", CRSES)
def test_cjio_reads_the_sequence_as_one_model(contexts: Contexts, crs: str, tmp_path: Path) -> None:
    cjio("stdin", "save", str(tmp_path / "one.city.json"), lines=sequence(contexts[crs]))
    model = json.loads((tmp_path / "one.city.json").read_text())
    names = {build().building_id for build in BUILT}
    parts = {"gable-0", "courtyard-0", "two_parts-0", "two_parts-1", "pent-0", "levelled-0", "levelled-1"}
    boxed = {"boxed-0", "boxed-box0", "boxed-box1"}
    assert set(model["CityObjects"]) == names | parts | boxed
    first = sequence(contexts[crs])[0]
    assert model["metadata"].get("referenceSystem") == first["metadata"].get("referenceSystem")
    assert model["metadata"]["geographicalExtent"] == pytest.approx(first["metadata"]["geographicalExtent"], abs=1e-3)


def places_of(city: dict) -> dict[str, list]:
    """The boundaries of each object of a CityJSON file, with coordinates in the place of numbers."""

    def placed(part: list | int) -> list:
        return [placed(inner) for inner in part] if isinstance(part, list) else city["vertices"][part]

    return {
        name: [placed(geometry["boundaries"]) for geometry in thing.get("geometry", ())]
        for name, thing in city["CityObjects"].items()
    }


def test_one_file_holds_what_its_lines_hold(contexts: Contexts) -> None:
    lines = sequence(contexts["compound"])
    city = city_of(json.dumps(line) for line in lines)
    assert {name: city[name] for name in ("type", "version", "transform", "metadata")} == {
        name: lines[0][name] for name in ("type", "version", "transform", "metadata")
    }
    features = {name: thing for line in lines[1:] for name, thing in line["CityObjects"].items()}
    assert list(city["CityObjects"]) == list(features)
    assert places_of(city) == {name: place for line in lines[1:] for name, place in places_of(line).items()}
    without = [{k: v for k, v in thing.items() if k != "geometry"} for thing in city["CityObjects"].values()]
    assert without == [{k: v for k, v in thing.items() if k != "geometry"} for thing in features.values()]
    assert len({tuple(vertex) for vertex in city["vertices"]}) == len(city["vertices"])
    assert len(city["vertices"]) < sum(len(line["vertices"]) for line in lines)


def test_one_file_is_read_by_cjio(contexts: Contexts, tmp_path: Path) -> None:
    path = tmp_path / "tile.city.json"
    path.write_text(json.dumps(city_of(json.dumps(line) for line in sequence(contexts["compound"]))))
    assert "Building" in cjio(str(path), "info")


@pytest.mark.parametrize("lines", [[], ['{"type": "CityJSONFeature"}']])
def test_features_without_metadata_are_refused(lines: list[str]) -> None:
    with pytest.raises(ValueError, match="metadata"):
        city_of(lines)


def test_boxes_on_a_roof_are_installations_beside_the_parts(contexts: Contexts) -> None:
    _, feature = sequence(contexts["compound"], [small.boxed])
    objects = feature["CityObjects"]
    assert objects["boxed"]["children"] == ["boxed-0", "boxed-box0", "boxed-box1"]
    assert objects["boxed"]["attributes"]["n_boxes"] == 2
    for name in ("boxed-box0", "boxed-box1"):
        assert objects[name]["type"] == "BuildingInstallation"
        (solid,) = objects[name]["geometry"]
        assert solid["lod"] == "2.2"
        kinds = [surface["type"] for surface in solid["semantics"]["surfaces"]]
        assert sorted(kinds) == ["ClosureSurface", "RoofSurface", "WallSurface"]
        assert "plane_id" not in solid["semantics"]["surfaces"][kinds.index("RoofSurface")]
