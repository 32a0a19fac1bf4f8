"""Where a quality holds a level, between the cells of the sweep."""

import math

import numpy as np
import pytest

from benchmarks.sweep_limits import (
    HeldRange,
    along_density,
    along_noise,
    density_table,
    draw,
    held_ranges,
    noise_table,
    reported_ranges,
)

DENSITIES = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 50.0]
NOISES = [0.02, 0.05, 0.10]


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("logarithmic", [True, False])
def test_the_ranges_hold_what_a_fine_interpolation_says(seed: int, logarithmic: bool) -> None:
    random = np.random.default_rng(seed)
    qualities = random.uniform(0.2, 1.0, len(DENSITIES))
    forward = np.log if logarithmic else np.asarray
    ranges = held_ranges(DENSITIES, qualities.tolist(), 0.6, logarithmic=logarithmic)
    fine = np.linspace(forward(DENSITIES[0]), forward(DENSITIES[-1]), 3001)
    quality = np.interp(fine, forward(DENSITIES), qualities)
    places = np.exp(fine) if logarithmic else fine
    held = np.array([any(one.low <= place <= one.high for one in ranges) for place in places])
    sure = np.abs(quality - 0.6) > 1e-9
    assert (held == (quality >= 0.6))[sure].all()


def test_a_level_that_is_met_exactly_at_a_cell_is_held_there() -> None:
    assert held_ranges([1.0, 2.0], [0.8, 0.8], 0.8, logarithmic=True) == [HeldRange(low=-math.inf, high=math.inf)]
    assert held_ranges([1.0, 2.0], [0.7, 0.8], 0.8, logarithmic=True) == [HeldRange(low=2.0, high=math.inf)]


def test_one_cell_alone_is_always_or_never() -> None:
    assert reported_ranges(held_ranges([4.0], [0.9], 0.8, logarithmic=True)) == "always"
    assert reported_ranges(held_ranges([4.0], [0.7], 0.8, logarithmic=True)) == "never"


@pytest.mark.parametrize(
    ("qualities", "reported"),
    [
        ([0.9, 0.9, 0.7], "to 0.075"),
        ([0.7, 0.9, 0.9], "from 0.035"),
        ([0.7, 0.9, 0.7], "0.035 to 0.075"),
        ([0.9, 0.7, 0.9], "to 0.035, from 0.075"),
        ([0.7, 0.6, 0.5], "never"),
        ([0.9, 0.8, 0.9], "always"),
    ],
)
def test_limits_are_reported_in_words(qualities: list[float], reported: str) -> None:
    assert reported_ranges(held_ranges(NOISES, qualities, 0.8, logarithmic=False)) == reported


def test_the_tables_have_a_row_a_method_and_each_its_own_cells() -> None:
    dense = {(density, noise): min(1.0, 0.8 + 0.1 * math.log2(density)) for density in DENSITIES for noise in NOISES}
    sparse = {place: 0.6 for place in dense if place[0] <= 2.0}
    found = {"one": dense, "other": sparse}
    assert along_density(dense, 0.05)[0] == DENSITIES
    assert along_noise(sparse, 50.0) == ([], [])
    rows = [line.strip("| ").split(" | ") for line in density_table(found).splitlines()]
    assert rows[2] == ["one", "from 1.0", "from 1.0", "from 1.0", "always", "always", "always"]
    assert rows[3] == ["other", "never", "never", "never", "always", "always", "always"]
    by_noise = [line.strip("|").split("|") for line in noise_table(found).splitlines()]
    assert [cell.strip() for cell in by_noise[4]] == ["other", "80 %", "never", "never", "never", "", "", "", ""]


def test_the_plot_is_drawn_for_any_number_of_methods(tmp_path) -> None:
    qualities = {(density, noise): 0.5 + 0.4 * noise * density / 5.0 for density in DENSITIES for noise in NOISES}
    for count in (1, 3, 8):
        path = tmp_path / f"{count}.png"
        draw({f"method {number}": qualities for number in range(count)}, path)
        assert 5_000 < path.stat().st_size < 200_000
