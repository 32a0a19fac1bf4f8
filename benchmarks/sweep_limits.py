"""The lowest density and the highest noise at which each method holds: all cells of `sweep`, as a table and a plot.

    python benchmarks/sweep_limits.py --out DIR [--plot FILE] [--split test] [--methods METHOD[:PRESET] ...] [--jobs 2]
                                      [--sparsest D] [--densest D] [--densest-faithful D]

The quality of the roof faces of at least 10 m2, TP / (TP + FP + FN) in the true and the modelled faces together, is
that of the evaluation (`faces.quality_10m2`). A limit is where it falls below 80 % or 50 %: the density interpolated
in its logarithm between the cells of one noise, the noise between those of one density. A quality need not fall with
the density at both ends, so the result is the range in which it holds: `from 0.9` (to the densest cell), `to 12`,
`0.9 to 12`, `always` (in all cells), `never`. Writes DIR/sweep_limits.md, and the plot.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.entries import Workplace, all_variants, markdown_table, measure_all, sweep_entries
from benchmarks.ruler import sweep_qualities
from pipeline.ruler.simulation.sweep import CELLS
from pipeline.runtime.compare import Variant

LEVELS = (0.8, 0.5)
"""Qualities whose limits are reported."""
NOISE_COLOURS = ("#1b6ca8", "#2a9d55", "#d1495b")
"""One a noise, from clean to noisy."""
DENSEST_FAITHFUL = 16.0
"""Pulses per square metre up to which the papers' own settings are measured: with noise at many points Fuzzy SART makes
many clusters of many facets, and its time grows with the product."""

Qualities = Mapping[tuple[float, float], float]
"""Quality by density and noise."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldRange:
    """A stretch of densities or noises in which the quality holds a level."""

    low: float
    """Lower end; minus infinity where it holds at the first cell."""
    high: float
    """Upper end; infinity where it holds at the last cell."""


def held_ranges(
    places: Sequence[float], qualities: Sequence[float], level: float, *, logarithmic: bool
) -> list[HeldRange]:
    """Where a quality that is linear between its cells is at least a level.

    Parameters
    ----------
    places : sequence of float
        Densities or noises, ascending.
    qualities : sequence of float
        One a place.
    level : float
        To be held.
    logarithmic : bool
        Whether between two places it is linear in the logarithm of the place.

    Returns
    -------
    list of HeldRange
        From low to high; empty where it never holds.

    Examples
    --------
    >>> held_ranges([1.0, 4.0], [0.7, 0.9], 0.8, logarithmic=True)
    [HeldRange(low=2.0, high=inf)]
    >>> held_ranges([0.02, 0.10], [0.9, 0.9], 0.8, logarithmic=False)
    [HeldRange(low=-inf, high=inf)]
    """
    forward: Callable[[float], float] = math.log if logarithmic else float
    back: Callable[[float], float] = math.exp if logarithmic else float
    ranges = []
    low: float | None = -math.inf if qualities and qualities[0] >= level else None
    for (place, quality), (place_after, after) in itertools.pairwise(zip(places, qualities, strict=True)):
        if (quality >= level) == (after >= level):
            continue
        share = (level - quality) / (after - quality)
        crossing = back(forward(place) + share * (forward(place_after) - forward(place)))
        if low is None:
            low = crossing
        else:
            ranges.append(HeldRange(low=low, high=crossing))
            low = None
    if low is not None:
        ranges.append(HeldRange(low=low, high=math.inf))
    return ranges


def reported_ranges(ranges: Sequence[HeldRange]) -> str:
    """The ranges as a cell of a table.

    Examples
    --------
    >>> reported_ranges([HeldRange(low=0.9, high=12.0), HeldRange(low=30.0, high=math.inf)])
    '0.90 to 12, from 30'
    """
    reported = []
    for one in ranges:
        if math.isinf(one.low) and math.isinf(one.high):
            return "always"
        if math.isinf(one.high):
            reported.append(f"from {_reported(one.low)}")
        elif math.isinf(one.low):
            reported.append(f"to {_reported(one.high)}")
        else:
            reported.append(f"{_reported(one.low)} to {_reported(one.high)}")
    return ", ".join(reported) or "never"


def _reported(value: float) -> str:
    """Two digits that say something."""
    digits = max(0, 1 - math.floor(math.log10(value)))
    return f"{value:.{digits}f}"


def along_density(qualities: Qualities, noise_m: float) -> tuple[list[float], list[float]]:
    """Densities with a cell of a noise, ascending, and the quality at each."""
    densities = sorted(density for density, noise in qualities if noise == noise_m)
    return densities, [qualities[density, noise_m] for density in densities]


def along_noise(qualities: Qualities, density_per_m2: float) -> tuple[list[float], list[float]]:
    """Noises with a cell of a density, ascending, and the quality at each."""
    noises = sorted(noise for density, noise in qualities if density == density_per_m2)
    return noises, [qualities[density_per_m2, noise] for noise in noises]


def density_table(found: Mapping[str, Qualities]) -> str:
    """A row a method: the densities at which each level is held, by noise."""
    noises = _noises(found)
    heads = [f"{100 * level:.0f} %, {noise:g} m" for level in LEVELS for noise in noises]
    rows = []
    for label, qualities in found.items():
        cells = [
            reported_ranges(held_ranges(*along_density(qualities, noise), level, logarithmic=True))
            for level in LEVELS
            for noise in noises
        ]
        rows.append([label, *cells])
    return markdown_table(["pulses per m2 at which it holds", *heads], rows)


def noise_table(found: Mapping[str, Qualities]) -> str:
    """A row a method and level: the noises at which it is held, by density."""
    densities = sorted({density for qualities in found.values() for density, _ in qualities})
    rows = []
    for label, qualities in found.items():
        for level in LEVELS:
            cells = []
            for density in densities:
                noises, values = along_noise(qualities, density)
                cells.append(reported_ranges(held_ranges(noises, values, level, logarithmic=False)) if noises else "")
            rows.append([label, f"{100 * level:.0f} %", *cells])
    return markdown_table(["m of noise at which it holds", "level", *(f"{one:g} per m2" for one in densities)], rows)


def quality_table(found: Mapping[str, Qualities]) -> str:
    """A row a method, a column a density: the quality in percent at every noise, from clean to noisy."""
    densities = sorted({density for qualities in found.values() for density, _ in qualities})
    rows = [
        [
            label,
            *(
                " / ".join(f"{100 * value:.0f}" for value in along_noise(qualities, density)[1])
                for density in densities
            ),
        ]
        for label, qualities in found.items()
    ]
    noises = " / ".join(f"{noise:g}" for noise in _noises(found))
    return markdown_table([f"percent at {noises} m of noise", *(f"{one:g} per m2" for one in densities)], rows)


def _noises(found: Mapping[str, Qualities]) -> list[float]:
    return sorted({noise for qualities in found.values() for _, noise in qualities})


def draw(found: Mapping[str, Qualities], path: Path) -> None:
    """The plot: a panel a method, quality over density, a line a noise; and one of the 80 % limits of all methods."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    columns = 3
    rows = math.ceil((len(found) + 1) / columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4.0 * columns, 3.0 * rows), layout="constrained", squeeze=False)
    panels = list(axes.flat)
    densities = sorted({density for qualities in found.values() for density, _ in qualities})
    for panel, (label, qualities) in zip(panels, found.items(), strict=False):
        _draw_method(panel, label, qualities, densities)
    for panel in axes[:, 0]:
        panel.set_ylabel("quality of faces ≥ 10 m², %", fontsize=9)
    _draw_limits(panels[len(found)], found, densities)
    for panel in panels[len(found) + 1 :]:
        panel.set_visible(False)
    panels[0].legend(fontsize=8, loc="lower right", frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _density_axis(panel: Any, densities: Sequence[float]) -> None:
    panel.set_xscale("log")
    panel.set_xticks(densities, [f"{density:g}" for density in densities])
    panel.set_xticks([], minor=True)
    panel.set_xlim(densities[0] / 1.2, densities[-1] * 1.2)
    panel.set_xlabel("pulses per m²", fontsize=9)
    panel.tick_params(labelsize=8)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


def _draw_method(panel: Any, label: str, qualities: Qualities, densities: Sequence[float]) -> None:
    """Quality of one method over the density."""
    for level in LEVELS:
        panel.axhline(level, color="#999999", linewidth=0.8, linestyle="--")
    for noise, colour in zip(_noises({label: qualities}), NOISE_COLOURS, strict=False):
        panel.plot(
            *along_density(qualities, noise), color=colour, marker="o", markersize=3, label=f"{noise:.2f} m of noise"
        )
    panel.set_title(label, fontsize=10)
    panel.set_ylim(0.0, 1.0)
    panel.set_yticks([0.0, 0.2, *sorted(LEVELS), 1.0], ["0", "20", *(f"{100 * x:.0f}" for x in sorted(LEVELS)), "100"])
    _density_axis(panel, densities)


def _draw_limits(panel: Any, found: Mapping[str, Qualities], densities: Sequence[float]) -> None:
    """The lowest density at which each method holds 80 %, a dot a noise; methods that never do are at the right."""
    least, most = densities[0], densities[-1]
    beyond = most * 2.0
    for row, qualities in enumerate(found.values()):
        for number, noise in enumerate(_noises(found)):
            ranges = held_ranges(*along_density(qualities, noise), LEVELS[0], logarithmic=True)
            place = max(ranges[0].low, least) if ranges else beyond
            panel.plot(place, row + 0.22 * (number - 1), marker="o", markersize=4.5, color=NOISE_COLOURS[number])
    panel.axvspan(most * 1.35, most * 3.0, color="#eeeeee", zorder=0)
    panel.text(beyond, -0.75, "never", fontsize=8, ha="center", va="center")
    panel.set_title(f"lowest density with {100 * LEVELS[0]:.0f} %", fontsize=10)
    panel.set_ylim(len(found) - 0.5, -1.1)
    _density_axis(panel, densities)
    panel.set_ylabel("")
    panel.set_yticks(range(len(found)), list(found), fontsize=7)
    panel.grid(axis="y", color="#eeeeee", linewidth=0.6)
    panel.set_xlim(least / 1.4, most * 3.0)


def document(found: Mapping[str, Qualities], split: str) -> str:
    """All tables as Markdown."""
    parts = [f"`sweep`, {split} seeds: quality of the roof faces of at least 10 m2.\n", "### Down to what density\n"]
    parts += [density_table(found), "### Up to what noise\n", noise_table(found)]
    parts += ["### The qualities\n", quality_table(found)]
    return "\n".join(parts)


def main() -> int:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plot", type=Path, help="PNG or SVG; default DIR/sweep_limits.png")
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--methods", nargs="*", metavar="METHOD[:PRESET]", help="default: all methods, both presets")
    parser.add_argument("--sparsest", type=float, default=0.0, help="leave out cells of fewer pulses per m2")
    parser.add_argument("--densest", type=float, default=math.inf, help="leave out cells of more pulses per m2")
    parser.add_argument(
        "--densest-faithful", type=float, default=DENSEST_FAITHFUL, help="the same of the faithful presets alone"
    )
    parser.add_argument("--jobs", type=int, default=2, help="cells at a time")
    arguments = parser.parse_args()
    place = Workplace(root=arguments.out)
    variants = [Variant.parse(text) for text in arguments.methods or ()] or all_variants(with_faithful=True)
    wanted = []
    for cell in reversed(CELLS):  # the dense ones first: they take longest
        if arguments.sparsest <= cell.density_per_m2 <= arguments.densest:
            is_sparse = cell.density_per_m2 <= arguments.densest_faithful
            ways = [variant for variant in variants if is_sparse or variant.preset != "faithful"]
            wanted += [(entry, ways) for entry in sweep_entries(arguments.split, [cell])]
    faults = measure_all(wanted, place, arguments.jobs)
    found = {
        one.label: sweep_qualities(one, place, [entry for entry, ways in wanted if one in ways]) for one in variants
    }
    found = {label: qualities for label, qualities in found.items() if qualities}
    reported = document(found, arguments.split)
    (place.root / "sweep_limits.md").write_text(reported, encoding="utf-8")
    draw(found, arguments.plot or place.root / "sweep_limits.png")
    print(reported)
    print("\n".join(faults), file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
