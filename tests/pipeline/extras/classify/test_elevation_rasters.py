"""Terrain and surface at the cells of a raster: each kernel against a slow twin or an independent library."""

import numpy as np
from scipy import ndimage

from pipeline.extras.classify.elevation_rasters import closed, columns_of, filled, highest_in_cells, terrain_at
from pipeline.terrain.lattice import NO_DATA


def test_terrain_is_bilinear_between_the_centres_of_the_lattice() -> None:
    rows, columns = np.indices((6, 8))
    plane = (1000 + 300 * columns - 200 * rows).astype(np.int32)
    x, y = np.array([12_500, 13_000, 14_250]), np.array([-3_500, -2_900])
    found = terrain_at(x, y, plane, 10, -5)
    expected = 1000 + 0.3 * (x[None, :] - 10_500) - 0.2 * (y[:, None] + 4_500)
    assert found.shape == (2, 3)
    assert np.abs(found - expected).max() <= 0.5


def test_no_terrain_is_no_value() -> None:
    nothing = np.full((4, 4), NO_DATA, np.int32)
    assert np.isnan(terrain_at(np.array([2000]), np.array([2000]), nothing, 0, 0)).all()


def test_gaps_are_closed_as_scipy_closes_them() -> None:
    rng = np.random.default_rng(4)
    mask = rng.random((60, 50)) < 0.05
    for cells in (1, 2, 3):
        twin = ndimage.binary_closing(np.pad(mask, 20), np.ones((2 * cells + 1,) * 2))[20:-20, 20:-20]
        inner = (slice(2 * cells, -2 * cells),) * 2
        assert (closed(mask, cells)[inner] == twin[inner]).all()


def test_the_highest_point_of_a_cell_counts() -> None:
    rng = np.random.default_rng(6)
    column, row, z = rng.integers(-2, 8, 500), rng.integers(-2, 6, 500), rng.integers(0, 9999, 500)
    found = highest_in_cells(column, row, z, (5, 7))
    for r in range(5):
        for c in range(7):
            here = z[(column == c) & (row == r)]
            assert found[r, c] == here.max() if len(here) else np.isnan(found[r, c])


def test_empty_cells_are_filled_from_the_nearest_ring_alone() -> None:
    rng = np.random.default_rng(3)
    surface = np.where(rng.random((25, 30)) < 0.06, rng.uniform(0, 9, (25, 30)), np.nan)
    wanted = rng.random((25, 30)) < 0.8
    found = filled(surface, wanted, 4)
    rows, columns = np.nonzero(~np.isnan(surface))
    for r in range(25):
        for c in range(30):
            if not wanted[r, c] or not np.isnan(surface[r, c]):
                assert np.array_equal(found[r, c], surface[r, c], equal_nan=True)
                continue
            ring = np.maximum(abs(rows - r), abs(columns - c))
            near = (ring == ring.min()) & (ring <= 4)
            weights = 1.0 / ((rows[near] - r) ** 2 + (columns[near] - c) ** 2)
            if near.any():
                assert abs(found[r, c] - np.average(surface[rows[near], columns[near]], weights=weights)) < 1e-9
            else:
                assert np.isnan(found[r, c])


def test_columns_begin_at_the_origin_of_the_crs() -> None:
    assert columns_of(np.array([-501, -500, -1, 0, 499, 500]), 500.0).tolist() == [-2, -1, -1, 0, 0, 1]
