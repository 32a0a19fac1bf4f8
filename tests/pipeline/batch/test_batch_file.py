"""The batch file: paths are the file's own, and all faults are reported at once."""

from pathlib import Path

import pytest

from pipeline.batch.batch_file import read_batch
from pipeline.errors import SettingsError
from pipeline.io.crs_given import parse_crs

LEAST = '[inputs]\npaths = ["tiles/*.laz"]\n[output]\npath = "models"\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "city.toml"
    path.write_text(text)
    return path


def test_paths_are_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    batch = read_batch(written(tmp_path, LEAST + '[work]\npath = "../work"\n'))
    request = batch.request()
    assert request.inputs == (str(tmp_path / "tiles" / "*.laz"),)
    assert request.out == str(tmp_path / "models")
    assert request.resources.work == str(tmp_path.parent / "work")


def test_addresses_stay_as_they_are(tmp_path: Path) -> None:
    batch = read_batch(
        written(tmp_path, '[inputs]\npaths = ["s3://a/b.laz", "/c"]\n[output]\npath = "s3://bucket/models"\n')
    )
    assert batch.paths == ("s3://a/b.laz", "/c")
    assert batch.out == "s3://bucket/models"


def test_what_is_not_said_is_as_in_reconstruct(tmp_path: Path) -> None:
    batch = read_batch(written(tmp_path, LEAST))
    assert batch.work_folder == str(tmp_path / "city.work")
    request = batch.request()
    assert (request.resources.workers, request.resources.scheduler, request.meshes) == (None, None, "building")
    assert request.resources.isolation is not None
    assert request.settings.general.method == "arrangement"
    assert (request.crs, request.footprints, request.bbox) == (None, None, None)


@pytest.mark.parametrize("crs", ["28992", '"28992"', '"EPSG:28992"'])
def test_a_crs_is_a_code_with_or_without_its_authority(tmp_path: Path, crs: str) -> None:
    text = f'[inputs]\npaths = ["a.laz"]\ncrs = {crs}\n[output]\npath = "out"\n'
    given = read_batch(written(tmp_path, text)).request().crs
    assert given is not None
    assert parse_crs(given, path="crs").to_epsg() == 28992


def test_all_that_can_be_said_reaches_the_engine(tmp_path: Path) -> None:
    text = """
    [inputs]
    paths = ["a.laz", "b"]
    crs = "EPSG:28992"
    vertical_unit = "m"
    allow_outside_area_of_use = true
    footprints = "f.gpkg"
    overrides = "o.toml"
    aoi = "aoi.geojson"
    bbox = [1, 2.5, 3, 4]
    licence = "CC0"
    [settings]
    method = "kmeans"
    [settings.candidates]
    min_area_m2 = 20
    [output]
    path = "models"
    meshes = "glb"
    overwrite = true
    [cluster]
    workers = 0
    building_timeout_s = 30
    building_memory_gib = 2
    """
    request = read_batch(written(tmp_path, text)).request()
    assert request.bbox == (1.0, 2.5, 3.0, 4.0)
    assert request.footprints == str(tmp_path / "f.gpkg")
    assert request.aoi == str(tmp_path / "aoi.geojson")
    assert request.overrides == str(tmp_path / "o.toml")
    assert (request.crs, request.vertical_unit, request.licence) == ("EPSG:28992", "m", "CC0")
    assert request.allow_outside_area_of_use
    assert request.settings.general.method == "kmeans"
    assert request.settings.scene.candidates.min_area_m2 == 20.0
    resources = request.resources
    assert (resources.workers, resources.isolation, resources.building_timeout_s) == (0, None, 30.0)
    assert resources.building_memory_bytes == 2 * 2**30
    assert (request.meshes, request.overwrite) == ("glb", True)


@pytest.mark.parametrize(("given", "workers"), [('"auto"', None), ("0", 0), ("3", 3)])
def test_workers_are_a_number_or_left_to_the_estimate(tmp_path: Path, given: str, workers: int | None) -> None:
    batch = read_batch(written(tmp_path, f"{LEAST}[cluster]\nworkers = {given}\n"))
    assert batch.workers == batch.request().resources.workers == workers


@pytest.mark.parametrize("given", ['"many"', '"3"', "1025", "1.5", "true"])
def test_workers_that_are_no_number_are_named_with_what_to_use(tmp_path: Path, given: str) -> None:
    with pytest.raises(SettingsError) as raised:
        read_batch(written(tmp_path, f"{LEAST}[cluster]\nworkers = {given}\n"))
    (fault,) = raised.value.faults
    value = given.replace('"', "'").replace("true", "True")
    assert f"workers is {value}: use 'auto' or a whole number from 0 to 1024" in fault


def test_all_faults_are_reported_at_once(tmp_path: Path) -> None:
    text = """
    [inputs]
    path = "tiles"
    bbox = [1, 2]
    [settings]
    method = "magic"
    [output]
    meshes = "stl"
    [cluster]
    workers = -1
    scheduler = 8786
    [sttings]
    """
    with pytest.raises(SettingsError) as raised:
        read_batch(written(tmp_path, text))
    faults = "\n".join(raised.value.faults)
    for words in (
        "[inputs] paths is missing",
        "[inputs] bbox is [1, 2]",
        "[inputs] path is not a setting",
        "meshes is 'stl': use one of building",
        "workers is -1: use 'auto' or a whole number from 0 to 1024",
        "scheduler is 8786: use a text in quotes",
        "magic",
        "[sttings] is not a table of a batch file",
    ):
        assert words in faults


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("[inputs", "is not TOML"),
        (f"deep = {'[' * 5000}{']' * 5000}", "is not TOML"),
        (r'inputs = {paths = ["a\u0000b"]}', "paths holds a NUL character"),
        ('[work]\npath = "s3://bucket/work"', r"path is 's3://bucket/work': use a folder of a file system"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, text: str | None, words: str) -> None:
    path = tmp_path / "city.toml" if text is None else written(tmp_path, text)
    with pytest.raises(SettingsError, match=words):
        read_batch(path)
