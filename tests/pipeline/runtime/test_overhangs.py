"""LoD2.3 in a run: beside LoD2.2, whatever the tiles, for single buildings by overrides, and again by a rerun."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import shapely

from pipeline.export.geoparquet import read_table
from pipeline.export.solid_geometry import OVERHANG_COLUMNS
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.runtime.digest import ADDED
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary

Reconstruct = Callable[..., RunSummary]

USUAL = {"lods": "2.2,2.3", "roof": {"usual_overhang_m": 0.4}}


def rows(summary: RunSummary) -> dict[str, dict[str, Any]]:
    return {row["building_id"]: row for row in read_table(summary.run_dir, "buildings").to_pylist()}


def test_a_run_has_overhangs_beside_the_models_of_a_run_without(suburb: Path, reconstruct: Reconstruct) -> None:
    without, usual = reconstruct(suburb), reconstruct(suburb, settings=USUAL)
    plain, found = rows(without), rows(usual)
    assert usual.digest != without.digest
    hung = [row for row in found.values() if row["solid_lod23"] is not None]
    assert len(hung) > 0.5 * len(found)
    assert all(row["lod23_reason"] for row in found.values() if row["solid_lod23"] is None and row["lod"])
    for name, row in found.items():
        # what lies beside a building is a part of its input
        of_the_run = ADDED | {"settings_hash", "input_hash", "wall_outline", "overhang_m", "overhang_sigma_m", "bbox"}
        assert {k: v for k, v in row.items() if k not in of_the_run} == {
            k: v for k, v in plain[name].items() if k not in of_the_run
        }
    assert not any(row[column] is not None for row in plain.values() for column in OVERHANG_COLUMNS)
    lods = set()
    for path in Path(usual.run_dir).glob("cityjson/*/*.city.jsonl"):
        for line in path.read_text().splitlines()[1:]:
            for entry in json.loads(line)["CityObjects"].values():
                lods.add(tuple(geometry["lod"] for geometry in entry.get("geometry", ())))
    assert {("2.2", "2.3")} <= lods <= {("2.2", "2.3"), ("2.2",), ("1.2",), ()}
    assert len(list(Path(usual.run_dir).glob("meshes/*/*-lod23.obj"))) == sum(
        row["lod"] is not None for row in plain.values()
    )


@pytest.mark.slow
def test_overhangs_do_not_depend_on_the_tiles(suburb: Path, reconstruct: Reconstruct) -> None:
    one, many = (reconstruct(suburb, settings={**USUAL, "tile_size_m": size}) for size in (0.0, 60.0))
    assert one.digest == many.digest


@pytest.mark.slow
def test_an_override_gives_one_building_an_overhang_and_a_rerun_does_the_same(
    suburb: Path, reconstruct: Reconstruct, tmp_path: Path
) -> None:
    settings = {"lods": "2.2,2.3"}
    first = reconstruct(suburb, settings=settings)
    name, row = max(rows(first).items(), key=lambda item: item[1]["footprint_area_m2"] or 0.0)
    wkt = shapely.from_wkb(row["geometry"]).wkt
    overrides = tmp_path / "overrides.toml"
    overrides.write_text(
        f'[[building]]\nbuilding_id = "{name}"\nfootprint = "{wkt}"\n'
        "[building.settings.roof]\nbeyond_footprint_m = 0.5\n"
    )
    whole = reconstruct(suburb, settings=settings, overrides=str(overrides))
    changed = rows(whole)[name]
    assert (changed["overhang_source"], changed["lod23_reason"]) == ("given", None)
    eaves = shapely.union_all([shapely.force_2d(face) for face in _faces(changed, "RoofSurface")])
    assert eaves.area > row["footprint_area_m2"] + 0.3 * shapely.from_wkb(row["geometry"]).length
    again = rerun(RerunRequest(run_dir=first.run_dir, overrides=str(overrides), resources=Resources(workers=0)))
    assert again.digest == whole.digest != first.digest


def _faces(row: dict[str, Any], kind: str) -> list[shapely.Polygon]:
    faces = shapely.get_parts(shapely.from_wkb(row["solid_lod23"])).tolist()
    return [face for face, own in zip(faces, row["solid_lod23_surfaces"], strict=True) if own == kind]
