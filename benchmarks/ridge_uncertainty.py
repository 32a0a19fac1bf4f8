"""Share of ridges that are as near to the truth as their records say: `ridge_z_sigma_m` against simulated scenes.

    python -m benchmarks.ridge_uncertainty --out DIR [--split dev|test] [--method arrangement]
                                           [--only hofmann310 sweep-d8] [--jobs 2]
                                           [--page docs/results/ridge_uncertainty.md]

All cells of `sweep` and the first draw of `hofmann310`, without footprints; runs are those of `benchmarks/ruler.py` and
lie where it puts them. A model is compared with its true building (IoU of the footprints of at least one half), moved
to where the survey saw it, since no record includes the shift of a whole strip. Blocks have no ridge and are left out,
like buildings that the edge of the data cuts. Writes DIR/ridge_uncertainty_SPLIT.md, and its lines into the page.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import shapely

from benchmarks.entries import Entry, Workplace, hofmann_entries, markdown_table, measure_all, sweep_entries
from benchmarks.results_page import filled
from pipeline.ruler.evaluation.matching import match_footprints
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.runtime.compare import Variant

ONE_SIGMA = 0.6827
"""Share of a normal distribution within one standard deviation."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RidgeError:
    """One modelled building."""

    error_m: float
    """Highest roof point of the model, less that of the truth."""
    sigma_m: float
    """What the record says; nan where it says nothing."""
    is_good: bool = True
    """Whether nothing makes the building hard; True where nothing is known."""


def highest_m(building: RoofModel) -> float:
    """Elevation of the highest point of a building's roof faces."""
    tops = []
    for surface in building.surfaces:
        xy = shapely.get_coordinates(surface.polygon)
        tops.append(float(surface.elevation(xy[:, 0], xy[:, 1]).max()))
    return max(tops)


def share_within(errors: Sequence[RidgeError], sigmas: float) -> float:
    """Share of the errors with a figure that are within so many standard deviations; nan without any.

    Examples
    --------
    >>> share_within([RidgeError(error_m=0.01, sigma_m=0.02), RidgeError(error_m=-0.03, sigma_m=0.02)], 1.0)
    0.5
    """
    known = [one for one in errors if not math.isnan(one.sigma_m)]
    return statistics.fmean(abs(one.error_m) <= sigmas * one.sigma_m for one in known) if known else math.nan


def ridge_errors(entry: Entry, variant: Variant, place: Workplace) -> list[RidgeError]:
    """All models of a run that stand for a true building, with a roof of their own and not cut by the edge."""
    reference = read_truth_reference(place.scene(entry) / "truth", as_surveyed=True)
    models = read_models(place.run(variant, entry)).models
    columns = ["building_id", "status", "ridge_z", "ridge_z_sigma_m", "touches_data_edge"]
    records = pq.read_table(str(place.run(variant, entry) / "buildings"), columns=columns).to_pylist()
    rows = {row["building_id"]: row for row in records}
    found = []
    for model, stands_for in zip(models, match_footprints(models, reference).reference_of.tolist(), strict=True):
        row = rows[model.building_id]
        if stands_for < 0 or row["status"] not in {"ok", "doubtful"} or row["touches_data_edge"]:
            continue
        true = reference.buildings[stands_for]
        sigma, conditions = row["ridge_z_sigma_m"], reference.conditions.get(true.building_id)
        found.append(
            RidgeError(
                error_m=row["ridge_z"] - highest_m(true),
                sigma_m=math.nan if sigma is None else sigma,
                is_good=conditions is None or conditions.good,
            )
        )
    return found


def table(groups: Sequence[tuple[str, Sequence[RidgeError]]]) -> str:
    """A line a group of buildings."""
    lines = []
    for name, errors in groups:
        known = [one for one in errors if not math.isnan(one.sigma_m)]
        if not known:
            continue
        size = np.array([abs(one.error_m) for one in known])
        lines.append(
            [
                name,
                str(len(errors)),
                str(len(errors) - len(known)),
                f"{100 * share_within(known, 1.0):.1f} %",
                f"{100 * share_within(known, 2.0):.1f} %",
                f"{float(np.median(size)):.3f} m",
                f"{float(np.percentile(size, 100 * ONE_SIGMA)):.3f} m",
                f"{statistics.median(one.sigma_m for one in known):.3f} m",
            ]
        )
    head = ["models", "number", "without a figure", "within one sigma", "within two", "median error"]
    return markdown_table([*head, "68 % of errors below", "median sigma"], lines)


def groups_of(found: Sequence[tuple[Entry, Sequence[RidgeError]]]) -> list[tuple[str, list[RidgeError]]]:
    """`hofmann310` all and good; the sweep as a whole, by density and by noise."""
    groups: list[tuple[str, list[RidgeError]]] = []
    hofmann = [one for entry, errors in found if entry.name.startswith("hofmann310") for one in errors]
    groups.append(("hofmann310, all", hofmann))
    groups.append(("hofmann310, good ones", [one for one in hofmann if one.is_good]))
    cells = [(entry.scene.cell, errors) for entry, errors in found if entry.scene is not None and entry.scene.cell]
    groups.append(("sweep, all", [one for _, errors in cells for one in errors]))
    for density in sorted({cell.density_per_m2 for cell, _ in cells}):
        errors = [one for cell, some in cells if cell.density_per_m2 == density for one in some]
        groups.append((f"sweep, {density:g} pulses per m2", errors))
    for noise in sorted({cell.noise_m for cell, _ in cells}):
        errors = [one for cell, some in cells if cell.noise_m == noise for one in some]
        groups.append((f"sweep, {noise:.2f} m of noise", errors))
    return groups


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--method", default="arrangement", metavar="METHOD[:PRESET]")
    parser.add_argument("--only", nargs="*", default=[""], help="beginnings of the names of entries")
    parser.add_argument("--jobs", type=int, default=2, help="entries at a time")
    parser.add_argument("--page", type=Path, help="page whose block is replaced")
    arguments = parser.parse_args()
    variant, place = Variant.parse(arguments.method), Workplace(root=arguments.out)
    entries = [
        entry
        for entry in (*hofmann_entries(arguments.split, 1), *sweep_entries(arguments.split))
        if entry.name.startswith(tuple(arguments.only))
    ]
    faults = measure_all([(entry, [variant]) for entry in entries], place, arguments.jobs)
    measured = [entry for entry in entries if place.is_measured(variant, entry)]
    text = table(groups_of([(entry, ridge_errors(entry, variant, place)) for entry in measured]))
    (place.root / f"ridge_uncertainty_{arguments.split}.md").write_text(text, encoding="utf-8")
    if arguments.page is not None:
        page, _ = filled(arguments.page.read_text(encoding="utf-8"), place.root)
        arguments.page.write_text(page, encoding="utf-8")
    print(text)
    print("\n".join(faults), file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
