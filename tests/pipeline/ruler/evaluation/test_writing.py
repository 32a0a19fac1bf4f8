"""Files of an evaluation: Parquet and Markdown say what was measured, and no more than the figures support."""

import dataclasses
import json
import math
import re
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from damaged_suburb import KINDS, damaged_evaluation

from pipeline.errors import RunError
from pipeline.ruler.evaluation.chapters import chapters, printed
from pipeline.ruler.evaluation.counted_models import breakdowns, count_tables
from pipeline.ruler.evaluation.definitions import DEFINITIONS
from pipeline.ruler.evaluation.evaluation_writing import markdown, measures_table, write_tables
from pipeline.ruler.evaluation.measure import Group, Measure


def measure(value: float, low: float = math.nan, high: float = math.nan, name: str = "delivery.lod2") -> Measure:
    """A figure over 1,234 things."""
    return Measure(name=name, value=value, low=low, high=high, n=1234)


@pytest.mark.parametrize("kind", KINDS)
def test_parquet_and_markdown_hold_every_measure_with_the_words_of_its_definition(
    kind: dict[str, bool], tmp_path: Path
) -> None:
    evaluation = damaged_evaluation(**kind)
    written = write_tables(evaluation, tmp_path)
    rows = pq.read_table(tmp_path / "measures.parquet").to_pylist()
    assert [row["name"] for row in rows] == [measure.name for measure in evaluation.measures]
    text = (tmp_path / "report.md").read_text()
    for row, one in zip(rows, evaluation.measures, strict=True):
        definition = DEFINITIONS[one.name]
        assert (row["group"], row["label"], row["unit"]) == (definition.group, definition.label, definition.unit)
        assert (row["n"], row["subset"], row["better"]) == (one.n, one.subset, definition.better)
        for end in ("value", "low", "high"):
            figure = getattr(one, end)
            assert row[end] == figure if math.isfinite(figure) else row[end] is None
        line = printed(one, definition)
        label = definition.label.replace(">", "&gt;")
        cells = [cell for row in text.splitlines() if row.startswith(f"| {label} |") for cell in row.split(" | ")]
        assert line.value in cells
        assert line.interval in cells
    names = {path.name for path in written}
    assert names == {"measures.parquet", "report.md", *(f"{name}.parquet" for name in evaluation.tables)}
    assert names == {path.name for path in tmp_path.iterdir()}


def test_tables_come_back_from_parquet_as_they_were(tmp_path: Path) -> None:
    evaluation = damaged_evaluation()
    write_tables(evaluation, tmp_path)
    for name, table in evaluation.tables.items():
        assert pq.read_table(tmp_path / f"{name}.parquet").replace_schema_metadata(None).equals(table)


def test_tables_with_geometries_are_geoparquet_with_their_reference_system(tmp_path: Path) -> None:
    evaluation = damaged_evaluation()
    write_tables(evaluation, tmp_path)
    geo = json.loads(pq.read_schema(tmp_path / "true_faces.parquet").metadata[b"geo"])
    column = geo["columns"]["geometry"]
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 28992}
    faces = shapely.from_wkb(evaluation.tables["true_faces"]["geometry"].to_pylist())
    assert column["bbox"] == pytest.approx(shapely.total_bounds(faces))
    assert column["geometry_types"] == ["Polygon"]
    assert evaluation.reference is not None
    feet = dataclasses.replace(evaluation.reference, crs="EPSG:2263")
    write_tables(dataclasses.replace(evaluation, reference=feet), tmp_path)
    geo = json.loads(pq.read_schema(tmp_path / "true_faces.parquet").metadata[b"geo"])
    assert geo["columns"]["geometry"]["crs"] is None, "coordinates are metres, those of the system are feet"


def test_the_same_evaluation_gives_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        write_tables(damaged_evaluation(), tmp_path / folder)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(RunError, match="cannot be made"):
        write_tables(damaged_evaluation(), tmp_path / "file")


@pytest.mark.parametrize(
    ("one", "value", "interval"),
    [
        (measure(0.93444, 0.9290, 0.9401), "93.4 %", "92.9 to 94.0 %"),
        (measure(0.72, 0.5, 0.9), "72 %", "50 to 90 %"),
        (measure(0.99996, 0.9999, 1.0), "> 99.9 %", "> 99.9 to 100.0 %"),
        (measure(0.00001), "< 0.1 %", ""),
        (measure(1.0), "100.0 %", ""),
        (measure(0.0), "0.0 %", ""),
        (measure(math.nan), "-", ""),
        (measure(0.05231, 0.0512, 0.0533, "residuals.rmse"), "0.052 m", "0.051 to 0.053 m"),
        (measure(0.5231, 0.32, 0.83, "residuals.rmse"), "0.52 m", "0.32 to 0.83 m"),
        (measure(4.4, 1.0, 9.0, "residuals.rmse"), "4.4 m", "1.0 to 9.0 m"),
        (measure(0.0119, -0.02, 0.03, "residuals.bias"), "+0.012 m", "-0.020 to +0.030 m"),
        (measure(-0.00001, name="residuals.bias"), "0.000 m", ""),
        (measure(12345.0, name="delivery.false_models"), "12,345", ""),
    ],
)
def test_a_figure_has_no_more_digits_than_its_interval_supports(one: Measure, value: str, interval: str) -> None:
    line = printed(one, DEFINITIONS[one.name])
    assert (line.value, line.interval, line.n) == (value, interval, "1,234")


def test_chapters_have_the_order_of_the_groups_and_keep_subsets_together() -> None:
    found = chapters(damaged_evaluation())
    groups = [chapter.group for chapter in found]
    assert groups == [group for group in Group if group in groups]
    types = next(chapter for chapter in found if chapter.group is Group.ROOF_TYPES)
    assert types.subsets == ("all", "without defects")
    assert list(types.measures["roof_types.correct"]) == ["all", "without defects"]


def test_a_subset_with_nothing_in_it_is_not_printed_but_stays_in_the_table() -> None:
    evaluation = damaged_evaluation()
    nothing = Measure(name="roof_types.correct", value=math.nan, n=0, subset="hard")
    evaluation = dataclasses.replace(evaluation, measures=(*evaluation.measures, nothing))
    types = next(one for one in chapters(evaluation) if one.group is Group.ROOF_TYPES)
    assert types.subsets == ("all", "without defects")
    assert measures_table(evaluation).to_pylist()[-1]["subset"] == "hard"


def test_a_measure_without_a_definition_is_a_fault() -> None:
    evaluation = dataclasses.replace(damaged_evaluation(), measures=(measure(0.5, name="no.such"),))
    with pytest.raises(KeyError, match=r"no\.such"):
        markdown(evaluation)
    with pytest.raises(KeyError, match=r"no\.such"):
        measures_table(evaluation)


def test_every_definition_has_its_own_name_that_starts_with_its_chapter() -> None:
    assert len(DEFINITIONS) > 80
    for name, definition in DEFINITIONS.items():
        assert name == definition.name
        assert name.startswith(f"{definition.group.value}.")
        assert definition.formula
        assert "\n" not in definition.formula + definition.label
    assert {definition.group for definition in DEFINITIONS.values()} == set(Group)
    labels = [(definition.group, definition.label) for definition in DEFINITIONS.values()]
    assert len(set(labels)) == len(labels)


def test_outcomes_are_summed_as_the_paper_prints_them() -> None:
    table = pa.table(
        {
            "subset": ["all", "all", "good"],
            "true_type": ["gable", "flat", "gable"],
            "correct": [135, 1, 109],
            "passable": [67, 0, 40],
            "false": [37, 2, 8],
        }
    )
    everything, good = count_tables({"outcomes": table})[Group.ROOF_TYPES]
    assert everything.rows == (
        ("flat", "1", "0", "2", "3", "33.3 %", "33.3 %"),
        ("gable", "135", "67", "37", "239", "56.5 %", "84.5 %"),
        ("all", "136", "67", "39", "242", "56.2 %", "83.9 %"),
    )
    assert good.title == "Outcomes: buildings without defects"
    assert good.rows[-1][:5] == ("all", "109", "40", "8", "157")


def test_the_confusion_is_a_matrix_with_a_column_for_what_was_not_found() -> None:
    table = pa.table(
        {"true_type": ["hip", "gable", "hip"], "model_type": ["gable", "gable", "none"], "buildings": [2, 1500, 3]}
    )
    (confusion,) = count_tables({"confusion": table})[Group.ROOF_TYPES]
    assert confusion.header == ("true type", "gable", "not found")
    assert confusion.rows == (("gable", "1,500", "0"), ("hip", "2", "3"))


def test_breakdowns_are_shares_of_sums_and_leave_out_buildings_at_the_edge() -> None:
    rows = [
        {"shape": "hip", "n_points": 100, "n_within": 90, "touches_data_edge": False, "defects": ["dormers"]},
        {"shape": "hip", "n_points": 300, "n_within": 150, "touches_data_edge": False, "defects": []},
        {
            "shape": "pent",
            "n_points": 50,
            "n_within": 50,
            "touches_data_edge": False,
            "defects": ["dormers", "wet_spot"],
        },
        {"shape": "pent", "n_points": 1000, "n_within": 0, "touches_data_edge": True, "defects": []},
    ]
    by_shape, by_defect = breakdowns({"buildings": pa.Table.from_pylist(rows)})
    assert by_shape.header == ("shape", "buildings", "points within 0.2 m")
    assert by_shape.rows == (("hip", "2", "60.0 %"), ("pent", "1", "100.0 %"))
    assert by_defect.rows == (("none", "1", "50.0 %"), ("dormers", "2", "93.3 %"), ("wet_spot", "1", "100.0 %"))


def test_what_was_not_measured_has_no_column() -> None:
    headers = {column for table in breakdowns(damaged_evaluation(points=False).tables) for column in table.header}
    assert "points within 0.2 m" not in headers
    assert {"found", "correct", "faces found"} <= headers
    assert breakdowns(damaged_evaluation(reference=False).tables) == ()


def test_markdown_neither_breaks_its_tables_nor_lets_html_through() -> None:
    evaluation = damaged_evaluation()
    nasty = dataclasses.replace(evaluation.models, name="a|b<script>\nx")
    text = markdown(dataclasses.replace(evaluation, models=nasty))
    assert "<script" not in text
    assert "a\\|b&lt;script&gt; x" in text
    assert "One \\| note." in text
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        columns = {len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(columns) == 1
