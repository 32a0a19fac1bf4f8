"""The sweep: the same buildings under every survey, a data set a cell."""

import json
from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from pipeline.errors import SettingsError
from pipeline.ruler.simulation.dataset import ScenePaths, simulate
from pipeline.ruler.simulation.roofs import RoofShape
from pipeline.ruler.simulation.sweep import CELLS, DENSITIES_PER_M2, NOISES_M, chosen_cells, sweep


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> ScenePaths:
    """The cells of one noise and two densities, in one folder."""
    folder = tmp_path_factory.mktemp("sweep")
    simulate("sweep", folder, 1_002, density_per_m2=1.0, noise_m=0.05)
    return simulate("sweep", folder, 1_002, density_per_m2=0.5)


def test_the_cells_are_all_densities_with_all_noises() -> None:
    assert len(CELLS) == len(DENSITIES_PER_M2) * len(NOISES_M) == 21
    assert [cell.key for cell in chosen_cells(CELLS, 8.0, None)] == ["d8_n0.02", "d8_n0.05", "d8_n0.10"]
    assert [cell.key for cell in chosen_cells(CELLS, 0.5, 0.1)] == ["d0.5_n0.10"]
    assert chosen_cells(CELLS, None, None) == CELLS


def test_a_density_that_is_no_cell_is_refused_with_those_that_are(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"density is 3: the cells have densities of 0\.5, 1, 2, 4, 8, 16, 50"):
        simulate("sweep", tmp_path, density_per_m2=3.0)
    assert list(tmp_path.iterdir()) == []


def test_all_shapes_are_there_four_times_and_some_houses_stand_in_rows() -> None:
    scene = sweep(1_002)
    alone = Counter(one.shape for one in scene.buildings if one.block_id == one.building_id)
    assert alone == dict.fromkeys(RoofShape, 4)
    rows = Counter(one.block_id for one in scene.buildings if one.block_id != one.building_id)
    assert len(rows) == 2
    assert min(rows.values()) >= 4
    assert 8 <= sum(not one.is_good for one in scene.buildings) <= len(RoofShape)


def test_every_cell_holds_the_same_buildings_under_its_own_survey(made: ScenePaths) -> None:
    tables = [pq.read_table(one.truth / "conditions.parquet") for one in made.cells]
    assert len(tables) == 3
    assert all(table.equals(tables[0]) for table in tables)
    meshes = [(one.truth / "meshes" / "part00000" / "part00000.obj").read_bytes() for one in made.cells]
    assert len(set(meshes)) == 1
    scanners = [json.loads((one.truth / "scene.json").read_text())["scanner"] for one in made.cells]
    assert [one["range_noise_m"] for one in scanners] == list(NOISES_M)
    assert {one["pulse_density_per_m2"] for one in scanners} == {0.5}
    assert made.points == sum(one.points for one in made.cells)


def test_the_list_of_cells_names_every_folder_of_the_call(made: ScenePaths) -> None:
    document = json.loads((made.laz / "sweep.json").read_text())
    assert [one["cell"] for one in document["cells"]] == ["d0.5_n0.02", "d0.5_n0.05", "d0.5_n0.10"]
    for one in document["cells"]:
        assert (made.laz / one["cell"] / "sweep.laz").is_file()
    assert (made.laz / "d1_n0.05" / "sweep.laz").is_file()  # of the call before
