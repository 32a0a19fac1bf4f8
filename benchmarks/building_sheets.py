"""Contact sheets of models over their points, for checking buildings by eye.

    python -m benchmarks.building_sheets RUN [RUN ...] --points TILE [TILE ...] --out DIR [--crs CRS] [--most 200]
        [--outside FOOTPRINTS] [--edges] [--across 4] [--down 3]

Every building is one cell: its points in plan by height, then the model of each run with the points over it, coloured
by their distance to the roof (`report.section`). The share of its points within 0.2 m is below. If there
are more buildings than `--most`, every k-th in the order of their ids is drawn: results do not influence the choice.
`--outside` leaves out buildings that meet a polygon of a vector file in the CRS of the points; `--edges` draws the
edges of the first run's faces into the plan, where no wall hides them. `sheets.md` in DIR lists the cells, for notes.
"""

from __future__ import annotations

import argparse
import io
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from PIL import Image, ImageDraw

from pipeline.io import ReadOptions
from pipeline.io.vector_layer import read_layer
from pipeline.model import FloatArray
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.report.comparison_pictures import LOW_M, BuildingPictures, draw_building
from pipeline.ruler.report.comparison_points import PointFiles, points_within

COLUMNS, ROWS = 4, 3
"""Buildings across and down a sheet, where nothing else is asked."""
_TEXT_PX = 26
_WITHIN_M = 0.2
_REACH_M = 0.3


def within_share(model: RoofModel | None, xyz: FloatArray) -> float:
    """Share of the points above the floor that lie within 0.2 m of the roof; nan without points."""
    if model is None or not model.surfaces or not model.solids:
        return math.nan
    floor_m = min(float(solid.vertices[:, 2].min()) for solid in model.solids) + model.solid_origin[2]
    high = xyz[xyz[:, 2] > floor_m + LOW_M]
    if len(high) == 0:
        return math.nan
    return float(np.mean(np.abs(high[:, 2] - model.top(high[:, 0], high[:, 1])) <= _WITHIN_M))


def cell(pictures: BuildingPictures, reported: Sequence[str]) -> Image.Image:
    """The pictures of one building side by side, with a line of text under each."""
    drawn = [pictures.plan, *pictures.views]
    image = Image.new("RGB", (pictures.width_px * len(drawn), pictures.height_px + _TEXT_PX), "white")
    pen = ImageDraw.Draw(image)
    for column, (png, words) in enumerate(zip(drawn, reported, strict=True)):
        if png is not None:
            picture = Image.open(io.BytesIO(png)).convert("RGBA")
            image.paste(picture, (column * pictures.width_px, 0), picture)
        pen.text((column * pictures.width_px + 6, pictures.height_px + 4), words, fill="black", font_size=18)
    return image


def sheet(cells: Sequence[Image.Image], across: int = COLUMNS) -> Image.Image:
    """The cells in rows of `across`, each row as high as its highest cell."""
    rows = [cells[k : k + across] for k in range(0, len(cells), across)]
    width = max(sum(image.width for image in row) for row in rows)
    heights = [max(image.height for image in row) for row in rows]
    whole = Image.new("RGB", (width, sum(heights)), "white")
    y = 0
    for row, height in zip(rows, heights, strict=True):
        x = 0
        for image in row:
            whole.paste(image, (x, y))
            x += image.width
        y += height
    return whole


def _models(run: str) -> dict[str, RoofModel]:
    found = read_models(run)
    return {model.source_id or model.building_id: model for model in found.models}


def _outside(names: Sequence[str], models: Sequence[dict[str, RoofModel]], path: Path) -> list[str]:
    """The buildings that meet no polygon of a vector file in any run."""
    taken = shapely.union_all(read_layer(path, None).geometries)
    shapely.prepare(taken)
    return [name for name in names if not any(taken.intersects(own[name].footprint) for own in models if name in own)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the sheets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run directories of the same points")
    parser.add_argument("--points", nargs="+", required=True, metavar="TILE")
    parser.add_argument("--crs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--most", type=int, default=200)
    parser.add_argument("--outside", type=Path, metavar="FOOTPRINTS")
    parser.add_argument("--edges", action="store_true")
    parser.add_argument("--across", type=int, default=COLUMNS)
    parser.add_argument("--down", type=int, default=ROWS)
    asked = parser.parse_args(arguments)
    models = [_models(run) for run in asked.runs]
    names = sorted(set().union(*models))
    if asked.outside is not None:
        names = _outside(names, models, asked.outside)
    chosen = names[:: max(1, math.ceil(len(names) / asked.most))]
    footprints = [
        shapely.union_all([own[name].footprint for own in models if name in own]).buffer(_REACH_M, join_style="mitre")
        for name in chosen
    ]
    files = PointFiles(paths=tuple(asked.points), options=ReadOptions(crs=asked.crs))
    points = points_within(files, footprints)
    asked.out.mkdir(parents=True, exist_ok=True)
    lines = ["| cell | building | " + " | ".join(Path(run).name for run in asked.runs) + " |"]
    lines.append("| --- | --- |" + " --- |" * len(models))
    on_sheet = asked.across * asked.down
    for first in range(0, len(chosen), on_sheet):
        cells = []
        for number in range(first, min(first + on_sheet, len(chosen))):
            name, xyz = chosen[number], points[number]
            own = [each.get(name) for each in models]
            shares = [within_share(model, xyz) for model in own]
            faces = [0 if model is None else len(model.surfaces) for model in own]
            reported = [f"{share:.2f}, {count} faces" for share, count in zip(shares, faces, strict=True)]
            pictures = draw_building(own, own[0] if asked.edges else None, xyz)
            cells.append(cell(pictures, [f"{number + 1}: {name[:20]}", *reported]))
            lines.append(f"| {number + 1} | {name} | " + " | ".join(reported) + " |")
        sheet(cells, asked.across).save(asked.out / f"sheet_{first // on_sheet + 1:02d}.png")
    (asked.out / "sheets.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print(f"{len(chosen)} of {len(names)} buildings on {math.ceil(len(chosen) / on_sheet)} sheets in {asked.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
