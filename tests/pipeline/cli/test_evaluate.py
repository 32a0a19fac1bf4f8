"""`gablework evaluate` as a user types it: against truth, against points, alone, and on files of other programs."""

import json
import shutil
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import invoke

from pipeline.console import ExitCode
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.wireframe_network import network, roof_segments
from pipeline.ruler.simulation.dataset import Output, ScenePaths, simulate


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ScenePaths:
    """A classified tile of a few houses, and its truth."""
    folder = tmp_path_factory.mktemp("scene")
    return simulate(
        "suburb", folder, 90_003, size_m=(110.0, 100.0), density_per_m2=6.0, output=Output(with_classes=True)
    )


def evaluated(*words: str | Path) -> dict[str, Any]:
    code, said, error = invoke("evaluate", *map(str, words), "--json")
    assert code == 0, error
    return dict(json.loads(said))


def figures(document: dict[str, Any]) -> dict[str, float]:
    return {row["name"]: row["value"] for row in document["measures"] if row["subset"] == "all"}


def refused(*words: str | Path) -> str:
    code, _, error = invoke("evaluate", *map(str, words))
    assert code in {ExitCode.USAGE, ExitCode.INPUT}
    return " ".join(error.split())


def test_a_report_holds_page_text_and_tables(scene: ScenePaths, tmp_path: Path) -> None:
    document = evaluated(scene.truth, "--truth", scene.truth, "--out", tmp_path / "report")
    measured = figures(document)
    assert measured["faces.quality_10m2"] == measured["delivery.lod2"] == measured["validity.solids_valid"] == 1.0
    names = {Path(path).name for path in document["written"]}
    assert {"report.html", "report.md", "measures.parquet", "buildings.parquet", "true_faces.parquet"} <= names
    assert all(Path(path).stat().st_size > 0 for path in document["written"])
    stored = pq.read_table(tmp_path / "report" / "measures.parquet").to_pylist()
    assert stored == document["measures"]


def test_the_class_of_the_points_can_be_the_reference(scene: ScenePaths) -> None:
    measured = figures(evaluated(scene.truth, "--points", scene.laz))
    assert measured["residuals.within_0_2m_top_visible"] > 0.95
    assert measured["detection.area_quality_without_ring"] > 0.95
    assert not any(name.startswith(("faces.", "roof_types.")) for name in measured)


def test_without_a_reference_what_was_delivered_and_its_form_is_reported(scene: ScenePaths) -> None:
    measured = figures(evaluated(scene.truth))
    assert {name.split(".")[0] for name in measured} == {"delivery", "form", "validity"}
    assert not any(name.startswith(("form.drawn", "form.corner_", "form.block")) for name in measured)
    assert measured["delivery.records_ok"] == 1.0


def test_models_of_other_programs_are_held_to_the_same_ruler(scene: ScenePaths, tmp_path: Path) -> None:
    own = figures(evaluated(scene.truth, "--truth", scene.truth))
    (sequence,) = scene.truth.glob("cityjson/*/part-0.city.jsonl")
    shutil.copy(sequence, tmp_path / "city.city.jsonl")
    foreign = figures(evaluated(tmp_path / "city.city.jsonl", "--truth", scene.truth))
    meshes = figures(evaluated(scene.truth / "meshes", "--truth", scene.truth))
    for name, value in own.items():
        # OBJ has no roof types, and cannot say where the data end
        if not name.startswith(("roof_types", "delivery.records")):
            assert foreign[name] == pytest.approx(value, abs=2e-3), name
            assert name.startswith("delivery") or meshes[name] == pytest.approx(value, abs=5e-3), name
    assert foreign["roof_types.accuracy"] == 1.0


def test_the_ground_of_any_program_is_judged(scene: ScenePaths, tmp_path: Path) -> None:
    tile = laspy.read(scene.laz)
    wrong = np.flatnonzero(np.asarray(tile.classification) == 2)[::10]
    tile.classification[wrong] = 1
    tile.write(tmp_path / "classified.laz")
    measured = figures(evaluated(scene.truth, "--points", scene.laz, "--ground", tmp_path / "classified.laz"))
    assert measured["ground.type_1"] == pytest.approx(0.1, abs=0.01)
    assert measured["ground.type_2"] == 0.0


def test_true_roof_edges_can_be_the_reference(scene: ScenePaths, tmp_path: Path) -> None:
    truth = read_models(scene.truth).models
    edges = {one.building_id: network(roof_segments([one], [0])).edges.reshape(-1, 3) for one in truth}
    drawn = {name: {"v": xyz.tolist(), "e": np.arange(len(xyz)).reshape(-1, 2).tolist()} for name, xyz in edges.items()}
    (tmp_path / "drawn.json").write_text(json.dumps(drawn))
    document = evaluated(scene.truth, "--wireframes", tmp_path / "drawn.json", "--out", tmp_path / "report")
    measured = {name: value for name, value in figures(document).items() if name.startswith("wireframes.")}
    assert measured.pop("wireframes.board_corner_offset") == pytest.approx(0.0, abs=1e-9)
    board = {name: measured.pop(name) for name in list(measured) if ".board_" in name}
    assert board["wireframes.board_corner_precision"] == 1.0
    assert len(measured) == 21
    assert list(measured.values()) == pytest.approx([1.0] * 21)
    rows = pq.read_table(tmp_path / "report" / "wireframes.parquet").to_pylist()
    assert {name: row["corner_f1_0_3m"] for name, row in zip(sorted(drawn), rows, strict=True)} == dict.fromkeys(
        drawn, 1.0
    )
    for page in ("report.html", "report.md"):
        text = (tmp_path / "report" / page).read_text()
        assert "Roof edges and corners" in text
        assert f"drawn.json: roof edges of {len(drawn)} buildings" in text
    (tmp_path / "drawn.json").write_text('{"a": {"v": [[0, 0, 5]], "e": [[0, 1]]}}')
    assert "edge 0 of building 'a' is [0, 1]" in refused(scene.truth, "--wireframes", tmp_path / "drawn.json")


def test_what_does_not_go_together_is_refused(scene: ScenePaths, tmp_path: Path) -> None:
    assert "use one of --truth and --points" in refused("run", "--truth", scene.truth, "--points", scene.laz)
    assert "nothing is there" in refused(tmp_path / "nowhere", "--truth", scene.truth)
    assert "no readable scene.json" in refused(scene.truth, "--truth", tmp_path)
    unclassified = laspy.read(scene.laz)
    unclassified.classification[:] = 1
    unclassified.write(tmp_path / "raw.laz")
    reported = refused(scene.truth, "--points", tmp_path / "raw.laz")
    assert "raw.laz" in reported
    assert "class" in reported
