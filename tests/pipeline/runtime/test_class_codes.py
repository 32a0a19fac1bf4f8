"""Codes of a producer's own: 67 can be a building, wherever classes are believed or looked at."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from command_line import invoke
from run_tables import rows

from pipeline.errors import SettingsError
from pipeline.io import ReadOptions, open_source
from pipeline.ruler.simulation.dataset import Output, simulate
from pipeline.settings import RunSettings
from pipeline.terrain.terrain_settings import OTHER, ClassCodeSettings

OWN = {"class-codes": {"ground": [40], "building": [6, 67], "vegetation": [3, 4, 5, 41], "noise": [7, 18, 99]}}


@pytest.fixture(scope="module")
def classified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tile with the true classes in ASPRS codes."""
    folder = tmp_path_factory.mktemp("classified")
    simulate("suburb", folder, 3, size_m=(70.0, 70.0), density_per_m2=4.0, output=Output(with_classes=True))
    return folder / "suburb.laz"


@pytest.fixture(scope="module")
def of_a_producer(classified: Path) -> Path:
    """The same points with a producer's own codes; a tenth of the buildings' points keep 6."""
    las = laspy.read(classified)
    codes = np.array(las.classification)
    own = codes.copy()
    own[codes == 2] = 40
    own[(codes == 6) & (np.arange(len(codes)) % 10 > 0)] = 67
    own[codes == 5] = 41
    las.classification = own
    path = classified.with_name("own.laz")
    las.write(path)
    return path


@pytest.mark.parametrize("classes", ["trust", "audit"])
def test_a_mapped_code_counts_as_the_class_that_it_is_mapped_to(
    classified: Path, of_a_producer: Path, reconstruct: Any, classes: str
) -> None:
    known = reconstruct(classified, settings={"classes": classes})
    mapped = reconstruct(of_a_producer, settings={"classes": classes, **OWN})
    bare = reconstruct(of_a_producer, settings={"classes": classes})
    assert mapped.counts == known.counts
    assert mapped.counts["class_6_in_candidates"] > 5 * bare.counts["class_6_in_candidates"] > 0
    for table in ("buildings", "planes", "rejected"):
        hashes = {"input_hash": None, "settings_hash": None}
        theirs = [row | hashes for row in rows(known.run_dir, table)]
        assert [row | hashes for row in rows(mapped.run_dir, table)] == theirs
    if classes == "trust":
        assert any("not classified" in warning for warning in bare.warnings)
        assert not any("not classified" in warning for warning in mapped.warnings)


def test_codes_mean_nothing_where_classes_are_ignored(classified: Path, of_a_producer: Path, reconstruct: Any) -> None:
    digests = {reconstruct(path, settings={"classes": "ignore"}).digest for path in (classified, of_a_producer)}
    assert len(digests) == 1


def test_classify_writes_the_classes_that_own_codes_mean(
    of_a_producer: Path, run_classify: Any, tmp_path: Path
) -> None:
    las = laspy.read(of_a_producer)
    codes = np.array(las.classification)
    codes[:20], codes[20:40] = 99, 9
    las.classification = codes
    las.write(tmp_path / "own.laz")
    out = tmp_path / "classified"
    run_classify(tmp_path / "own.laz", settings={"classes": "trust", **OWN}, out=str(out))
    found = np.array(laspy.read(out / "own.laz").classification)
    for code, classes in ((40, {2}), (67, {6}), (6, {6}), (99, {99})):
        assert set(found[codes == code]) == classes
    assert set(found[codes == 9]) <= {1, 5}, "what is in no list is neither ground nor building"
    assert set(found[codes == 41]) <= {1, 5}


def test_inspect_shows_what_own_codes_mean(of_a_producer: Path, tmp_path: Path) -> None:
    words = ("inspect", str(of_a_producer), "--crs", "EPSG:25832")
    (tmp_path / "codes.toml").write_text(
        "[settings.class-codes]\nground = [40]\nbuilding = [6, 67]\nvegetation = [41]\n"
    )
    as_stored, mapped = (
        {int(code): count for code, count in json.loads(invoke(*words, *more, "--json")[1])["classes"].items()}
        for more in ((), ("--settings", str(tmp_path / "codes.toml")))
    )
    assert {6, 40, 41, 67} <= set(as_stored)
    assert mapped[2] == as_stored[40]
    assert mapped[6] == as_stored[6] + as_stored[67]
    assert mapped[3] == as_stored[41]
    assert not {40, 41, 67} & set(mapped)
    said = invoke(*words, "--settings", str(tmp_path / "codes.toml"))[1]
    assert "building" in said
    assert "vegetation" in said


def test_codes_of_noise_are_left_out(classified: Path, tmp_path: Path) -> None:
    las = laspy.read(classified)
    las.classification[:100] = 99
    las.write(tmp_path / "noisy.laz")
    options = ReadOptions(class_table=RunSettings.from_mapping(OWN).class_codes.table)
    source = open_source(tmp_path / "noisy.laz", options)
    assert sum(len(cloud) for cloud in source.chunks()) == len(las.points) - 100
    assert source.dropped["noise_class"] == 100


def test_a_code_that_was_taken_from_its_group_means_nothing_special() -> None:
    table = ClassCodeSettings(building=(67,), noise=()).table
    assert (table[67], table[6], table[7], table[18], table[2], table[9]) == (6, OTHER, OTHER, OTHER, 2, 9)
    assert ClassCodeSettings(vegetation=(5, 4, 3)).table is None


def test_other_things_give_way_to_lists_that_name_their_codes_and_the_rest_is_undecided() -> None:
    codes = RunSettings.from_mapping({"class-codes": {"ground": [2, 8], "building": [6, 21, 67], "undecided": [26]}})
    table = codes.class_codes.table
    assert table is not None
    assert (table[8], table[21], table[67], table[26], table[17], table[28]) == (2, 6, 6, 0, 17, 28)
    with pytest.raises(SettingsError, match="code 21 is building and other: give it in one list"):
        RunSettings.from_mapping({"class-codes": {"building": [6, 21], "other": [9, 21]}})
    assert ClassCodeSettings.role(28) == ClassCodeSettings.role(70) == "undecided"


def test_settings_of_codes_are_checked_and_hashed() -> None:
    with pytest.raises(SettingsError, match=r"\[class-codes\] building is .*list of whole numbers from 0 to 255"):
        RunSettings.from_mapping({"class-codes": {"building": [6, 300]}})
    with pytest.raises(SettingsError, match=r"\[class-codes\] ground is 2: use a list"):
        RunSettings.from_mapping({"class-codes": {"ground": 2}})
    with pytest.raises(SettingsError, match="code 6 is ground and building: give it in one list"):
        RunSettings.from_mapping({"class-codes": {"ground": [2, 6]}})
    plain, own = RunSettings(), RunSettings.from_mapping(OWN)
    assert plain.settings_hash != own.settings_hash
    again = own.as_dict()
    assert RunSettings.from_mapping({**again.pop("general"), **again}) == own


def test_the_ign_buildings_are_found_by_their_class_under_another_code(
    shared_data: Path, tmp_path: Path, reconstruct: Any
) -> None:
    """The tile of Haute-Durance with 67 in the place of 6: a file's own code for buildings."""
    tile = shared_data / "ign" / "hdf_870000_6617100.laz"
    las = laspy.read(tile)
    las.classification[las.classification == 6] = 67
    las.write(tmp_path / "own.laz")
    known = reconstruct(tile, crs="EPSG:2154")
    mapped = reconstruct(tmp_path / "own.laz", crs="EPSG:2154", settings={"class-codes": {"building": [6, 67]}})
    assert mapped.counts == known.counts
    assert mapped.statuses == known.statuses
