"""A map and a view of party walls.

    python benchmarks/party_walls_picture.py walls.parquet areas.parquet RUN picture.png [x_min y_min x_max y_max]

takes the two files that `gablework party-walls` wrote, the run, and a window in units of its CRS.
"""

from __future__ import annotations

import sys

import numpy as np
import pyarrow.parquet as pq
import shapely
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from pipeline.export.geoparquet import read_table
from pipeline.report.pictures import paths_of

SHARED = "#d62728"


def geometries(values: list[bytes | None]) -> np.ndarray:
    """WKB as an array of shapes."""
    return shapely.from_wkb(np.array([*values, None], dtype=object)[:-1])


def main(walls: str, areas: str, run: str, picture: str, *window: str) -> None:
    """Draw the map and the view side by side."""
    touching, buildings = pq.read_table(walls), pq.read_table(areas)
    shared, footprints = (geometries(table["geometry"].to_pylist()) for table in (touching, buildings))
    solids = geometries(read_table(run, "buildings")["solid"].drop_null().to_pylist())
    box = np.array([float(edge) for edge in window] or shapely.total_bounds(footprints))
    inside = shapely.box(*box)
    figure = Figure(figsize=(16, 7), dpi=80)
    axes = figure.add_subplot(1, 2, 1)
    shown = shapely.intersects(footprints, inside)
    whole, part = (
        np.array(buildings[name].to_pylist(), float)[shown] for name in ("wall_area_m2", "shared_wall_area_m2")
    )
    scale = ScalarMappable(Normalize(0.0, 0.8), "YlGnBu")
    parts, of = shapely.get_parts(footprints[shown], return_index=True)
    colours = scale.to_rgba(part / whole)[of]
    axes.add_collection(PathCollection(paths_of(parts), facecolors=colours, edgecolors="black", linewidths=0.3))
    lines = [shapely.get_coordinates(face) for face in shapely.get_parts(shared[shapely.intersects(shared, inside)])]
    axes.add_collection(LineCollection(lines, colors=SHARED, linewidths=2.0))
    axes.set(xlim=box[[0, 2]], ylim=box[[1, 3]], aspect="equal", xticks=[], yticks=[])
    axes.set_title("share of walls in contact")
    figure.colorbar(scale, ax=axes, shrink=0.6)
    view = figure.add_subplot(1, 2, 2, projection="3d")
    faces = shapely.get_parts(solids[shapely.intersects(shapely.envelope(solids), inside)])
    for some, colour, alpha in ((faces, "#9aa5b1", 0.12), (shapely.get_parts(shared), SHARED, 0.9)):
        corners = [shapely.get_coordinates(shapely.get_exterior_ring(face), include_z=True) for face in some]
        near = [ring for ring in corners if inside.intersects(shapely.LineString(ring[:, :2]))]
        edge = "#55606b" if alpha < 0.5 else "black"
        view.add_collection3d(Poly3DCollection(near, facecolors=colour, edgecolors=edge, linewidths=0.2, alpha=alpha))
    z = shapely.get_coordinates(faces, include_z=True)[:, 2]
    view.set(xlim=box[[0, 2]], ylim=box[[1, 3]], zlim=(z.min(), z.max()))
    view.set_title("party walls", y=0.9)
    view.set_box_aspect((box[2] - box[0], box[3] - box[1], z.max() - z.min()), zoom=1.4)
    view.set_axis_off()
    view.view_init(elev=40, azim=-15)
    figure.tight_layout()
    figure.savefig(picture)


if __name__ == "__main__":
    main(*sys.argv[1:])
