"""The same buildings read from a run's tables, CityJSONSeq, CityJSON and OBJ; polygons and their triangles."""

import dataclasses
from pathlib import Path

import model_files as files
import pytest
import shapely
from model_files import small

from pipeline.export.record_rows import RecordContext
from pipeline.export.tile import write_tile
from pipeline.model import BuildingResult, RoofType, Status
from pipeline.quality.validity import check_solid
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.solids import truth_record
from pipeline.ruler.simulation.suites import suite_named

FOOT_M = 0.3048
US_FOOT_M = 1200.0 / 3937.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return files.write_run(tmp_path_factory.mktemp("village") / "run", files.village())


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The truth of a simulated town as a run directory."""
    scene = suite_named("town").make(7, (250.0, 250.0))
    records = [truth_record(building, scene.origin) for building in scene.buildings]
    folder = tmp_path_factory.mktemp("town") / "truth"
    context = RecordContext(reference=files.reference(), settings_hash="truth", engine_version="0")
    write_tile(folder, "t1", records, [], context)
    return folder


def test_a_run_says_what_its_records_say(run: Path) -> None:
    models = read_models(run)
    assert (models.kind, models.name, models.crs) == ("run", "fuzzy-sart", "EPSG:7415")
    assert [model.building_id for model in models.models] == ["courtyard", "gable", "pent", "two_parts"]
    gable, courtyard = files.by_id(models)["gable"], files.by_id(models)["courtyard"]
    assert (gable.roof_type, gable.status, gable.lod, gable.touches_data_edge) == (
        RoofType.GABLE,
        Status.OK,
        "2.2",
        True,
    )
    assert (courtyard.status, courtyard.lod, courtyard.touches_data_edge) == (Status.FALLBACK, "1.2", False)
    assert [surface.plane_id for surface in gable.surfaces] == [0, 1]
    assert courtyard.footprint.area == pytest.approx(300.0)
    (failed,) = models.failed
    assert (failed.building_id, failed.status, failed.roof_type) == ("failed", Status.FAILED, RoofType.NONE)
    assert failed.footprint.is_empty


@pytest.mark.parametrize("name", ["run", "town"])
def test_tables_sequences_and_meshes_hold_the_same_models(name: str, request: pytest.FixtureRequest) -> None:
    folder: Path = request.getfixturevalue(name)
    models = read_models(folder)
    assert len(models.models) > 3
    sequence, meshes = read_models(folder / "cityjson"), read_models(folder / "meshes")
    assert (sequence.kind, meshes.kind) == ("cityjsonseq", "obj")
    files.assert_same_models(models, sequence)
    files.assert_same_models(models, meshes)
    for model in models.models:
        for other in (files.by_id(sequence)[model.building_id], files.by_id(meshes)[model.building_id]):
            assert [s.plane_id for s in other.surfaces] == [s.plane_id for s in model.surfaces]
            assert all(check_solid(solid) == () for solid in other.solids)
        same = files.by_id(sequence)[model.building_id]
        assert (same.roof_type, same.status, same.lod) == (model.roof_type, model.status, model.lod)
        assert (same.touches_data_edge, same.source_id) == (model.touches_data_edge, model.source_id)
    assert [model.building_id for model in sequence.failed] == [model.building_id for model in models.failed]


def test_what_cjio_makes_of_a_sequence_holds_the_same_models(run: Path, tmp_path: Path) -> None:
    sequence = run / "cityjson" / "tile=t1" / "part-0.city.jsonl"
    document = read_models(files.made_by_cjio(sequence, tmp_path / "village.city.json"))
    assert (document.kind, document.name) == ("cityjson", "village")
    files.assert_same_models(read_models(sequence), document)
    assert [model.building_id for model in document.failed] == ["failed"]
    assert document.crs == "EPSG:7415"


@pytest.mark.parametrize(
    ("reference", "folders"),
    [((2225, US_FOOT_M, US_FOOT_M), ("", "cityjson", "meshes")), ((2992, FOOT_M, 1.0), ("meshes",))],
)
def test_a_run_in_feet_comes_out_in_metres(
    reference: tuple[int, float, float], folders: tuple[str, ...], run: Path, tmp_path: Path
) -> None:
    feet = files.write_run(tmp_path / "feet", files.village(), files.reference(*reference))
    for folder in folders:
        read = read_models(feet / folder)
        files.assert_same_models(read_models(run), read)
        assert all(check_solid(solid) == () for model in read.models for solid in model.solids)


@pytest.mark.parametrize("name", ["run", "town"])
@pytest.mark.parametrize("semantics", [True, False])
def test_a_triangulated_file_is_worth_the_same_as_its_polygons(
    name: str, semantics: bool, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    lines = files.without_planes(files.sequence_of(request.getfixturevalue(name)))
    lines = lines if semantics else files.without_semantics(lines)
    cut = files.triangulated(lines)
    assert len(str(cut)) > len(str(lines))
    polygons = read_models(files.write_sequence(tmp_path / "polygons.city.jsonl", lines))
    triangles = read_models(files.write_sequence(tmp_path / "triangles.city.jsonl", cut))
    files.assert_same_models(polygons, triangles)


@pytest.mark.parametrize("name", ["run", "town"])
def test_normals_classify_faces_without_semantics(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    lines = files.without_planes(files.sequence_of(request.getfixturevalue(name)))
    found = read_models(files.write_sequence(tmp_path / "found.city.jsonl", lines))
    bare = read_models(files.write_sequence(tmp_path / "bare.city.jsonl", files.without_semantics(lines)))
    files.assert_same_models(found, bare)
    for model, other in zip(found.models, bare.models, strict=True):
        kinds = [[face.kind for face in solid.faces] for each in (model, other) for solid in each.solids]
        assert kinds[: len(model.solids)] == kinds[len(model.solids) :]


def test_planes_of_one_number_that_touch_are_one_face_in_tables_and_files(tmp_path: Path) -> None:
    def shared(result: BuildingResult) -> BuildingResult:
        """The second part on the planes of the first."""
        second = small.gable_solid(10.0, 0)
        faces = tuple(dataclasses.replace(face, plane=face.plane % 2) for face in result.faces)
        return dataclasses.replace(result, solids=(result.solids[0], second), planes=result.planes[:2], faces=faces)

    run = files.write_run(tmp_path / "run", [shared(small.two_parts())])
    models = read_models(run)
    assert [surface.polygon.area for surface in models.models[0].surfaces] == pytest.approx([80.0, 80.0])
    files.assert_same_models(models, read_models(run / "cityjson"))
    files.assert_same_models(models, read_models(run / "meshes"))
    assert shapely.equals(models.models[0].footprint, read_models(run / "meshes").models[0].footprint)
