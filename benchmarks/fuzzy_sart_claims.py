"""Tests the claims of Shorter and Kasparis for each step of their method on houses with exact truth.

    python -m benchmarks.fuzzy_sart_claims [--out DIR] [--draws 25] [--only absorption cube] [--split test]

Prints Markdown tables; `--out` writes them to DIR/claims.md and a figure to DIR/claims.png. Building and ground are
given (points strewn at random over an exact roof) except in the chapter `product`, where scenes are scanned and go
through `gablework` like those of a user. *All right*: as in `benchmarks/fuzzy_sart_roofs.py`. Shares are in percent
with the 95 % interval of Wilson, means with a 95 % bootstrap interval over the roofs.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.fuzzy_sart_picture import draw_claims
from benchmarks.fuzzy_sart_probe import (
    HOUSES,
    LARGE,
    Centre,
    Vectors,
    centre_elsewhere,
    clusters_a_plane,
    facet_pairs,
    near_ridges,
    normal_error_deg,
    observe,
    share_labelled_right,
    strewn,
    strewn_house,
    unscaled_spherical,
)
from benchmarks.fuzzy_sart_product import large_and_small
from benchmarks.fuzzy_sart_roofs import SyntheticRoof, all_planes_right
from pipeline.geometry import point_spacing_m
from pipeline.methods.fuzzy_sart import segment
from pipeline.methods.settings import FuzzySartSettings
from pipeline.model import FloatArray, Segmentation
from pipeline.prepared_cloud import prepare_cloud
from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.segmentation.fuzzy_sart import centre_of_building, facet_vectors

DENSITIES_PER_M2 = (0.77, 2.0, 8.0)
NOISES_M = (0.02, 0.05, 0.10)
NOISE_M = 0.05
CUBES = 50
LOW_PITCHES_DEG = (8.0, 12.0, 18.0)
PRESETS = {"robust": FuzzySartSettings(), "faithful": FuzzySartSettings.faithful()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sample:
    """Which houses are looked at."""

    draws: int
    """Number of draws of each kind."""
    split: str
    """dev or test."""
    out: Path | None = None
    """Where scenes and runs are kept; None for a temporary folder."""

    def roofs(
        self, kinds: Sequence[str], density: float, noise_m: float, pitch_deg: float | None = None
    ) -> Iterator[SyntheticRoof]:
        """Every kind, draw by draw; the same houses whatever the survey."""
        for kind in kinds:
            for draw in range(self.draws):
                yield strewn_house(kind, density, noise_m, draw, split=self.split, pitch_deg=pitch_deg)


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A figure with its interval."""

    value: float
    """Share in percent, or mean."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end."""
    digits: int = 0
    """As printed."""

    def __str__(self) -> str:
        """As in a table."""
        return f"{self.value:.{self.digits}f} ({self.low:.{self.digits}f} to {self.high:.{self.digits}f})"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the report."""

    caption: str
    """What is in it, under which conditions."""
    header: list[str]
    """One head a column."""
    rows: list[list[str | Estimate]]
    """The cells."""

    def lines(self) -> list[str]:
        """Markdown."""
        lines = [self.header, ["---"] * len(self.header), *([str(cell) for cell in row] for row in self.rows)]
        return [self.caption, "", *("| " + " | ".join(line) + " |" for line in lines), ""]


def share(hits: Sequence[bool]) -> Estimate:
    """Percent, with the 95 % interval of Wilson."""
    n, p, z = len(hits), float(np.mean(hits)), 1.96
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return Estimate(100 * p, 100 * (middle - half), 100 * (middle + half))


def mean(values: Sequence[float], digits: int = 1, factor: float = 1.0) -> Estimate:
    """Mean of those that are known, with its 95 % bootstrap interval."""
    known = factor * np.array([value for value in values if math.isfinite(value)])
    if len(known) == 0:
        return Estimate(math.nan, math.nan, math.nan)
    random = np.random.default_rng(0)
    low, high = np.percentile(random.choice(known, (1000, len(known))).mean(axis=1), [2.5, 97.5])
    return Estimate(float(known.mean()), float(low), float(high), digits)


Rows = list[list[str | Estimate]]


def right(roof: SyntheticRoof, found: Segmentation) -> bool:
    """Whether a roof is all right."""
    return all_planes_right(roof, found)[0]


# --------------------------------------------------------------------------------------------- 1. absorption


def with_absorption(settings: FuzzySartSettings, absorption: str) -> FuzzySartSettings:
    """Settings that keep absorbed points in their facet (bucket), insert them there (insert), or absorb none."""
    if absorption == "none":
        return dataclasses.replace(settings, absorption="bucket", min_absorption_m=0.0, max_absorption_m=0.0)
    return dataclasses.replace(settings, absorption=absorption)


def absorbed(
    sample: Sample, settings: FuzzySartSettings, kinds: Sequence[str], density: float, noise_m: float
) -> list[Estimate]:
    """Error of normals, clusters per plane, all right before and after the refinement."""
    errors, clusters, before, after = [], [], [], []
    for roof in sample.roofs(kinds, density, noise_m):
        seen = observe(roof.candidate, settings)
        errors.append(normal_error_deg(roof, seen))
        clusters.append(clusters_a_plane(roof, seen))
        before.append(right(roof, seen.clustered))
        after.append(right(roof, seen.final))
    return [mean(errors), mean(clusters), share(before), share(after)]


def absorption(sample: Sample) -> list[Table]:
    """Absorption against none, over surveys and over roofs."""
    header = ["normals, deg", "clusters per plane", "all right by clusters", "all right at the end"]
    tables: list[Table] = []
    for preset, settings in PRESETS.items():
        rows: Rows = []
        for density in DENSITIES_PER_M2:
            for noise_m in NOISES_M:
                for way in ("none", "bucket", "insert"):
                    cells = absorbed(sample, with_absorption(settings, way), HOUSES, density, noise_m)
                    rows.append([f"{density:g}", f"{noise_m:.2f}", way, *cells])
        caption = f"Preset {preset}; flat, gable, hip and L-shaped houses together."
        tables.append(Table(caption=caption, header=["points per m2", "noise, m", "absorption", *header], rows=rows))
    for preset, settings in PRESETS.items():
        rows = []
        for kind in (*HOUSES, LARGE):
            for way in ("none", "bucket", "insert"):
                cells = absorbed(sample, with_absorption(settings, way), (kind,), DENSITIES_PER_M2[0], NOISE_M)
                rows.append([kind.replace("_", " "), way, *cells])
        caption = f"Preset {preset} by roof; {DENSITIES_PER_M2[0]:g} points per m2, {NOISE_M:g} m of noise."
        tables.append(Table(caption=caption, header=["roof", "absorption", *header], rows=rows))
    return tables


# -------------------------------------------------------------------------------- 2. translation, 3. scaling


def vector_row(
    sample: Sample,
    kinds: Sequence[str],
    density: float,
    settings: FuzzySartSettings,
    *,
    vectors: Vectors = facet_vectors,
    centre: Centre = centre_of_building,
) -> list[Estimate]:
    """Facet pairs that match, of one plane and of two; clusters; all right before and after the refinement."""
    one, two, clusters, before, after = [], [], [], [], []
    for roof in sample.roofs(kinds, density, NOISE_M):
        seen = observe(roof.candidate, settings, vectors=vectors, centre=centre)
        pairs = facet_pairs(roof, seen)
        matching = pairs.match >= settings.vigilance
        one.append(float(matching[pairs.same].mean()) if pairs.same.any() else math.nan)
        two.append(float(matching[~pairs.same].mean()) if (~pairs.same).any() else math.nan)
        clusters.append(clusters_a_plane(roof, seen))
        before.append(right(roof, seen.clustered))
        after.append(right(roof, seen.final))
    return [mean(one, 0, 100.0), mean(two, 0, 100.0), mean(clusters), share(before), share(after)]


VECTOR_HEADER = [
    "pairs of one plane that match, %",
    "of two planes, %",
    "clusters per plane",
    "all right by clusters",
    "all right at the end",
]
CENTRES = {
    "centred (Eq. 7), with its ground": centre_of_building,
    "centred, the roof alone": centre_elsewhere("roof"),
    "lowest corner at the origin": centre_elsewhere("corner"),
    "100 m away": centre_elsewhere("100"),
    "1 km away": centre_elsewhere("1000"),
    "10 km away": centre_elsewhere("10000"),
}
CONTROLS = {"centred (Eq. 7), with its ground", "10 km away"}
"""Unit normals know no place."""
VECTORS = {"footpoint": 0.7, "spherical_scaled": 0.7, "unit_normal": 0.95}


def translation(sample: Sample) -> list[Table]:
    """The building at the origin, and elsewhere."""
    tables: list[Table] = []
    for preset, settings in PRESETS.items():
        for density in (DENSITIES_PER_M2[0], DENSITIES_PER_M2[-1]):
            rows: Rows = []
            for kind, vigilance in VECTORS.items():
                chosen = dataclasses.replace(settings, vectors=kind, vigilance=vigilance)
                for place, centre in CENTRES.items():
                    if kind == "unit_normal" and place not in CONTROLS:
                        continue
                    rows.append([kind, place, *vector_row(sample, HOUSES, density, chosen, centre=centre)])
            caption = f"TIN and refinement of {preset}; {density:g} points per m2, {NOISE_M:g} m of noise."
            tables.append(Table(caption=caption, header=["vectors", "building", *VECTOR_HEADER], rows=rows))
    return tables


SCALES: dict[str, tuple[Vectors, float]] = {
    "unscaled, angles in radians": (unscaled_spherical(1.0), 0.0),
    "unscaled, angles in degrees": (unscaled_spherical(math.pi / 180.0), 0.0),
    "each to [0, 1]": (facet_vectors, 0.0),
    "each to [1, 2]": (facet_vectors, 0.5),  # VDM knows no common factor: [1, 2] is [0.5, 1]
}


def weights(
    sample: Sample, kinds: Sequence[str], density: float, settings: FuzzySartSettings, vectors: Vectors
) -> list[Estimate]:
    """Rank correlation of 1 - VDM with the difference in each dimension: how much each decides."""
    found: list[FloatArray] = []
    for roof in sample.roofs(kinds, density, NOISE_M):
        pairs = facet_pairs(roof, observe(roof.candidate, settings, vectors=vectors))
        if len(pairs.match) > 2:
            ranks = np.argsort(np.argsort(np.column_stack([-pairs.match, pairs.apart]), axis=0, kind="stable"), axis=0)
            found.append(np.asarray(np.corrcoef(ranks.T.astype(np.float64)))[0, 1:])
    return [mean([row[k] for row in found], 2) for k in range(3)]


def scaling(sample: Sample) -> list[Table]:
    """Spherical vectors as they are, and scaled to one range."""
    tables: list[Table] = []
    for preset, settings in PRESETS.items():
        for density in (DENSITIES_PER_M2[0], DENSITIES_PER_M2[-1]):
            rows: Rows = []
            for name, (vectors, lowest) in SCALES.items():
                chosen = dataclasses.replace(settings, vectors="spherical_scaled", vigilance=0.7, scaled_min=lowest)
                rows.append([name, *vector_row(sample, HOUSES, density, chosen, vectors=vectors)])
            caption = f"TIN and refinement of {preset}; {density:g} points per m2, {NOISE_M:g} m of noise."
            tables.append(Table(caption=caption, header=["r, theta, phi", *VECTOR_HEADER], rows=rows))
    rows = []
    for name, (vectors, lowest) in SCALES.items():
        chosen = dataclasses.replace(PRESETS["faithful"], scaled_min=lowest)
        rows.append([name, *weights(sample, HOUSES, DENSITIES_PER_M2[0], chosen, vectors)])
    caption = f"Rank correlation of 1 - VDM with the difference in each dimension; {DENSITIES_PER_M2[0]:g} per m2."
    tables.append(Table(caption=caption, header=["r, theta, phi", "r", "theta", "phi"], rows=rows))
    return tables


# ------------------------------------------------------------------------------------------------------ 4. cube


def cube(sample: Sample) -> list[Table]:
    """The paper's test: elevations of 0 and 10 m, 0.1 m of noise."""
    rows: Rows = []
    for preset, settings in PRESETS.items():
        for density in DENSITIES_PER_M2:
            single, within, worst, residuals = [], [], [], []
            for draw in range(CUBES):
                roof = _cube(density, seed_of(sample.split, draw))
                found = segment(prepare_cloud(roof.candidate), settings)
                single.append(len(found.planes) == 1)
                off, rmse = _cube_errors(roof, found)
                within.append(off <= 0.05)
                worst.append(off)
                residuals.append(rmse)
            reported = [share(single), share(within), mean(worst, 3), mean(residuals, 3)]
            rows.append([preset, f"{density:g}", *reported])
    header = ["preset", "points per m2", "exactly one plane", "largest plane within 0.05 m everywhere"]
    header += ["farthest of it from the truth, m", "residuals of the points on it, m"]
    return [Table(caption=f"{CUBES} draws.", header=header, rows=rows)]


def _cube(density: float, seed: int) -> SyntheticRoof:
    """A flat roof of 10 x 10 m; roof and ground with 0.1 m of noise."""
    random = np.random.default_rng([seed, 0xC0BE])
    roof = strewn("cube", RoofShape.FLAT, RoofDimensions(length_m=10.0, width_m=10.0), density, 0.1, random)
    eave_m = float(roof.planes[0, 2])
    points = roof.candidate.points + np.array([0.0, 0.0, round(10.0 - eave_m, 3)])
    ground = roof.candidate.ground.copy()
    ground[:, 2] = np.rint(random.normal(0.0, 100.0, len(ground))) / 1000.0
    candidate = dataclasses.replace(roof.candidate, points=np.rint(points * 1000.0) / 1000.0, ground=ground)
    return dataclasses.replace(roof, candidate=candidate, planes=np.array([(0.0, 0.0, 10.0)]))


def _cube_errors(roof: SyntheticRoof, found: Segmentation) -> tuple[float, float]:
    """Farthest distance of the largest plane from 10 m over the roof, and the residuals of its own points."""
    if not found.planes:
        return math.inf, math.nan
    sizes = np.bincount(found.labels[found.labels >= 0], minlength=len(found.planes))
    a, b, c = found.planes[int(sizes.argmax())].coefficients
    x, y, z = roof.candidate.points.T
    own = found.labels == int(sizes.argmax())
    residuals = z - (a * x + b * y + c)
    return float(np.abs(a * x + b * y + c - 10.0).max()), float(np.sqrt((residuals[own] ** 2).mean()))


# ---------------------------------------------------------------------------- 5. what the refinement does


def refinement(sample: Sample) -> list[Table]:
    """Clusters alone, with regression and merging, with the second look, with ridges."""
    steps = ("clustered", "refined", "looked_again", "final")
    names = ("clusters alone", "+ regression, merging, outliers", "+ second look", "+ ridges")
    small = ("hip", "l_shape", "t_shape", "cross", "half_hip")
    tables: list[Table] = []
    for title, kinds in (("Large simple buildings", (LARGE,)), ("Small complex houses", small)):
        rows: Rows = []
        for preset, settings in PRESETS.items():
            for density in DENSITIES_PER_M2:
                roofs = list(sample.roofs(kinds, density, NOISE_M))
                seen = [observe(roof.candidate, settings) for roof in roofs]
                near = [near_ridges(roof, 1.5 * point_spacing_m(roof.candidate.points)) for roof in roofs]
                for step, name in zip(steps, names, strict=True):
                    found = [getattr(one, step) for one in seen]
                    both = list(zip(roofs, found, strict=True))
                    planes = [len(one.planes) / len(roof.planes) for roof, one in both]
                    rights = [share_labelled_right(roof, one, np.ones(len(one.labels), bool)) for roof, one in both]
                    ridge = [
                        share_labelled_right(roof, one, places) for (roof, one), places in zip(both, near, strict=True)
                    ]
                    reported = [share([right(*pair) for pair in both]), mean(planes)]
                    reported += [mean(rights, 0, 100.0), mean(ridge, 0, 100.0)]
                    rows.append([preset, f"{density:g}", name, *reported])
        header = ["preset", "points per m2", "step", "all right", "planes per true plane"]
        header += ["points on their plane, %", "the same near ridges, %"]
        tables.append(Table(caption=f"{title}, {NOISE_M:g} m of noise.", header=header, rows=rows))
    return tables


# ------------------------------------------------------------------------------------- 6. vigilance and tau

VIGILANCES = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.97, 0.99)
TAUS = (1, 5, 20)


def sensitivity(sample: Sample) -> list[Table]:
    """All right by vigilance and tau; dev houses whatever the sample, since settings are chosen by it."""
    dev = dataclasses.replace(sample, split="dev")
    tables: list[Table] = []
    for preset, settings in PRESETS.items():
        chosen = [dataclasses.replace(settings, vigilance=vigilance) for vigilance in VIGILANCES]
        chosen += [dataclasses.replace(settings, tau_epochs=tau) for tau in TAUS]
        rows: Rows = []
        for one in chosen:
            cells: list[str | Estimate] = [f"{one.vigilance:g}", str(one.tau_epochs)]
            cells += [
                share(
                    [
                        right(roof, segment(prepare_cloud(roof.candidate), one))
                        for roof in dev.roofs((*HOUSES, LARGE), *survey)
                    ]
                )
                for survey in ((0.77, 0.05), (0.77, 0.10), (8.0, 0.05))
            ]
            low = [roof for pitch in LOW_PITCHES_DEG for roof in dev.roofs(("gable",), 0.77, NOISE_M, pitch)]
            cells.append(share([right(roof, segment(prepare_cloud(roof.candidate), one)) for roof in low]))
            rows.append(cells)
        caption = f"Preset {preset} (V = {settings.vigilance:g}, tau = {settings.tau_epochs}), dev draws: all right."
        surveys = [
            ".77 per m2, 0.05 m",
            ".77 per m2, 0.10 m",
            "8 per m2, 0.05 m",
            "gables of 8, 12, 18 deg, .77 per m2",
        ]
        tables.append(Table(caption=caption, header=["V", "tau", *surveys], rows=rows))
    return tables


# ----------------------------------------------------------------------- large simple, small complex: the product


def product(sample: Sample) -> list[Table]:
    """Scanned scenes through `gablework`, measured by the ruler."""
    rows = large_and_small(sample.out, sample.split, share, mean)
    header = ["buildings", "preset", "pulses per m2", "LoD2 delivered", "faces of 10 m2 found, %"]
    header += ["all planes right", "correct (and the roof type)"]
    return [Table(caption=f"One scene, {NOISE_M:g} m of noise.", header=header, rows=rows)]


# ---------------------------------------------------------------------------------------------------- command

CHAPTERS: dict[str, tuple[str, Callable[[Sample], list[Table]]]] = {
    "absorption": ("Absorption", absorption),
    "translation": ("Translation", translation),
    "scaling": ("Scaling", scaling),
    "cube": ("The cube", cube),
    "product": ("Large simple buildings, small complex houses", product),
    "refinement": ("What the refinement does", refinement),
    "sensitivity": ("Vigilance and tau", sensitivity),
}


def main() -> None:
    """Print the tables, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--draws", type=int, default=25, help="houses of each kind")
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--only", nargs="*", choices=list(CHAPTERS), default=list(CHAPTERS))
    given = parser.parse_args()
    sample = Sample(draws=given.draws, split=given.split, out=given.out)
    document: list[str] = []
    found: dict[str, list[Table]] = {}
    for name, (title, chapter) in CHAPTERS.items():
        if name in given.only:
            begin = time.perf_counter()
            found[name] = chapter(sample)
            lines = [f"## {title}", "", *(line for one in found[name] for line in one.lines())]
            print("\n".join(lines), flush=True)
            print(f"<!-- {name}: {time.perf_counter() - begin:.0f} s -->\n", flush=True)
            document += lines
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "claims.md").write_text("\n".join(document), encoding="utf-8")
        draw_claims(found, given.out / "claims.png")


if __name__ == "__main__":
    main()
