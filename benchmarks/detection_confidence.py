r"""Fit of `detection_confidence`, and its reliability on surveys that it was not fitted to.

    .venv/bin/python -m benchmarks.trust --out TRUST --split dev
    .venv/bin/python -m benchmarks.trust --out TRUST --split test
    .venv/bin/python -m benchmarks.trust --out TRUST --split test --feet
    .venv/bin/gablework reconstruct WEST.laz EAST.laz --classes ignore --out DELFT
    .venv/bin/python -m benchmarks.detection_confidence delft=DELFT:WEST.laz,EAST.laz --dev TRUST/dev \
        --test TRUST/test TRUST/test_feet

Prints the weights, fitted to the dev scenes of the suite `trust` and to all real surveys that are given (as much weight
for all real candidates as for all simulated ones), and the expected calibration error: candidates by rising confidence
in ten bins of equal count, the distance between mean confidence and share right in each, their mean. Each real survey
is measured with weights that were fitted without it, the test scenes with weights from the dev scenes and all real
surveys. Blocks are measured, but no weight is fitted to them: their confidence is that of the doubtful model that they
replaced. `benchmarks/calibration_data.py` says which candidates are right. Without `--test`, the dev scenes are
measured.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from benchmarks.calibration_data import Candidates, real, simulated, together
from benchmarks.entries import markdown_table
from pipeline.model import BoolArray, FloatArray

BINS = 10
EDGES = (0.0, 0.05, 0.1, 0.2, 0.5, 0.8, 0.9, 0.95, 1.0)
"""Of the table of reliability."""
PRIOR = 0.01
"""Penalty of the squared slope, per candidate: it keeps the slope finite where no candidate contradicts it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights as in `pipeline.quality.detection`."""

    per_log_flatness: float
    at_flatness_1: float
    most: float
    per_log_rough: float
    at_no_rough: float

    def confidence(self, candidates: Candidates) -> FloatArray:
        """The confidence of each candidate."""
        of_model = self.most * logistic(self.at_flatness_1 + self.per_log_flatness * candidates.figure)
        of_rejected = logistic(self.at_no_rough + self.per_log_rough * candidates.figure)
        return np.where(candidates.is_model, of_model, of_rejected)


def logistic(odds: FloatArray) -> FloatArray:
    """Probability of log-odds."""
    probability: FloatArray = 1.0 / (1.0 + np.exp(-np.clip(odds, -40.0, 40.0)))
    return probability


def fitted(candidates: Candidates) -> Weights:
    """The likeliest weights, models with a roof and rejected objects apart."""
    slope, start, most = _likeliest(candidates[candidates.is_model & ~candidates.is_block], has_ceiling=True)
    slope_rejected, start_rejected, _ = _likeliest(candidates[~candidates.is_model], has_ceiling=False)
    return Weights(
        per_log_flatness=slope, at_flatness_1=start, most=most, per_log_rough=slope_rejected, at_no_rough=start_rejected
    )


def _likeliest(candidates: Candidates, *, has_ceiling: bool) -> tuple[float, float, float]:
    """Slope, log-odds at 0 and largest probability."""
    x, right, is_real = candidates.figure, candidates.right, candidates.is_real
    middle, spread = x.mean(), x.std()
    z = (x - middle) / spread
    ratio = (~is_real).sum() / max(1, is_real.sum()) if (~is_real).any() else 1.0
    weight = np.where(is_real, ratio, 1.0)
    weight = weight / weight.sum()

    def loss(b: FloatArray) -> float:
        most = logistic(b[2]) if has_ceiling else 1.0
        p = np.clip(most * logistic(b[0] * z + b[1]), 1e-9, 1.0 - 1e-9)
        return float(-(weight * np.where(right, np.log(p), np.log(1.0 - p))).sum() + PRIOR / len(z) * b[0] ** 2)

    b = minimize(loss, np.array([0.0, 0.0, 4.0]), method="L-BFGS-B").x
    slope = b[0] / spread
    return float(slope), float(b[1] - slope * middle), float(logistic(b[2])) if has_ceiling else 1.0


def calibration_error(confidence: FloatArray, right: BoolArray) -> float:
    """Expected calibration error over ten bins of equal count; nan without candidates."""
    if not len(right):
        return float("nan")
    order = np.argsort(confidence, kind="stable")
    bins = [part for part in np.array_split(order, BINS) if len(part)]
    return sum(len(part) * abs(confidence[part].mean() - right[part].mean()) for part in bins) / len(right)


def measured(found: Mapping[str, tuple[Candidates, FloatArray]]) -> str:
    """A row per survey, with the confidence of each of its candidates."""
    rows = []
    for name, (some, p) in found.items():
        error, of_models = (
            calibration_error(p, some.right),
            calibration_error(p[some.is_model], some.right[some.is_model]),
        )
        counts = [some.is_model.sum(), (~some.is_model).sum()]
        shares = [f"{some.right.mean():.2f}", f"{p.mean():.2f}", f"{error:.3f}", f"{of_models:.3f}"]
        rows.append([name, *map(str, counts), *shares])
    heads = ["survey", "models", "rejected", "share right", "mean confidence", "error", "error of models"]
    return markdown_table(heads, rows)


def reliability(found: Mapping[str, tuple[Candidates, FloatArray]]) -> str:
    """A row per range of confidence: candidates, mean confidence and share right, in each group."""
    rows = []
    for low, high in itertools.pairwise(EDGES):
        row = [f"{low:g} to {high:g}"]
        for some, p in found.values():
            inside = (p >= low) & (p < high)
            means = [f"{p[inside].mean():.2f}", f"{some.right[inside].mean():.2f}"] if inside.any() else ["", ""]
            row += [str(inside.sum()), *means]
        rows.append(row)
    heads = [f"{name}: {what}" for name in found for what in ("candidates", "mean confidence", "share right")]
    return markdown_table(["confidence", *heads], rows)


def kinds_of(candidates: Candidates) -> dict[str, BoolArray]:
    """The kinds of simulated surveys, by the names in `survey`."""
    density = np.array([float(name[1:].split("_")[0]) for name in candidates.survey])
    in_feet = np.char.endswith(candidates.survey, "_feet")
    returns = np.array([name.split("_", 1)[1].split("_z")[0] for name in candidates.survey])
    kinds = {
        "simulated, many returns": returns == "five",
        "simulated, one return": (returns == "first") | (returns == "last"),
        "simulated, first and last": returns == "first_and_last",
        "simulated, under 2 per m2": density < 2.0,
        "simulated, 10 per m2 and more": density >= 10.0,
        "simulated": ~in_feet,
    }
    return {**{name: chosen & ~in_feet for name, chosen in kinds.items()}, "simulated, in feet": in_feet}


def main() -> None:
    """Fit, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("surveys", nargs="*", help="NAME=DIR:FILE[,FILE...]: a run and its classified files")
    parser.add_argument("--dev", type=Path, required=True, help="tables of benchmarks.trust, without the ending")
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="the same of test scenes")
    parser.add_argument("--only-measured", nargs="*", default=[], help="names of surveys that the weights never see")
    given = parser.parse_args()
    surveys = {}
    for word in given.surveys:
        name, place = word.split("=", 1)
        run, files = place.split(":", 1)
        surveys[name] = real(name, Path(run), [Path(file) for file in files.split(",")])
    dev = simulated(given.dev)
    fit_to = {name: some for name, some in surveys.items() if name not in given.only_measured}
    weights = fitted(together([dev, *fit_to.values()]))
    for field, value in dataclasses.asdict(weights).items():
        print(f"{field} = {value:.3f}")
    apart = {}
    for name, some in surveys.items():
        others = fitted(together([dev, *(other for key, other in fit_to.items() if key != name)]))
        apart[name] = (some, others.confidence(some))
    test = together([simulated(tables) for tables in given.test]) if given.test else dev
    p = weights.confidence(test)
    found = {**apart, **{name: (test[chosen], p[chosen]) for name, chosen in kinds_of(test).items() if chosen.any()}}
    print("\n" + measured(found))
    everything = together([some for some, _ in apart.values()]) if apart else None
    groups = {} if everything is None else {"real": (everything, np.concatenate([q for _, q in apart.values()]))}
    print("\n" + reliability({**groups, "simulated": (test, p)}))


if __name__ == "__main__":
    main()
