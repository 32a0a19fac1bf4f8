"""A map of roof planes coloured by their solar energy and by their view of the sky.

    python benchmarks/solar_picture.py solar.parquet solar.png [x_min y_min x_max y_max]

takes the file that `gablework solar` wrote, and a window in units of its CRS.
"""

from __future__ import annotations

import sys

import numpy as np
import pyarrow.parquet as pq
import shapely
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from pipeline.report.pictures import paths_of

PANELS = (
    ("irradiation_kwh_m2", "irradiation in kWh per m² and year", "inferno"),
    ("sky_view", "sky view factor", "viridis"),
)


def main(table: str, picture: str, *window: str) -> None:
    """Draw the panels side by side."""
    rows = pq.read_table(table)
    faces = shapely.force_2d(shapely.from_wkb(np.array(rows["geometry"].to_pylist(), dtype=object)))
    box = np.array([float(edge) for edge in window] or shapely.total_bounds(faces))
    shown = shapely.intersects(faces, shapely.box(*box))
    figure = Figure(figsize=(16, 1 + 7.5 * (box[3] - box[1]) / (box[2] - box[0])), dpi=80)
    for axes, (name, title, colours) in zip(figure.subplots(1, 2), PANELS, strict=True):
        values = np.array(rows[name].to_pylist(), dtype=float)[shown]
        scale = ScalarMappable(Normalize(np.nanmin(values), np.nanmax(values)), colours)
        parts = shapely.get_parts(faces[shown], return_index=True)
        colour = scale.to_rgba(values[parts[1]])
        axes.add_collection(PathCollection(paths_of(parts[0]), facecolors=colour, edgecolors="black", linewidths=0.3))
        axes.set(xlim=box[[0, 2]], ylim=box[[1, 3]], aspect="equal", title=title, xticks=[], yticks=[])
        figure.colorbar(scale, ax=axes, shrink=0.8)
    figure.tight_layout()
    figure.savefig(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
