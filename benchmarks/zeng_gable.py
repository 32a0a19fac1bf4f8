"""Zeng's gable, step by step, on one building of a tile.

    python -m benchmarks.zeng_gable TILE --out steps.png [--crs EPSG:n]

The candidates of the tile are found as a run finds them. The building is picked by a rule, not by hand: of those that
`kmeans` with its default settings calls a gable, with `--least-area` to `--most-area` m2 of footprint, a compact model
(its ridge at most `--most-elongated` times as long as the model is wide) whose sides both have at least `--least-slope`
degrees, the one that the faithful model fits best (least root mean square residual of all its points). Its steps are
drawn in the order of the paper's figures 3 to 7: the two clusters of points, the fitted planes with their convex hulls,
the rectangles before and after symmetry, the model over its points. Its fifteen parameters (absolute coordinates) and
its residuals are printed.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.candidates import candidates_of
from pipeline.geometry import vertical_residuals_m
from pipeline.methods import METHODS, ReconstructSettings
from pipeline.methods.kmeans import BuildingTop, building_top, planes_of, sides_of
from pipeline.methods.settings import KMeansSettings
from pipeline.model import BuildingResult, Candidate, FloatArray, LabelArray, Plane, RoofType
from pipeline.prepared_cloud import prepare_cloud
from pipeline.recipe import reconstruct_building
from pipeline.report.perspective import VIEW_SUN, View, ViewedFace, draw_view, projected
from pipeline.report.pictures import png_of
from pipeline.roof.primitives import GableFit, fit_gable
from pipeline.segmentation.plane_refinement import describe_planes
from pipeline.settings import RunSettings

SIDES = ("#c2552d", "#2f6f9f")
"""Colours of the two planes."""
VIEW_ALTITUDE_DEG = 38.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Steps:
    """All that the faithful recipe finds on its way, about an origin of the building's own."""

    candidate: Candidate
    """The building."""
    shift: FloatArray
    """(3,) the origin, about that of the candidate."""
    top: BuildingTop
    """Its points."""
    labels: LabelArray
    """Cluster of each, 0 or 1; -1 for none."""
    planes: tuple[Plane, ...]
    """The two best-fit planes."""
    fit: GableFit
    """From them to the model."""


def steps_of(candidate: Candidate) -> Steps:
    """The faithful recipe once more, keeping what it finds."""
    settings = KMeansSettings.faithful()
    cloud = prepare_cloud(candidate)
    top = building_top(cloud, settings)
    planes, labels = planes_of(top, settings)
    described = describe_planes(top.points, planes, labels)
    fit = fit_gable(
        top.points, labels, (described[0], described[1]), cloud.ground_z_m, min_side_share=settings.min_side_share
    )
    return Steps(candidate=candidate, shift=cloud.shift_m, top=top, labels=labels, planes=described, fit=fit)


def picked(candidates: Iterator[Candidate], arguments: argparse.Namespace) -> tuple[Steps, BuildingResult] | None:
    """The building of the rule, with its faithful model; None where there is none."""
    best: tuple[float, str, Candidate, BuildingResult] | None = None
    for candidate in candidates:
        robust = reconstruct_building(candidate, "kmeans", ReconstructSettings())
        if robust.roof_type is not RoofType.GABLE or not robust.status.has_roof or robust.footprint is None:
            continue
        if not arguments.min_area <= robust.footprint.area <= arguments.most_area:
            continue
        faithful = ReconstructSettings(method=METHODS["kmeans"].preset("faithful"))
        result = reconstruct_building(candidate, "kmeans", faithful)
        if not result.status.has_roof or result.roof_type is not RoofType.GABLE:
            continue
        if min(plane.slope_deg for plane in result.planes) < arguments.min_slope:
            continue
        sides = steps_of(candidate).fit.symmetric
        if sides[0].length_m > arguments.most_elongated * 2.0 * sides[0].width_m:
            continue
        if best is None or (result.rmse_m, candidate.building_id) < best[:2]:
            best = (result.rmse_m, candidate.building_id, candidate, result)
    return None if best is None else (steps_of(best[2]), best[3])


def report(steps: Steps, result: BuildingResult) -> str:
    """Parameters and residuals, a line each."""
    model, fit = steps.fit.model, steps.fit
    origin = steps.shift + np.array(steps.candidate.origin)
    spans = fit.rectangles
    own = _residuals(steps)
    lines = [f"building {steps.candidate.building_id}: {len(steps.candidate.points)} points, {len(own)} of them on top"]
    for name, plane in zip(("I", "II"), steps.planes, strict=True):
        lines.append(
            f"plane {name}: {plane.n_points} points, slope {plane.slope_deg:.1f} degrees, "
            f"aspect {plane.aspect_deg:.1f}, rmse {plane.rmse_m:.3f} m"
        )
    lines.append(
        f"rectangles: {spans[0].length_m:.2f} x {spans[0].width_m:.2f} m and {spans[1].length_m:.2f} x "
        f"{spans[1].width_m:.2f} m, made {fit.symmetric[0].length_m:.2f} x {fit.symmetric[0].width_m:.2f} m"
    )
    lines.append(f"eaves {fit.eave_z_m[0] + origin[2]:.3f} and {fit.eave_z_m[1] + origin[2]:.3f} m, their mean is z3")
    axis = {"x": 0, "y": 1, "z": 2}
    lines.extend(f"{name:>3} {value + origin[axis[name[0]]]:.3f}" for name, value in model.parameters.items())
    lines.append(
        f"residuals of the points on top to the model: rmse {math.sqrt(float(np.mean(own**2))):.3f} m, "
        f"median {np.median(np.abs(own)):.3f} m, 95 % within {np.percentile(np.abs(own), 95):.3f} m"
    )
    lines.append(f"the record: rmse {result.rmse_m:.3f} m, p95 {result.p95_m:.3f} m, coverage {result.coverage:.3f}")
    return "\n".join(lines)


def draw(steps: Steps) -> Figure:
    """The four steps."""
    figure = Figure(figsize=(10.5, 7.6), dpi=100, facecolor="white")
    # the eye stands beside the ridge, so that both sides are seen, and on the side from which light comes
    u, v = steps.fit.line.direction
    azimuth = math.degrees(math.atan2(u, v)) + 30.0
    away = abs((azimuth - VIEW_SUN[0] + 180.0) % 360.0 - 180.0) > 90.0
    view = View(azimuth_deg=(azimuth + 180.0 * away) % 360.0, altitude_deg=VIEW_ALTITUDE_DEG)
    titles = (
        "k-means of the normals: two sets of points",
        "least squares: planes and convex hulls",
        "minimal rectangles on the line of intersection,\nboth made equal by the larger one",
        "ten vertices over the points",
    )
    boxes = ((0.0, 0.48, 0.5, 0.44), (0.5, 0.48, 0.5, 0.44), (0.03, 0.02, 0.44, 0.37), (0.5, 0.0, 0.5, 0.42))
    panels = [figure.add_axes(box) for box in boxes]
    for title, axes, (left, low, width, height) in zip(titles, panels, boxes, strict=True):
        axes.set_axis_off()
        figure.text(left + width / 2, low + height + 0.015, title, ha="center", va="bottom", fontsize=11)
    _draw_points(panels[0], steps, view)
    _draw_hulls(panels[1], steps, view)
    _draw_rectangles(panels[2], steps)
    _draw_model(panels[3], steps, view)
    for axes in panels:
        axes.set_aspect("equal")
        axes.autoscale_view()
        axes.margins(0.06)
    return figure


def _residuals(steps: Steps) -> FloatArray:
    """Height of the points on top over the model."""
    labels = sides_of(steps.fit.model, steps.top.points, math.inf)
    both = np.stack([vertical_residuals_m(steps.top.points, plane.coefficients) for plane in steps.fit.model.planes])
    return np.asarray(both[labels, np.arange(labels.size)])


def _dots(axes: Axes, xy: FloatArray, labels: LabelArray, size: float) -> None:
    """Points in the colour of their plane."""
    for label, colour in ((-1, "#999999"), (0, SIDES[0]), (1, SIDES[1])):
        chosen = xy[labels == label]
        axes.scatter(chosen[:, 0], chosen[:, 1], s=size, color=colour, linewidths=0.0, zorder=4)


def _ring(axes: Axes, xy: FloatArray, colour: str, fill: float, width: float, style: str = "-") -> None:
    """A closed ring."""
    closed = np.vstack([xy, xy[:1]])
    axes.fill(closed[:, 0], closed[:, 1], color=colour, alpha=fill, linewidth=0.0, zorder=1)
    axes.plot(closed[:, 0], closed[:, 1], color=colour, linewidth=width, linestyle=style, zorder=3)


def _draw_points(axes: Axes, steps: Steps, view: View) -> None:
    """Figure 3."""
    _dots(axes, projected(steps.top.points, view), steps.labels, 14.0)


def _draw_hulls(axes: Axes, steps: Steps, view: View) -> None:
    """Figure 4."""
    _dots(axes, projected(steps.top.points, view), steps.labels, 5.0)
    for plane, hull, colour in zip(steps.planes, steps.fit.hulls, SIDES, strict=True):
        z = plane.a * hull[:, 0] + plane.b * hull[:, 1] + plane.c
        _ring(axes, projected(np.column_stack([hull, z]), view), colour, 0.25, 1.4)


def _draw_rectangles(axes: Axes, steps: Steps) -> None:
    """Figures 5 and 6, from above."""
    _dots(axes, steps.top.points[:, :2], steps.labels, 5.0)
    fit = steps.fit
    for hull, before, after, colour in zip(fit.hulls, fit.rectangles, fit.symmetric, SIDES, strict=True):
        _ring(axes, hull, colour, 0.15, 0.7)
        _ring(axes, np.array(before.corners), colour, 0.0, 1.1, "--")
        _ring(axes, np.array(after.corners), colour, 0.0, 1.9)


def _draw_model(axes: Axes, steps: Steps, view: View) -> None:
    """Figure 7."""
    model = steps.fit.model
    v = model.vertices
    faces = [
        ViewedFace(rings=(v[[2, 3, 1, 0]],), colour=SIDES[0]),
        ViewedFace(rings=(v[[4, 5, 0, 1]],), colour=SIDES[1]),
        ViewedFace(rings=(v[[6, 7, 3, 2]],), colour="#e8e2d2"),
        ViewedFace(rings=(v[[8, 9, 5, 4]],), colour="#e8e2d2"),
        ViewedFace(rings=(v[[7, 8, 4, 1, 3]],), colour="#e8e2d2"),
        ViewedFace(rings=(v[[9, 6, 2, 0, 5]],), colour="#e8e2d2"),
    ]
    draw_view(axes, [faces], view, shadows=False)
    xy = projected(steps.top.points, view)
    axes.scatter(xy[:, 0], xy[:, 1], s=4.0, color="#222222", linewidths=0.0, zorder=5)
    for number, (x, y) in enumerate(projected(v, view).tolist(), start=1):
        axes.annotate(str(number), (x, y), fontsize=9, zorder=6, ha="center", va="center",
                      bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "linewidth": 0.5})  # fmt: skip


def main() -> int:
    """Pick, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tile", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="the PNG to write")
    parser.add_argument("--crs", help="of the tile, where its header has none")
    parser.add_argument("--least-area", type=float, default=60.0)
    parser.add_argument("--most-area", type=float, default=250.0)
    parser.add_argument("--most-elongated", type=float, default=2.5)
    parser.add_argument("--least-slope", type=float, default=15.0)
    arguments = parser.parse_args()
    found = picked(candidates_of((str(arguments.tile),), arguments.crs, RunSettings()), arguments)
    if found is None:
        print(f"no building of {arguments.tile} meets the rule", file=sys.stderr)
        return 1
    print(report(*found))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_bytes(png_of(draw(found[0])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
