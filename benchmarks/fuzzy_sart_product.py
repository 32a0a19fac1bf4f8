"""Large simple buildings against small complex houses, scanned and reconstructed as a user would.

The paper's own limit: "performs fairly well on large buildings with simple roof structures", "unable to accurately
reconstruct small houses", which have "as much as 5 times the number of roof planes". One scene holds both; it is
scanned at each density, reconstructed with both presets (neither footprints nor classes are given), and measured by
the ruler against its truth.
"""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.fuzzy_sart_probe import LARGE, dimensions_of
from pipeline.ruler.evaluation.faces import MIN_FACE_AREA_M2
from pipeline.ruler.evaluation.files import EvaluationRequest, evaluate_files
from pipeline.ruler.simulation.als import ScannerSettings
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.plots import PlannedBuilding, packed_plots
from pipeline.ruler.simulation.scene import Scene, Terrain, place_building
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.suites import SUITES, Suite

Figure = TypeVar("Figure")
"""A share or a mean with its interval."""

SUITE = "large_and_small"
SMALL = ("hip", "l_shape", "t_shape", "cross", "half_hip with dormers")
LARGE_BUILDINGS, SMALL_OF_EACH = 60, 20
DENSITIES_PER_M2 = (0.7, 2.0, 8.0)
NOISE_M = 0.05
_STRIP_M = 300.0
_STRIPS = 2


def scene_of(seed: int, size_m: tuple[float, float]) -> Scene:
    """Large flat roofs and gables, and small houses of five shapes, on level ground; the size follows from them."""
    del size_m
    random = np.random.default_rng([seed, 0x1A26E])
    planned: list[PlannedBuilding] = []
    names: list[str] = []
    for kind in (LARGE, *SMALL):
        for draw in range(LARGE_BUILDINGS if kind == LARGE else SMALL_OF_EACH):
            shape, size = dimensions_of(kind, draw, random)
            azimuth = float(random.uniform(0.0, 360.0))
            planned.append(PlannedBuilding(shape=shape, dimensions=size, azimuth_deg=azimuth, margin_m=5.0))
            names.append(f"{'large' if kind == LARGE else 'small'}-{len(names):03d}")
    order = [int(k) for k in random.permutation(len(planned))]
    plots, extent = packed_plots([planned[k] for k in order], _STRIP_M, _STRIPS)
    terrain = Terrain(base_z_m=40.0)
    buildings = [
        place_building(
            names[k],
            planned[k].shape,
            planned[k].dimensions,
            at=(plot.x, plot.y),
            azimuth_deg=planned[k].azimuth_deg,
            eave_height_m=float(random.uniform(3.0, 7.0)),
            terrain=terrain,
        )
        for k, plot in zip(order, plots, strict=True)
    ]
    return Scene(
        name=SUITE,
        origin=(569_000.0, 5_938_000.0, 0.0),
        crs="EPSG:25832+7837",
        extent=(0.0, 0.0, *extent),
        terrain=terrain,
        buildings=tuple(buildings),
    )


SUITES[SUITE] = Suite(
    name=SUITE,
    summary="large simple buildings and small complex houses",
    make=scene_of,
    scanner=ScannerSettings(altitude_m=900.0, strip_spacing_m=_STRIP_M, strip_overlap=0.1, range_noise_m=NOISE_M),
    size_m=(_STRIPS * _STRIP_M, 600.0),
    seed=1,
    is_sized=False,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcomes:
    """What became of the buildings of one kind, one entry a building."""

    delivered: list[bool]
    """A model with its own roof stands for it."""
    all_right: list[bool]
    """All faces to be found are (10 m2 and 11 points), and no other face of 10 m2."""
    correct: list[bool]
    """The same, and the roof type."""
    faces: list[float]
    """Share of all its faces of at least 10 m2, however few points they have, that was found."""


def outcomes(run: Path, truth: Path) -> dict[str, Outcomes]:
    """Measure a run by the ruler; the large and the small."""
    found = evaluate_files(EvaluationRequest(models=str(run), truth=str(truth), as_surveyed=True))
    rows: list[dict[str, Any]] = found.tables["buildings"].to_pylist()
    faces_of: dict[str, list[bool]] = {}
    for face in found.tables["true_faces"].to_pylist():
        if face["area_m2"] >= MIN_FACE_AREA_M2:
            faces_of.setdefault(face["building_id"], []).append(bool(face["found"]))
    reported = {}
    for kind in ("large", "small"):
        mine = [row for row in rows if row["building_id"].startswith(kind)]
        faces = [faces_of.get(row["building_id"], []) for row in mine]
        reported[kind] = Outcomes(
            delivered=[row["model_status"] in {"ok", "doubtful"} for row in mine],
            all_right=[row["faces_found"] == row["faces_to_find"] and row["faces_wrong"] == 0 for row in mine],
            correct=[row["outcome"] == "correct" for row in mine],
            faces=[float(np.mean(one)) if one else math.nan for one in faces],
        )
    return reported


def measured(out: Path | None, split: str, presets: Sequence[str]) -> dict[tuple[str, float, str], Outcomes]:
    """Outcomes by preset, density and kind; what a folder holds already is not done again."""
    reported = {}
    with tempfile.TemporaryDirectory() as temporary:
        base = out if out is not None else Path(temporary)
        for density in DENSITIES_PER_M2:
            scene = base / f"scene-{density:g}"
            if not (scene / "truth" / "scene.json").exists():
                simulate(SUITE, scene, seed_of(split, 0), density_per_m2=density)
            for preset in presets:
                run = base / f"run-{density:g}-{preset}"
                if not (run / "run.json").exists():
                    tile = scene / f"{SUITE}.laz"
                    _reconstruct(tile, run, preset)
                for kind, one in outcomes(run, scene / "truth").items():
                    reported[preset, density, kind] = one
    return reported


def _reconstruct(tile: Path, run: Path, preset: str) -> None:
    """As a user would: neither footprints nor classes."""
    program = Path(sys.executable).with_name("gablework")
    command = [str(program), "reconstruct", str(tile), "--out", str(run), "--preset", preset]
    options = ["--method", "fuzzy-sart", "--workers", "0", "--no-isolate", "--meshes", "none", "--quiet", "--overwrite"]
    subprocess.run([*command, *options], check=True, capture_output=True)


def large_and_small(
    out: Path | None,
    split: str,
    share: Callable[[Sequence[bool]], Figure],
    mean: Callable[[Sequence[float], int, float], Figure],
) -> list[list[str | Figure]]:
    """The rows of the table: kind, preset, density, delivered, faces found, all right, correct."""
    reported = measured(out, split, ("robust", "faithful"))
    rows: list[list[str | Figure]] = []
    for (preset, density, kind), one in sorted(reported.items(), key=lambda item: (item[0][2], item[0][0] != "robust")):
        figures = [share(one.delivered), mean(one.faces, 0, 100.0), share(one.all_right), share(one.correct)]
        rows.append([kind, preset, f"{density:g}", *figures])
    return rows
