"""Keys tell all that an outcome depends on, and nothing else; kept outcomes are whole or not there."""

import dataclasses
import enum
import functools
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import RunCancelledError, RunError
from pipeline.runtime.scratch import outcomes
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.scratch.outcomes import (
    DamagedError,
    InParts,
    OutcomeTask,
    Place,
    brief_of,
    brief_within,
    check_outcome,
    drop_outcomes,
    key_of,
    keys_of,
    part_of,
    result_of,
    run_and_store,
    whole,
)
from pipeline.runtime.stages.tile_content import content_of_window, zone_sums
from pipeline.tiling import MM, Tile, TileGrid


class Colour(enum.Enum):
    """Two names."""

    RED = "red"
    BLUE = "blue"


@dataclasses.dataclass(frozen=True)
class One:
    """A field."""

    value: Any


@dataclasses.dataclass(frozen=True)
class Other:
    """The same field in another class."""

    value: Any


DIFFERENT = [
    *(None, True, False, 0, 1, 1.0, -0.0, 0.0, "1", b"1", "", ()),
    *(("a", "b"), ("ab",), ("a", ("b",)), {"a": 1}, {"a": "1"}, {"b": 1}),
    *(Colour.RED, Colour.BLUE, One(1), Other(1), One((1,)), One(None)),
    *(np.zeros(2), np.zeros(2, np.float32), np.zeros((2, 1)), np.ones(2)),
    *(shapely.Point(0, 0), shapely.Point(0, 0, 0), shapely.box(0, 0, 1, 1)),
]


def test_different_things_have_different_keys() -> None:
    keys = [key_of(value) for value in DIFFERENT]
    assert len(set(keys)) == len(keys)


def test_equal_things_have_equal_keys_in_every_process() -> None:
    value = {"b": (1, 2.5, "x"), "a": One({"k": [1, 2]})}
    program = "from pipeline.runtime.scratch.outcomes import key_of; print(key_of({'a': (1, 2.5), 'b': 'x'}))"
    elsewhere = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert elsewhere.stdout.strip() == key_of({"b": "x", "a": [1, 2.5]})
    assert key_of(value) == key_of(pickle.loads(pickle.dumps(value)))


def test_an_array_is_known_by_all_that_it_holds_also_a_large_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcomes, "_LARGE", 100)
    for count in (3, 200):
        array = np.arange(count)
        other = array.copy()
        other[-1] += 1
        assert key_of(array) == key_of(array[::-1][::-1])
        assert len({key_of(array), key_of(other), key_of(array.view(np.uint64)), key_of(array[:, None])}) == 4


def test_what_is_not_known_is_refused() -> None:
    with pytest.raises(TypeError, match="content of a set is not known"):
        key_of({1, 2})


def records(rng: np.random.Generator, n: int) -> np.ndarray:
    points = np.zeros(n, POINT)
    points["x"], points["y"] = rng.integers(0, 100 * MM, n), rng.integers(0, 100 * MM, n)
    points["z"] = rng.integers(-1000, 50_000, n)
    points["gps_time"] = rng.uniform(0, 1e6, n)
    points["return_number"], points["return_count"] = rng.integers(1, 4, n), 4
    points["classification"], points["source"] = rng.integers(0, 7, n), 3
    return points


GRID = TileGrid(size_mm=100 * MM, halo_mm=20 * MM)


def sums(points: np.ndarray) -> np.ndarray:
    bits = np.ascontiguousarray(points["gps_time"]).view(np.uint64)
    return zone_sums(points, bits, 0, 0, 100 * MM, 100 * MM, GRID.halo_mm)


@settings(deadline=None)  # the first call compiles the kernel
@given(st.integers(0, 2**32 - 1))
def test_content_is_blind_to_order_and_files(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = records(rng, 50)
    cut = int(rng.integers(0, 50))
    np.testing.assert_array_equal(sums(points), sums(rng.permutation(points)))
    np.testing.assert_array_equal(sums(points), sums(points[:cut]) + sums(points[cut:]))
    assert sums(points)[..., 0].sum() == 50


@pytest.mark.parametrize("name", POINT.names)
def test_content_sees_every_attribute(name: str) -> None:
    points = records(np.random.default_rng(1), 20)
    changed = points.copy()
    changed[name][7] += 1
    assert (sums(points) != sums(changed)).any()


def test_a_neighbour_sees_only_the_zones_that_face_it() -> None:
    points = records(np.random.default_rng(2), 500)
    east, middle = Tile(1, 0), Tile(0, 0)
    window = GRID.window(middle)

    def seen(changed: np.ndarray) -> list[object]:
        core = np.zeros((3, 3, 3), np.uint64)
        return content_of_window({middle: core, east: sums(changed)}, GRID, window, middle)

    def moved(where: np.ndarray) -> np.ndarray:
        changed = points.copy()
        changed["z"][where] += 1
        return changed

    assert key_of(seen(moved(points["x"] >= 20 * MM))) == key_of(seen(points))
    assert key_of(seen(moved(points["x"] < 20 * MM))) != key_of(seen(points))


def double(task: int) -> int:
    return 2 * task


def no_space(task: int) -> int:
    raise OSError(28, "No space left on device", "/full")


def outcome_task(folder: Path, function: Callable[[int], int] = double) -> OutcomeTask[int, int, int]:
    scratch = Scratch(str(folder))
    scratch.create()
    place = Place("stage", "unit", "k")
    return OutcomeTask(function=function, task=21, place=place, scratch=scratch, brief=whole, stage="split")


def test_an_outcome_is_stored_with_its_brief(tmp_path: Path) -> None:
    work = dataclasses.replace(outcome_task(tmp_path), brief=str)
    assert run_and_store(work).brief == "42"
    assert (brief_of(work.scratch, work.place), result_of(work.scratch, work.place)) == ("42", 42)
    for wanted, left in (([work.place], ["k"]), ([], [])):
        drop_outcomes(work.scratch, "stage", wanted)
        assert keys_of(work.scratch, "stage", "unit") == left
    with pytest.raises(RunCancelledError, match="is gone"):
        result_of(work.scratch, work.place)


def in_parts(task: int) -> InParts[int]:
    return InParts(parts=("first" * task, "second" * task, "third" * task), brief=3)


def test_the_parts_of_a_result_are_read_alone(tmp_path: Path) -> None:
    work = dataclasses.replace(outcome_task(tmp_path), function=in_parts, brief=brief_within)
    assert run_and_store(work).brief == 3
    path = tmp_path / work.place.name
    content = path.read_bytes()
    for number, word in enumerate(("first", "second", "third")):
        # with the other parts damaged
        piece = pickle.dumps(word * 21, protocol=pickle.HIGHEST_PROTOCOL)
        at = content.index(piece)
        begin = content.index(pickle.dumps("first" * 21, protocol=pickle.HIGHEST_PROTOCOL))
        path.write_bytes(content[:begin] + b"x" * (at - begin) + piece + b"x" * (len(content) - at - len(piece)))
        assert part_of(work.scratch, work.place, number) == word * 21
        assert brief_of(work.scratch, work.place) == 3
    path.unlink()
    with pytest.raises(RunCancelledError, match="is gone"):
        part_of(work.scratch, work.place, 0)


@pytest.mark.parametrize("function", [double, in_parts])
def test_a_damaged_outcome_is_never_read(tmp_path: Path, function: Callable[[int], Any]) -> None:
    work = dataclasses.replace(outcome_task(tmp_path), function=function, brief=str)
    brief = run_and_store(work).brief
    path = tmp_path / work.place.name
    content = path.read_bytes()
    flipped = [content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :] for k in range(len(content))]
    for damaged in (*flipped, *(content[:k] for k in range(len(content))), bytes(len(content)), content + b"x"):
        path.write_bytes(damaged)
        with pytest.raises(DamagedError, match="is damaged"):
            check_outcome(work.scratch, work.place)
        for read in (brief_of, functools.partial(part_of, number=1)):
            try:
                found = read(work.scratch, work.place)
            except DamagedError:
                continue
            assert found in {brief, "second" * 21}  # what is damaged lies elsewhere


def test_a_full_disk_names_stage_place_and_fix(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"/full: No space left on device, in stage split\. Free space"):
        run_and_store(outcome_task(tmp_path, no_space))
    assert not list(tmp_path.rglob("k*"))


def test_a_cancelled_run_stores_nothing(tmp_path: Path) -> None:
    work = outcome_task(tmp_path)
    work.scratch.cancel()
    with pytest.raises(RunCancelledError):
        run_and_store(work)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.name != "cancelled"]
