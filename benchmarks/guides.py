"""How much given lines of roofs help, and how much wrong ones harm, on the shapes of `sweep` at few points.

    python -m benchmarks.guides --out DIR [--densities 0.5 1 2] [--split dev] [--cases none all ...]

Each cell of `sweep` (noise 0.05 m) is simulated once and modelled with guides of each case: none; all true edges of the
roofs in plan, with their kinds; only ridges and eaves; all with both ends disturbed by 0.3 m (standard deviation along
each axis); each shifted by 1.5 m in a direction of its own. Prints one line per density and case: correct roofs, faces
of all sizes (quality), IoU of the outlines with all models of a building (mean), the mean distance of places on true
ridges, and on all true edges within a roof, to the nearest edge within a model (3 m at most), the share of these places
within 0.1 m, and how many guides were followed of those that met a model.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.dataset as ds
import pyogrio.raw
import shapely
from shapely import LineString, Polygon

from benchmarks.entries import markdown_table
from pipeline.model import FloatArray, GuideKind
from pipeline.ruler.evaluation.files import EvaluationRequest, evaluate_files
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run

CASES = ("none", "all", "ridges and eaves", "0.3 m noise", "1.5 m off")
NOISE_M = 0.05
_SHORTEST_M = 0.3
_FARTHEST_M = 3.0

Lines = list[tuple[GuideKind, LineString]]


def faces_of(run_dir: Path) -> dict[str, list[Polygon]]:
    """The roof faces of the buildings of a run, 3D."""
    faces: dict[str, list[Polygon]] = {}
    for row in ds.dataset(run_dir / "planes", partitioning="hive").to_table().to_pylist():
        faces.setdefault(row["building_id"], []).extend(shapely.get_parts(shapely.from_wkb(row["geometry"])).tolist())
    return faces


def plane_of(face: Polygon) -> FloatArray:
    """Coefficients a, b, c of z = a x + b y + c."""
    xyz = shapely.get_coordinates(face, include_z=True)
    middle = xyz.mean(axis=0)
    off = xyz - middle
    (a, b), *_ = np.linalg.lstsq(off[:, :2], off[:, 2], rcond=None)
    return np.array([a, b, middle[2] - a * middle[0] - b * middle[1]])


def pieces(line: shapely.Geometry) -> list[LineString]:
    """The straight pieces of lines."""
    found = []
    for part in shapely.get_parts(shapely.line_merge(line) if "Multi" in line.geom_type else line).tolist():
        if isinstance(part, LineString):
            found += [LineString(ends) for ends in itertools.pairwise(shapely.get_coordinates(part).tolist())]
    return [piece for piece in found if piece.length >= _SHORTEST_M]


def lines_of(faces: Sequence[Polygon]) -> Lines:
    """The edges of a roof in plan by their kinds; eaves are all edges of its outline."""
    flat, planes = [shapely.force_2d(face) for face in faces], [plane_of(face) for face in faces]
    found: Lines = []
    for i, j in itertools.combinations(range(len(faces)), 2):
        for piece in pieces(shapely.intersection(flat[i].boundary, flat[j].boundary)):
            (x0, y0), (x1, y1) = piece.coords
            gap = float((planes[i] - planes[j]) @ (0.5 * (x0 + x1), 0.5 * (y0 + y1), 1.0))
            inside = flat[i].representative_point()
            kind = GuideKind.VALLEY
            if abs(gap) > 0.05:
                kind = GuideKind.STEP
            elif float((planes[i] - planes[j]) @ (inside.x, inside.y, 1.0)) <= 0.0:
                is_level = abs(float(planes[i][:2] @ (x1 - x0, y1 - y0))) < 0.05 * piece.length
                kind = GuideKind.RIDGE if is_level else GuideKind.HIP
            found.append((kind, piece))
    outline = shapely.simplify(shapely.union_all(flat, grid_size=1e-3).boundary, 0.01)
    return found + [(GuideKind.EAVE, piece) for piece in pieces(outline)]


def guides_of(case: str, true: Lines) -> Lines:
    """The guides of a case."""
    random = np.random.default_rng(5)
    if case == "ridges and eaves":
        return [(kind, line) for kind, line in true if kind in (GuideKind.RIDGE, GuideKind.EAVE)]
    if case == "0.3 m noise":
        return [
            (kind, shapely.transform(line, lambda xy: xy + random.normal(0.0, 0.3, xy.shape))) for kind, line in true
        ]
    if case == "1.5 m off":
        turns = random.uniform(0.0, 2.0 * math.pi, len(true))
        shifts = 1.5 * np.column_stack((np.cos(turns), np.sin(turns)))
        return [
            (kind, shapely.transform(line, lambda xy, by=by: xy + by))
            for (kind, line), by in zip(true, shifts, strict=True)
        ]
    return true


def inner_distances(models: Path, true: Lines, kinds: frozenset[GuideKind]) -> FloatArray:
    """Distances of places every 0.1 m on true lines to the nearest edge within a model, metres."""
    edges = []
    for faces in faces_of(models).values():
        flat = [shapely.force_2d(face) for face in faces]
        outline = shapely.buffer(shapely.union_all(flat, grid_size=1e-3).boundary, 0.03)
        inner = shapely.difference(shapely.union_all([face.boundary for face in flat], grid_size=1e-3), outline)
        edges += [part for part in shapely.get_parts(inner).tolist() if not part.is_empty]
    tree = shapely.STRtree(edges)
    places = np.concatenate(
        [
            shapely.line_interpolate_point(line, np.arange(0.05, line.length, 0.1))
            for kind, line in true
            if kind in kinds
        ]
    )
    distances = np.full(len(places), _FARTHEST_M)
    (at, _), near = tree.query_nearest(places, max_distance=_FARTHEST_M, return_distance=True, all_matches=False)
    distances[at] = near
    return distances


def measured(density: float, case: str, scene: Path, out: Path) -> list[str]:
    """A line of the table."""
    truth = scene / f"d{density:g}_n{NOISE_M:.2f}" / "truth"
    true = [line for faces in faces_of(truth).values() for line in lines_of(faces)]
    lines = guides_of(case, true)
    path = out / "guides.gpkg"
    path.unlink(missing_ok=True)
    pyogrio.raw.write(
        path,
        np.array([line.wkb for _, line in lines], object),
        field_data=[np.array([kind.value for kind, _ in lines], object)],
        fields=np.array(["kind"], object),
        crs="EPSG:25832",
        geometry_type="LineString",
    )
    models = out / "models"
    run(
        RunRequest(
            inputs=(str(truth.parent / "sweep.laz"),), out=str(models), resources=SERIAL, overwrite=True,
            guides=None if case == "none" else str(path), meshes="none",
        )
    )  # fmt: skip
    found = evaluate_files(EvaluationRequest(models=str(models), truth=str(truth)))
    values = {m.name: m.value for m in found.measures if m.subset == "all"}
    ridges = inner_distances(models, true, frozenset({GuideKind.RIDGE}))
    inner = inner_distances(models, true, frozenset(GuideKind) - {GuideKind.EAVE})
    rows = ds.dataset(models / "buildings", partitioning="hive").to_table().to_pylist()
    followed, others = (sum(row[f"guides_{name}followed"] or 0 for row in rows) for name in ("", "not_"))
    return [
        f"{density:g}",
        case,
        f"{100 * values['roof_types.correct']:.0f} %",
        f"{values['faces.quality_all']:.2f}",
        f"{values['footprints.iou_together_mean']:.3f}",
        f"{ridges.mean():.2f}",
        f"{inner.mean():.2f}",
        f"{100 * (inner <= 0.1).mean():.0f} %",
        f"{followed} of {followed + others}" if case != "none" else "",
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--densities", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for density in given.densities:
        scene = given.out / f"scene_{density:g}"
        simulate("sweep", scene, seed_of(given.split, 0), density_per_m2=density, noise_m=NOISE_M)
        for case in given.cases:
            rows.append(measured(density, case, scene, given.out))
            print(*rows[-1], sep=" | ", flush=True)
    heads = ["points/m2", "guides", "correct", "faces", "IoU", "ridges, m", "edges, m", "within 0.1 m", "followed"]
    print(markdown_table(heads, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
