"""Draws the parameter space of one simulated gable: its facets, their clusters, and the building primitive.

Run it as ``python -m benchmarks.parameter_space_pictures --out docs/methods/pictures/parameter_space.png``.
"""

from __future__ import annotations

import argparse
from typing import cast

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from benchmarks.fuzzy_sart_roofs import FIRST_SEED, simulate_roof
from pipeline.methods import ReconstructSettings
from pipeline.methods.parameter_space import facets_of, roof_clusters_3d
from pipeline.methods.settings import ParameterSpace3dSettings
from pipeline.model import Candidate, FaceKind, FloatArray, LabelArray
from pipeline.prepared_cloud import prepare_cloud
from pipeline.recipe import reconstruct_building

COLOURS = np.array(["#c0392b", "#2471a3", "#229954", "#b7950b", "#7d3c98", "#ca6f1e"])
OTHER = "#b8bcc0"
DENSITY_PER_M2, NOISE_M = 0.7, 0.06


def draw(candidate: Candidate, path: str) -> None:
    """Four panels: TIN in plan, slope over orientation, O-distance over orientation, the primitive.

    Parameters
    ----------
    candidate : Candidate
        One building.
    path : str
        The PNG file to write.
    """
    settings = ParameterSpace3dSettings.faithful()
    facets = facets_of(prepare_cloud(candidate), settings)
    labels, centres = roof_clusters_3d(facets, settings)
    colours = np.append(COLOURS[np.arange(labels.max() + 1) % len(COLOURS)], OTHER)[labels]
    figure = plt.figure(figsize=(9, 7))
    plan = figure.add_subplot(2, 2, 1)
    plan.add_collection(
        PolyCollection(list(facets.vertices[facets.tin.facets][..., :2]), facecolors=colours, edgecolors="w", lw=0.3)
    )
    plan.set(title="TIN about its barycentre", xlabel="easting (m)", ylabel="northing (m)", aspect="equal")
    plan.autoscale_view()
    _panel(figure.add_subplot(2, 2, 2), facets.parameters, labels, colours, centres, 0, "slope (degrees)")
    _panel(figure.add_subplot(2, 2, 3), facets.parameters, labels, colours, centres, 2, "O-distance (m)")
    _primitive(cast("Axes3D", figure.add_subplot(2, 2, 4, projection="3d")), candidate)
    figure.tight_layout()
    figure.savefig(path, dpi=88)
    plt.close(figure)


def _panel(
    axes: Axes,
    parameters: FloatArray,
    labels: LabelArray,
    colours: FloatArray,
    centres: FloatArray,
    row: int,
    name: str,
) -> None:
    """One parameter over orientation; crosses mark the centres of the clusters."""
    for members, alpha in ((labels < 0, 0.7), (labels >= 0, 1.0)):
        axes.scatter(parameters[members, 1], parameters[members, row], s=7, c=colours[members], alpha=alpha, lw=0)
    axes.plot(centres[:, 1], centres[:, row], "k+", ms=13, mew=1.6)
    axes.set(
        xlim=(0, 360), xlabel="orientation (degrees)", ylabel=name, title=f"{name.partition(' (')[0]} over orientation"
    )
    axes.set_xticks(range(0, 361, 60))
    axes.grid(alpha=0.25)


def _primitive(axes: Axes3D, candidate: Candidate) -> None:
    """The closed model, after Figure 5-1 of the paper."""
    settings = ReconstructSettings(method=ParameterSpace3dSettings.faithful())
    result = reconstruct_building(candidate, "parameter-space-3d", settings)
    for solid in result.solids:
        for face in solid.faces:
            colour = COLOURS[face.plane % len(COLOURS)] if face.kind is FaceKind.ROOF else "#e8e6e1"
            ring = solid.vertices[list(face.rings[0])]
            axes.add_collection(Poly3DCollection([ring], facecolors=colour, edgecolors="#444444", lw=0.6, alpha=0.95))
    low, high = candidate.points.min(axis=0), candidate.points.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(candidate.ground_z_m, high[2]))
    axes.set_box_aspect((*(high - low)[:2], high[2] - candidate.ground_z_m))
    # a little beside the direction of the ridge: azimuths run counter-clockwise from east
    axes.view_init(elev=38, azim=-result.planes[0].aspect_deg + 30.0)
    axes.set_axis_off()
    axes.set_title(f"building primitive: {result.roof_type.value}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", required=True, help="the PNG file to write")
    parser.add_argument("--building", type=int, default=2, help="number of the roof among the dev seeds")
    options = parser.parse_args()
    seed = FIRST_SEED["dev"] + options.building
    draw(simulate_roof("gable", DENSITY_PER_M2, NOISE_M, seed, pitch_deg=35.0).candidate, options.out)


if __name__ == "__main__":
    main()
