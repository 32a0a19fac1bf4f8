"""What is taken for a house, and houses that are seen badly: small scenes of one kind each, under several surveys.

A scene has a kind (`KINDS`), which says what is in it: stands of trees without any building, houses seen well, half
or sparsely, in strips that disagree, behind trees or under glass, bridges and decks. Each kind has a survey of every
row of `SURVEYS`, from 0.3 to 30 pulses per m2, with one, two and up to five returns per pulse. Each pair is a cell
with a layout of its own, drawn from the seed and the cell's name.
"""

from __future__ import annotations

import dataclasses
import functools
import zlib
from collections.abc import Callable, Mapping

import numpy as np

from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.strips import Returns, ScannerSettings
from pipeline.ruler.simulation.sweep import Cell
from pipeline.ruler.simulation.trust_houses import (
    glass_houses,
    half_seen_in_shadow,
    half_seen_when_wet,
    houses,
    small_bridges,
    terraces,
    trees_at_houses,
)
from pipeline.ruler.simulation.trust_trees import STANDS, stand

SIDE_M, DENSE_SIDE_M = 80.0, 50.0
"""About how wide a scene is; the second for more than `DENSE_PER_M2`, so that all scenes take about the same time."""
DENSE_PER_M2 = 11.0
SCANNER = ScannerSettings(altitude_m=700.0, strip_spacing_m=60.0, strip_overlap=0.3)


SURVEYS = (
    Cell(density_per_m2=0.3, noise_m=0.05, returns=Returns.FIVE),
    Cell(density_per_m2=0.8, noise_m=0.08, returns=Returns.LAST),
    Cell(density_per_m2=1.8, noise_m=0.05, returns=Returns.FIRST),
    Cell(density_per_m2=2.5, noise_m=0.08, returns=Returns.FIRST_AND_LAST, with_classes=True),
    Cell(density_per_m2=4.0, noise_m=0.03, returns=Returns.FIVE),
    Cell(density_per_m2=6.0, noise_m=0.05, returns=Returns.LAST, with_classes=True),
    Cell(density_per_m2=10.0, noise_m=0.02, returns=Returns.FIRST),
    Cell(density_per_m2=14.0, noise_m=0.03, returns=Returns.FIVE, with_classes=True),
    Cell(density_per_m2=30.0, noise_m=0.02, returns=Returns.FIRST_AND_LAST),
)
SPARSE_SURVEYS = tuple(
    Cell(density_per_m2=density, noise_m=noise, returns=returns, with_classes=density == 0.7)
    for density, noise in ((0.3, 0.05), (0.5, 0.1), (0.7, 0.05), (1.0, 0.03))
    for returns in (Returns.FIRST, Returns.FIVE)
)
STRIP_SURVEYS = tuple(
    Cell(density_per_m2=density, noise_m=0.03, returns=returns, strip_step_m=step, with_classes=step == 0.6)
    for density, returns, steps in ((1.5, Returns.FIRST, (0.2, 0.45, 1.0)), (5.0, Returns.FIVE, (0.3, 0.6, 0.9, 1.5)))
    for step in steps
)
NOISY_SURVEYS = (
    Cell(density_per_m2=1.5, noise_m=0.15, returns=Returns.FIRST),
    Cell(density_per_m2=2.5, noise_m=0.2, returns=Returns.FIRST_AND_LAST),
    Cell(density_per_m2=4.0, noise_m=0.15, returns=Returns.FIVE),
    Cell(density_per_m2=10.0, noise_m=0.2, returns=Returns.LAST, with_classes=True),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """What is in a scene, and how it is flown over."""

    make: Callable[[np.random.Generator, float], Scene]
    """Scene from random numbers and about the width of it in metres."""
    surveys: tuple[Cell, ...] = SURVEYS
    """Its cells, without their kind."""
    scanner: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Settings of the scanner that differ from `SCANNER`."""


_LOW_FLIGHT = {"altitude_m": 110.0, "strip_spacing_m": 90.0, "strip_overlap": 0.15}
"""One strip in the middle of the scene, whose beams lean by 20 deg where the houses are: tall things throw shadows."""
_TWO_STRIPS = {"strip_spacing_m": 50.0, "strip_overlap": 1.0}
"""Most of the scene lies under two strips."""

KINDS: Mapping[str, Kind] = {
    "houses": Kind(make=houses),
    "houses_and_trees": Kind(make=trees_at_houses),
    "half_seen_wet": Kind(make=half_seen_when_wet),
    "half_seen_shadow": Kind(make=half_seen_in_shadow, scanner=_LOW_FLIGHT),
    "sparse_houses": Kind(make=houses, surveys=SPARSE_SURVEYS),
    "strips_apart": Kind(make=houses, surveys=STRIP_SURVEYS, scanner=_TWO_STRIPS),
    "bridges": Kind(make=small_bridges),
    "decks": Kind(make=terraces),
    "glass": Kind(make=glass_houses),
    **{name: Kind(make=functools.partial(stand, rule)) for name, rule in STANDS.items()},
    "noisy_houses_and_trees": Kind(make=trees_at_houses, surveys=NOISY_SURVEYS),
    **{
        f"noisy_{name}": Kind(make=functools.partial(stand, STANDS[name]), surveys=NOISY_SURVEYS)
        for name in ("broadleaf_forest", "young_forest")
    },
}
"""The kinds of scenes by name."""


CELLS = tuple(
    dataclasses.replace(survey, kind=name, settings=kind.scanner)
    for name, kind in KINDS.items()
    for survey in kind.surveys
)
"""All scenes of a draw."""
_CELL_OF = {cell.key: cell for cell in CELLS}


def trust(seed: int, key: str) -> Scene:
    """The scene of a cell; every pair of seed and cell has a layout of its own."""
    cell = _CELL_OF[key]
    random = np.random.default_rng([seed, 0x7A, zlib.crc32(key.encode())])
    side = DENSE_SIDE_M if cell.density_per_m2 > DENSE_PER_M2 else SIDE_M
    return dataclasses.replace(KINDS[cell.kind].make(random, side), name="trust")
