"""The list of kernels to compile ahead, its signatures, and compiling them only once."""

import functools
import json
import os
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest

from pipeline.compiler import Kernel, store, storing, warm_up
from pipeline.compiler.kernel import kernel_named
from pipeline.compiler.signatures import from_json, to_json
from pipeline.errors import RunError


class Pair(NamedTuple):
    """A named tuple that a kernel could take."""

    first: float
    second: float


@pytest.mark.parametrize(
    "value",
    [
        *(1, 2.5, True, None),
        np.zeros((3, 2)),
        np.zeros((3, 2)).T,
        np.zeros((4, 4), np.int32)[::2, ::2],
        np.zeros(3, bool),
        np.zeros(3, [("x", "<i8"), ("kind", "u1")]),
        (1, 2.0),
        (1.0, 2.0),
        (np.zeros(3), (1, 2)),
        Pair(1.0, 2.0),
        np.broadcast_to(1.0, 3),  # a read-only array
    ],
)
def test_signatures_survive_json(value: object) -> None:
    kind = numba.typeof(value)
    assert from_json(json.loads(json.dumps(to_json(kind)))) == kind


def test_a_type_without_a_json_form_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="unicode_type"):
        to_json(numba.typeof("text"))


def test_all_listed_kernels_exist_with_as_many_parameters() -> None:
    for one in warm_up.listed():
        kernel = kernel_named(one.kernel)
        assert isinstance(kernel, Kernel), one.kernel
        assert len(one.arguments) <= kernel.py_func.__code__.co_argcount, one.kernel


def test_no_kernel_is_listed_twice() -> None:
    kernels = [(one.kernel, json.dumps(one.arguments)) for one in warm_up.listed()]
    assert len(kernels) == len(set(kernels))


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
    progress: list[tuple[int, int, float]] = []
    warm_up.compile_kernels(lightest, processes=2, on_progress=lambda *figures: progress.append(figures))
    assert [total for _, total, _ in progress] == [3] * len(progress)
    assert [done for done, _, _ in progress] == sorted(done for done, _, _ in progress)
    assert progress[-1] == (3, 3, 0.0)
    names = {path.name.split(".cpython")[0] for path in tmp_path.glob(f"*{store.ENDING}")}
    assert names >= {one.kernel.replace(":", ".") for one in lightest}

    def times() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in tmp_path.glob(f"*{store.ENDING}")}

    before = times()
    assert warm_up.compile_kernels(lightest, processes=2) == 3
    assert times() == before


@pytest.mark.slow
def test_compiling_ends_when_it_is_cancelled_and_each_process_begins_as_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    kernels = warm_up.listed()[-6:]
    progress: list[tuple[int, int, float]] = []
    done = warm_up.compile_kernels(
        kernels,
        processes=1,
        on_progress=lambda *figures: progress.append(figures),
        cancelled=lambda: any(finished for finished, _, _ in progress),
        start=functools.partial(os.mkdir, "begun"),
    )
    assert 1 <= done < len(kernels)
    assert (tmp_path / "begun").is_dir()
    assert all(left_s > 0.0 for _, _, left_s in progress)


def test_a_folder_of_kernels_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ship(folder: Path, _is_current: object) -> int:
        folder.mkdir(exist_ok=True)
        return 1

    monkeypatch.setattr(storing, "ship", ship)
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(RunError, match=rf"{file} cannot be written: File exists\. Give another --into"):
        warm_up.ship(file)
