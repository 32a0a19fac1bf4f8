"""Buckets of points, as a window reads them."""

import os
import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.runtime.scratch.folder import POINT
from pipeline.runtime.stages.window_points import bucket


def points(count: int) -> np.ndarray:
    found = np.zeros(count, POINT)
    found["x"] = np.arange(count)
    return found


@pytest.fixture
def few_files() -> Iterator[int]:
    """Files have numbers below this one: a process that has so many open can open no more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # the lowest free number may be a gap among those that earlier tests hold
    most = max(int(number) for number in os.listdir("/dev/fd")) + 20  # noqa: PTH208 - names of numbers
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    yield most
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_tile_may_have_more_small_buckets_than_a_process_may_open_files(tmp_path: Path, few_files: int) -> None:
    path = tmp_path / "0.bin"
    points(3).tofile(path)
    held = [bucket(path) for _ in range(few_files + 1)]
    assert all(np.array_equal(found, points(3)) for found in held)


@pytest.mark.parametrize("count", [0, 1, 19_999, 20_000, 30_000])
def test_small_and_large_buckets_hold_the_same(tmp_path: Path, count: int) -> None:
    path = tmp_path / "0.bin"
    points(count).tofile(path)
    assert np.array_equal(bucket(path), points(count))
