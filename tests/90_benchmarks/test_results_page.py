"""What was measured goes between the marks of the page, and nothing else changes."""

import re

from benchmarks.results_page import PAGE, filled

WRITTEN = {"hofmann_tables.md", "sweep_limits.md", "method_times.md", "methods.md"}


def test_parts_that_are_there_are_replaced_and_others_stay(tmp_path) -> None:
    page = (
        "# A\n<!-- begin one.md -->\nold\n<!-- end one.md -->\nprose\n<!-- begin two.md -->\nold\n<!-- end two.md -->\n"
    )
    (tmp_path / "one.md").write_text("| entry |\n| --- |\n| city |\n| sweep-d1_n0.02 |\n")
    new, missing = filled(page, tmp_path, ("| sweep-",))
    assert missing == ["two.md"]
    assert new == page.replace("old", "\n| entry |\n| --- |\n| city |\n", 1)
    assert filled(new, tmp_path, ("| sweep-",))[0] == new
    assert "| sweep-d1_n0.02 |" in filled(page, tmp_path)[0]


def test_the_page_of_results_has_a_part_for_what_every_program_writes() -> None:
    text = PAGE.read_text()
    assert set(re.findall(r"<!-- begin (\S+) -->", text)) == set(re.findall(r"<!-- end (\S+) -->", text)) == WRITTEN
