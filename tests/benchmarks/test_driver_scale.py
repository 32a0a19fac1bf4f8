"""The driver of a large city that is made of copies of a small one."""

import dataclasses
import pickle
from pathlib import Path

import pytest

from benchmarks.driver_scale import cost_of_driver, in_all, moved, recorded, tables, written
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.stages.sites import RejectedFigures
from pipeline.tiling import Tile


def test_tiles_of_a_brief_move_and_nothing_else_does() -> None:
    brief = RejectedFigures(
        owner=Tile(3, 4), folders=("tiles/x3_y4",), digest="ab", reasons={"too_small": 2}, bridges_in=(Tile(2, 4),)
    )
    assert moved(written(brief), 0) == brief
    farther = moved(written({"of": [brief]}), 8)["of"][0]
    assert farther == dataclasses.replace(brief, owner=Tile(11, 4), bridges_in=(Tile(10, 4),))
    assert pickle.loads(pickle.dumps(brief)) == brief


@pytest.mark.slow
def test_copies_of_a_city_have_as_many_times_all_that_it_has(tmp_path: Path) -> None:
    laz = simulate("suburb", tmp_path, 3, size_m=(130.0, 90.0), density_per_m2=2.0).laz
    plan, briefs, buildings = recorded([str(laz)], 2, 40.0)
    once, often = (cost_of_driver(plan, briefs, copies, 2, 40.0) for copies in (1, 5))
    assert once["buildings"] == buildings > 3
    for name in ("buildings", "files", "tiles"):
        assert often[name] == 5 * once[name]
    for stage in ("ingest", "cells", "split", "outline", "reconstruct", "publish"):
        assert often["tasks"][stage] == 5 * once["tasks"][stage]
    assert in_all(often) > in_all(once) > 0.0
    assert "| 1 |" in tables({"rows": [once, often], "look_s": 0.01})
