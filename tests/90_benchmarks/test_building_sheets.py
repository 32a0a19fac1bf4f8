"""The contact sheets: every building of a run is on one, with the share that its points tell."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "60_export"))

from small_runs import street, write_run

from benchmarks.building_sheets import COLUMNS, ROWS, main, sheet, within_share
from pipeline.ruler.evaluation.reading import read_models


def roof_points(run: Path, lifted_m: float) -> np.ndarray:
    """Points on the roofs of a run's models, every other one lifted."""
    places = []
    for model in read_models(str(run)).models:
        x_min, y_min, x_max, y_max = model.footprint.bounds
        x, y = (axis.ravel() for axis in np.meshgrid(np.arange(x_min + 0.25, x_max, 0.5), np.arange(y_min, y_max, 0.5)))
        z = model.top(x, y)
        kept = np.isfinite(z)
        places.append(np.column_stack([x[kept], y[kept], z[kept]]))
    xyz = np.concatenate(places)
    xyz[::2, 2] += lifted_m
    return xyz


def test_every_building_has_a_cell_with_its_share(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", street())
    tile = tmp_path / "points.xyz"
    np.savetxt(tile, roof_points(run, 0.6), fmt="%.3f")
    assert main([str(run), "--points", str(tile), "--crs", "EPSG:28992", "--out", str(tmp_path / "sheets")]) == 0
    models = read_models(str(run)).models
    lines = (tmp_path / "sheets" / "sheets.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 2 + len(models)
    shares = [float(line.split("|")[3].split(",")[0]) for line in lines[2:]]
    assert shares == pytest.approx([0.5] * len(models), abs=0.1)
    with Image.open(tmp_path / "sheets" / "sheet_01.png") as drawn:
        assert len(drawn.convert("RGB").getcolors(2**20)) > 20
    assert not (tmp_path / "sheets" / "sheet_02.png").exists()


def test_a_building_without_model_has_no_share() -> None:
    assert math.isnan(within_share(None, np.zeros((3, 3))))


def test_a_sheet_is_as_large_as_its_rows() -> None:
    cells = [Image.new("RGB", (10, 5 + k % 3)) for k in range(COLUMNS * ROWS - 1)]
    assert sheet(cells).size == (10 * COLUMNS, sum(max(5 + k % 3 for k in row) for row in _rows(len(cells))))


def _rows(cells: int) -> list[range]:
    return [range(first, min(first + COLUMNS, cells)) for first in range(0, cells, COLUMNS)]


def test_what_meets_given_outlines_is_left_out_and_sheets_are_as_asked(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", street())
    tile = tmp_path / "points.xyz"
    np.savetxt(tile, roof_points(run, 0.6), fmt="%.3f")
    models = read_models(str(run)).models
    given = tmp_path / "given.geojson"
    given.write_text(shapely.to_geojson(models[0].footprint.representative_point().buffer(0.1)), encoding="utf-8")
    reported = [str(run), "--points", str(tile), "--crs", "EPSG:28992", "--outside", str(given), "--edges"]
    assert main([*reported, "--across", "1", "--down", "1", "--out", str(tmp_path / "sheets")]) == 0
    lines = (tmp_path / "sheets" / "sheets.md").read_text(encoding="utf-8").splitlines()[2:]
    outside = {model.source_id or model.building_id for model in models[1:]}
    assert {line.split("|")[2].strip() for line in lines} == outside
    assert len(list((tmp_path / "sheets").glob("*.png"))) == len(lines) > 1
