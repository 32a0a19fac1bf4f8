"""What the benchmarks measure, what they find there already, and how they fill in pages."""

import dataclasses
import json
from pathlib import Path

import pytest

from benchmarks.entries import (
    Entry,
    SimulatedScene,
    Workplace,
    all_variants,
    filled,
    hofmann_entries,
    measure_all,
    run_settings,
    sweep_entries,
)
from benchmarks.ruler import cell, methods_table
from pipeline.extras.compare.compare import Variant, settings_of
from pipeline.methods import METHODS
from pipeline.ruler.simulation.sweep import CELLS

FUZZY = Variant(method="fuzzy-sart")


def test_every_method_is_measured_with_all_presets_that_it_has() -> None:
    variants = all_variants(with_faithful=True)
    papers = [name for name in METHODS if name != "arrangement"]
    assert sorted(variant.label for variant in variants) == sorted([*METHODS, *(f"{name}-faithful" for name in papers)])
    for variant in variants:
        assert METHODS[variant.method].preset(variant.preset)
    assert [variant.label for variant in all_variants(with_faithful=False)] == list(METHODS)


def test_entries_have_names_and_scenes_of_their_own() -> None:
    entries = [*hofmann_entries("dev", 3), *sweep_entries("dev")]
    assert len(entries) == 3 + len(CELLS)
    place = Workplace(root=Path("w"))
    assert len({entry.name for entry in entries}) == len({place.scene(entry) for entry in entries}) == len(entries)


@pytest.mark.parametrize(
    ("status", "changed", "there"), [("finished", False, True), ("failed", False, False), ("finished", True, False)]
)
def test_a_run_counts_where_it_is_whole_and_by_the_same_settings(tmp_path, status, changed, there) -> None:
    entry, place = Entry(name="one"), Workplace(root=tmp_path)
    settings = settings_of(run_settings(entry), FUZZY).settings_hash
    manifest = {"status": status, "settings_hash": "other" if changed else settings}
    place.run(FUZZY, entry).mkdir(parents=True)
    (place.run(FUZZY, entry) / "run.json").write_text(json.dumps(manifest))
    assert place.is_run(FUZZY, entry) == there
    assert not place.is_measured(FUZZY, entry)
    place.report(FUZZY, entry).mkdir()
    (place.report(FUZZY, entry) / "report.md").write_text("measured")
    assert place.is_measured(FUZZY, entry) == there


def test_parts_of_a_page_that_are_there_are_replaced_and_others_stay(tmp_path) -> None:
    page = (
        "# A\n<!-- begin one.md -->\nold\n<!-- end one.md -->\nprose\n<!-- begin two.md -->\nold\n<!-- end two.md -->\n"
    )
    (tmp_path / "one.md").write_text("| entry |\n| --- |\n| city |\n")
    new, missing = filled(page, tmp_path)
    assert missing == ["two.md"]
    assert new == page.replace("old", "\n| entry |\n| --- |\n| city |\n", 1)
    assert filled(new, tmp_path)[0] == new


@pytest.mark.slow
def test_an_entry_is_measured_once_and_ground_is_the_same_for_all_methods(tmp_path, capsys) -> None:
    entry = Entry(name="cube", scene=SimulatedScene(suite="cube", seed=1000), has_page=False)
    variants = [FUZZY, dataclasses.replace(FUZZY, preset="faithful")]
    place = Workplace(root=tmp_path)
    assert measure_all([(entry, variants[:1])], place, 0) == []
    assert measure_all([(entry, variants)], place, 1) == []
    capsys.readouterr()
    assert measure_all([(entry, variants)], place, 0) == []
    assert capsys.readouterr().out == ""
    kappas = {cell(place.table(variant, entry, "measures"), "ground.kappa") for variant in variants}
    assert len(kappas) == 1
    assert kappas != {""}
    lines = methods_table([entry], variants, place).splitlines()
    assert [line.split(" | ")[1] for line in lines[2:]] == ["fuzzy-sart", "fuzzy-sart-faithful"]
    assert not list((tmp_path / "scratch").glob("*"))


@pytest.mark.slow
def test_a_fault_of_one_entry_is_reported_and_costs_no_other(tmp_path) -> None:
    broken = Entry(name="broken", tiles=(tmp_path / "not_there.laz",))
    sound = Entry(name="cube", scene=SimulatedScene(suite="cube", seed=1000), has_page=False)
    place = Workplace(root=tmp_path / "w")
    faults = measure_all([(broken, [FUZZY]), (sound, [FUZZY])], place, 2)
    assert [fault.split(":")[0] for fault in faults] == ["broken"]
    assert place.is_measured(FUZZY, sound)
