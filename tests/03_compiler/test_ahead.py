"""Kernels compiled ahead: the list, how it writes signatures, and that what it compiles is not compiled again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest

from pipeline.compiler import Kernel, store, warm_up
from pipeline.compiler.signatures import kernel_named, read, written


class Pair(NamedTuple):
    """A named tuple that a kernel could take."""

    first: float
    second: float


@pytest.mark.parametrize(
    "value",
    [
        1,
        2.5,
        True,
        None,
        np.zeros((3, 2)),
        np.zeros((3, 2)).T,
        np.zeros((4, 4), np.int32)[::2, ::2],
        np.zeros(3, bool),
        np.zeros(3, [("x", "<i8"), ("kind", "u1")]),
        (1, 2.0),
        (1.0, 2.0),
        (np.zeros(3), (1, 2)),
        Pair(1.0, 2.0),
    ],
)
def test_signatures_survive_being_written(value: object) -> None:
    kind = numba.typeof(value)
    assert read(json.loads(json.dumps(written(kind)))) == kind


def test_read_only_arrays_stay_read_only() -> None:
    values = np.zeros(3)
    values.flags.writeable = False
    kind = numba.typeof(values)
    assert read(written(kind)) == kind
    assert not read(written(kind)).mutable


def test_what_cannot_be_written_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="unicode_type"):
        written(numba.typeof("text"))


def test_all_listed_kernels_are_there_with_as_many_parameters() -> None:
    for one in warm_up.listed():
        kernel = kernel_named(one.kernel)
        assert isinstance(kernel, Kernel), one.kernel
        assert len(one.arguments) <= kernel.py_func.__code__.co_argcount, one.kernel


def test_no_kernel_is_listed_twice() -> None:
    told = [(one.kernel, json.dumps(one.arguments)) for one in warm_up.listed()]
    assert len(told) == len(set(told))


def test_the_heaviest_kernels_come_first() -> None:
    for groups in (None, ["reconstruct"], warm_up.groups()):
        weights = [one.weight for one in warm_up.listed(groups)]
        assert weights == sorted(weights, reverse=True)
        assert weights[0] > weights[-1]


@pytest.mark.slow
def test_kernels_are_compiled_in_other_processes_with_progress_and_never_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    lightest = warm_up.listed()[-3:]
    told: list[tuple[int, int, float]] = []
    warm_up.compile_kernels(lightest, processes=2, on_progress=lambda *words: told.append(words))
    assert [words[:2] for words in told] == [(1, 3), (2, 3), (3, 3)]
    assert told[-1][2] == 0.0
    names = {path.name.split(".cpython")[0] for path in tmp_path.glob(f"*{store.ENDING}")}
    assert names >= {one.kernel.replace(":", ".") for one in lightest}

    def kept() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in tmp_path.glob(f"*{store.ENDING}")}

    before = kept()
    assert warm_up.compile_kernels(lightest, processes=2) == 3
    assert kept() == before
