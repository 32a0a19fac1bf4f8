"""Two pictures of Fuzzy SART: the results of its claims, and its steps on one simulated building.

    python -m benchmarks.fuzzy_sart_picture --out docs/methods/pictures/fuzzy_sart.png

draws the steps: TIN with absorption, clusters of facets, refined planes, model. `draw_claims` is the figure of
`benchmarks/fuzzy_sart_claims.py`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from benchmarks.fuzzy_sart_probe import Observed, observe, strewn
from benchmarks.fuzzy_sart_roofs import SyntheticRoof
from pipeline.geometry import facet_normals
from pipeline.methods import ReconstructSettings
from pipeline.methods.settings import FuzzySartSettings
from pipeline.model import FaceKind, FloatArray, LabelArray, Solid
from pipeline.recipe import reconstruct_building
from pipeline.report.perspective import View, ViewedFace, draw_view
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape

mpl.use("Agg")
import matplotlib.pyplot as plt

PALETTE = ("#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#b07aa1", "#edc948", "#76b7b2", "#9c755f", "#ff9da7")
NO_PLANE = "#c8c8c8"
COLOURS = {"none": "#b03a2e", "bucket": "#1f618d", "insert": "#239b56"}


def draw_claims(found: Mapping[str, Sequence[Any]], path: Path) -> None:
    """Curves with intervals over the tables of the claims; what was not measured stays empty.

    Parameters
    ----------
    found : mapping of str to sequence of Table
        Chapters of `benchmarks.fuzzy_sart_claims`.
    path : Path
        PNG to write.
    """
    figure, axes = plt.subplots(1, 4, figsize=(17.0, 4.2), layout="constrained")
    if "absorption" in found:
        _absorption(axes[0], axes[1], found["absorption"])
    if "translation" in found:
        _translation(axes[2], found["translation"])
    if "product" in found:
        _product(axes[3], found["product"][0].rows)
    for axis in axes[1:]:
        axis.set_ylim(-3.0, 103.0)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _curve(axis: Any, places: Sequence[float], reported: Sequence[Any], **style: Any) -> None:
    """A line through figures, with their intervals."""
    values = [one.value for one in reported]
    ends = [[max(0.0, one.value - one.low) for one in reported], [max(0.0, one.high - one.value) for one in reported]]
    axis.errorbar(places, values, yerr=ends, capsize=2.5, lw=1.4, elinewidth=0.7, **style)


def _absorption(left: Any, right: Any, tables: Sequence[Any]) -> None:
    rows = [row for row in tables[1].rows if row[0] == "0.77"]  # the preset faithful, by survey
    for way, colour in COLOURS.items():
        mine = [row for row in rows if row[2] == way]
        noises = [float(row[1]) for row in mine]
        _curve(left, noises, [row[3] for row in mine], color=colour, marker="o", label=way)
        _curve(right, noises, [row[6] for row in mine], color=colour, marker="o", label=f"{way}, faithful")
    rows = [row for row in tables[0].rows if row[0] == "0.77"]
    for way, colour in COLOURS.items():
        mine = [row for row in rows if row[2] == way]
        noises = [float(row[1]) for row in mine]
        _curve(right, noises, [row[6] for row in mine], color=colour, ls=":", marker="s", label=f"{way}, robust")
    left.set(title="absorption: error of the normals", xlabel="noise, m", ylabel="deg", ylim=(0.0, None))
    right.set(title="absorption: roofs all right at the end, %", xlabel="noise, m")
    left.legend(frameon=False)
    right.legend(frameon=False, fontsize=8)


def _translation(axis: Any, tables: Sequence[Any]) -> None:
    places = ["centred", "roof alone", "corner", "100 m", "1 km", "10 km"]
    for kind, colour in (("footpoint", "#1f618d"), ("spherical_scaled", "#b9770e")):
        mine = [row for row in tables[2].rows if row[0] == kind]
        name = kind.replace("_", " ")
        _curve(axis, range(6), [row[2] for row in mine], color=colour, marker="o", label=f"{name}: one plane")
        _curve(axis, range(6), [row[3] for row in mine], color=colour, marker="v", ls="--", label="two planes")
        _curve(axis, range(6), [row[6] for row in mine], color=colour, marker="s", ls=":", label="roofs all right")
    axis.set_xticks(range(6), places, fontsize=8)
    axis.set(title="translation, faithful: pairs that match, %")
    axis.legend(frameon=False, fontsize=7, ncols=2, loc="center", bbox_to_anchor=(0.5, 0.40))


def _product(axis: Any, rows: Sequence[Sequence[Any]]) -> None:
    for kind, colour in (("large", "#1f618d"), ("small", "#b03a2e")):
        for preset, line in (("robust", "-"), ("faithful", "--")):
            mine = [row for row in rows if row[0] == kind and row[1] == preset]
            densities = [float(row[2]) for row in mine]
            name = f"{kind}, {preset}"
            _curve(axis, densities, [row[5] for row in mine], color=colour, ls=line, marker="o", label=name)
    axis.set_xscale("log")
    axis.set_xticks([0.7, 2.0, 8.0], ["0.7", "2", "8"])
    axis.minorticks_off()
    axis.set(title="whole product: all planes right, %", xlabel="pulses per m2")
    axis.legend(frameon=False, loc="lower right")


def house(seed: int) -> SyntheticRoof:
    """The building of the steps: an L of two gables, 4 points per m2, 0.05 m of noise, of the dev seeds."""
    size = RoofDimensions(length_m=15.0, width_m=9.0, pitch_deg=35.0, wing_length_m=6.0, wing_width_m=7.0)
    return strewn("house", RoofShape.L_SHAPE, size, 4.0, 0.05, np.random.default_rng(seed))


def draw_steps(path: Path, seed: int = 1_004) -> None:
    """TIN, clusters, refined planes and model of one building, each in its own panel.

    Parameters
    ----------
    path : Path
        PNG to write.
    """
    roof, settings = house(seed), FuzzySartSettings()
    seen = observe(roof.candidate, settings)
    result = reconstruct_building(roof.candidate, "fuzzy-sart", ReconstructSettings(method=settings))
    figure, axes = plt.subplots(1, 4, figsize=(12.4, 3.5), layout="constrained")
    shift = roof.candidate.points[0] - seen.points[0]
    _draw_tin(axes[0], seen)
    _draw_clusters(axes[1], seen)
    _draw_planes(axes[2], roof.candidate.points, seen.final.labels, result.solids)
    _draw_model(axes[3], result.solids)
    low, high = roof.candidate.points[:, :2].min(axis=0), roof.candidate.points[:, :2].max(axis=0)
    for axis in axes[:2]:
        axis.set_xlim(low[0] - shift[0] - 0.6, high[0] - shift[0] + 0.6)
        axis.set_ylim(low[1] - shift[1] - 0.6, high[1] - shift[1] + 0.6)
    n_clusters = len(np.unique(seen.facet_clusters[seen.facet_clusters >= 0]))
    inserted = int((seen.vertex_point[seen.vertex_point >= 0] < len(roof.labels)).sum())
    titles = (
        f"TIN: {inserted} of {len(roof.labels)} points inserted",
        f"{n_clusters} clusters that hang together",
        f"{len(seen.final.planes)} planes, straight ridges",
        "model",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=10)
        axis.set_aspect("equal")
        axis.axis("off")
    figure.savefig(path, dpi=84, pil_kwargs={"optimize": True})
    plt.close(figure)


def _draw_tin(axis: Any, seen: Observed) -> None:
    """Facets in relief, and the points that they absorbed."""
    light = np.array([-0.5, 0.5, 0.7])
    shade = 0.35 + 0.6 * np.clip(facet_normals(seen.vertices, seen.facets) @ (light / np.linalg.norm(light)), 0.0, 1.0)
    x, y = seen.vertices[:, 0], seen.vertices[:, 1]
    axis.tripcolor(x, y, seen.facets, facecolors=shade, cmap="gray", vmin=0.0, vmax=1.0, edgecolors="#33333366", lw=0.4)
    absorbed = np.setdiff1d(np.arange(len(seen.points)), seen.vertex_point)
    axis.plot(seen.points[absorbed, 0], seen.points[absorbed, 1], ".", ms=1.6, color="#b03a2e")


def _draw_clusters(axis: Any, seen: Observed) -> None:
    """Facets in the colour of their cluster, the larger ones first."""
    used = seen.facet_clusters >= 0
    x, y = seen.vertices[:, 0], seen.vertices[:, 1]
    numbers, counts = np.unique(seen.facet_clusters[used], return_counts=True)
    rank = {int(number): k for k, number in enumerate(numbers[np.argsort(-counts, kind="stable")])}
    colours = np.array([rank[int(one)] % len(PALETTE) for one in seen.facet_clusters[used]], dtype=float)
    cmap = mpl.colors.ListedColormap(PALETTE)
    axis.tripcolor(
        x, y, seen.facets[used], facecolors=colours, cmap=cmap, vmin=0, vmax=len(PALETTE) - 1,
        edgecolors="#ffffff88", lw=0.3,
    )  # fmt: skip


def _draw_planes(axis: Any, points: FloatArray, labels: LabelArray, solids: Sequence[Solid]) -> None:
    """Points in the colour of their plane, under the edges of the model's roof."""
    colours = [PALETTE[label % len(PALETTE)] if label >= 0 else NO_PLANE for label in labels]
    axis.scatter(points[:, 0], points[:, 1], c=colours, s=3.5, lw=0)
    for solid in solids:
        for face in solid.faces:
            if face.kind is FaceKind.ROOF:
                for ring in face.rings:
                    around = solid.vertices[[*ring, ring[0]]]
                    axis.plot(around[:, 0], around[:, 1], color="#222222", lw=1.0)


def _draw_model(axis: Any, solids: Sequence[Solid]) -> None:
    """The solids from a bird's eye."""
    viewed = [
        [
            ViewedFace(
                rings=tuple(solid.vertices[list(ring)] for ring in face.rings),
                colour=PALETTE[face.plane % len(PALETTE)] if face.kind is FaceKind.ROOF else "#e8e4da",
            )
            for face in solid.faces
        ]
        for solid in solids
    ]
    draw_view(axis, viewed, View(azimuth_deg=150.0))


def main() -> None:
    """Draw the steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    draw_steps(given.out)


if __name__ == "__main__":
    main()
