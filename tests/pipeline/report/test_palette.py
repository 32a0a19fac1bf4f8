"""One palette, and one list of roof types, in pictures, on the page and in the docs."""

import re
from pathlib import Path

from pipeline.export.columns import COLUMNS
from pipeline.model import RoofType
from pipeline.report.palette import ROOF_COLOURS

ROOT = Path(__file__).resolve().parents[3]


def test_the_page_draws_each_roof_type_in_the_colour_of_the_pictures() -> None:
    source = (ROOT / "service/viewer/src/words/roof_types.ts").read_text(encoding="utf-8")
    on_page = dict(
        re.findall(r'^  "?([a-z-]+)"?: \{ label: "[^"]+", colour: "(#[0-9a-f]{6})" \},$', source, re.MULTILINE)
    )
    drawn = {kind.value: colour for kind, colour in ROOF_COLOURS.items() if kind is not RoofType.NONE}
    assert {kind: on_page.get(kind) for kind in drawn} == drawn
    assert set(ROOF_COLOURS) == set(RoofType)
    assert len(set(ROOF_COLOURS.values())) == len(ROOF_COLOURS)


def test_the_column_names_each_roof_type() -> None:
    (column,) = (one for one in COLUMNS["buildings"] if one.name == "roof_type")
    assert set(re.findall("`([a-z-]+)`", column.meaning)) == {kind.value for kind in RoofType}
