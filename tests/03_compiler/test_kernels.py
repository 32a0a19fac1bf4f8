"""Kernels: what is compiled, what is kept, and what makes a kept kernel stale, each in fresh processes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_name

from pipeline.compiler import frame_room
from pipeline.compiler.fingerprint import _Own
from pipeline.compiler.store import ENDING, LIST, Stored

CALLEE = """
from pipeline.compiler import kernel

FACTOR = {factor}

@kernel
def scaled(x):
    return x * FACTOR

@kernel
def unrelated(x):
    return x - {minus}
"""
CALLER = """
import numpy as np
from callee import scaled, unrelated
from pipeline.compiler import kernel

@kernel
def total(values):
    result = 0.0
    for value in values:
        result += scaled(value)
    return result

@kernel
def halves(values):
    return values.copy(), len(values) // 2

@kernel
def first_of_halves(values):
    return halves(values)[0][0]
"""
COUNTED = """
import json, warnings
import numpy as np
from numba.core import event

class Counting(event.Listener):
    def __init__(self):
        self.seen = []
    def on_start(self, told):
        self.seen.append(told.data["dispatcher"].py_func.__name__)
    def on_end(self, told):
        pass

counting = Counting()
event.register("numba:compile", counting)
import caller, callee
"""
VALUES = "np.array([1.0, 2.0, 4.0])"


class Sources:
    """Two files with kernels, and a folder of what was compiled of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.kept = folder / "kept"
        self.write()

    def write(self, *, factor: str = "3.0", minus: str = "1.0", end: str = "") -> None:
        (self.folder / "callee.py").write_text(CALLEE.format(factor=factor, minus=minus) + end)
        (self.folder / "caller.py").write_text(CALLER)

    def start(self, words: str, **environment: str) -> subprocess.Popen[str]:
        path = os.pathsep.join([str(self.folder), *filter(None, sys.path)])
        # an edit within a second, of no other length, is one that Python's own cache does not see
        own = {"NUMBA_CACHE_DIR": str(self.kept), "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        env = {**os.environ, **own, **environment}
        code = f"{COUNTED}\n{words}\nprint(json.dumps([told, counting.seen]))"
        return subprocess.Popen(
            [sys.executable, "-c", code], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def run(self, words: str, **environment: str) -> tuple[object, list[str], str]:
        """What the words leave in `told`, the functions of ours that were compiled, and what was warned of."""
        said, warned = (process := self.start(words, **environment)).communicate()
        assert process.returncode == 0, warned
        told, compiled = json.loads(said)
        return told, [name for name in compiled if name in {"total", "scaled", "unrelated", "halves"}], warned

    def held(self) -> dict[str, Stored]:
        """What is kept, by kernel."""
        found = {}
        for path in self.kept.glob(f"*{ENDING}"):
            content = path.read_bytes()
            stored = Stored.unpacked(content, Stored.fingerprint_of(content))
            assert stored is not None
            found[path.name.split(".cpython")[0]] = stored
        return found


@pytest.fixture
def sources(tmp_path: Path) -> Sources:
    return Sources(tmp_path)


def test_a_kernel_is_compiled_once_and_loaded_by_the_next_process(sources: Sources) -> None:
    assert sources.run(f"told = caller.total({VALUES})")[:2] == (21.0, ["total", "scaled"])
    assert sources.run(f"told = caller.total({VALUES})")[:2] == (21.0, [])


def test_an_edit_of_a_callee_in_another_file_recompiles_its_caller_and_nothing_else(sources: Sources) -> None:
    both = f"told = [caller.total({VALUES}), caller.halves({VALUES})[1]]"
    assert sources.run(both)[:2] == ([21.0, 1], ["total", "scaled", "halves"])
    sources.write(factor="5.0")
    assert sources.run(both)[:2] == ([35.0, 1], ["total", "scaled"])


def test_touching_a_file_commenting_it_or_editing_another_kernel_in_it_recompiles_nothing(sources: Sources) -> None:
    sources.run(f"told = caller.total({VALUES})")
    sources.write(minus="2.0", end="\n# a remark\n")
    (sources.folder / "caller.py").write_text("\n# moved down\n\n" + CALLER)
    for path in sources.folder.glob("call*.py"):
        os.utime(path, (1e9, 1e9))
    assert sources.run(f"told = caller.total({VALUES})")[:2] == (21.0, [])


TYPES = """
import enum
from typing import NamedTuple
from pipeline.compiler import kernel

class Kind(enum.IntEnum):
    ROOF = {roof}

class Pair(NamedTuple):
    {one}: float
    {other}: float

@kernel
def kind_of(x):
    return x + Kind.ROOF

@kernel
def low_of(pair):
    return pair.low

@kernel(inline="always")
def after(x):
    return x + {step}

@kernel
def twice_after(x):
    return after(after(x))

@kernel
def all_but_first(values):
    return values[1:].sum()
"""


@pytest.mark.slow
def test_a_new_value_of_an_enum_and_other_fields_of_a_tuple_make_kernels_anew(sources: Sources) -> None:
    path = sources.folder / "caller.py"
    words = "told = [caller.kind_of(1), caller.low_of(caller.Pair(2.0, 3.0)), caller.twice_after(1)]"
    path.write_text(TYPES.format(roof=4, one="low", other="high", step=1))
    assert sources.run(words)[0] == [5, 2.0, 3]
    path.write_text(TYPES.format(roof=6, one="high", other="low", step=10))
    assert sources.run(words)[0] == [7, 3.0, 21]


@pytest.mark.slow
def test_what_is_inlined_is_not_compiled_and_has_no_file(sources: Sources) -> None:
    (sources.folder / "caller.py").write_text(TYPES.format(roof=4, one="low", other="high", step=1))
    words = "told = [caller.twice_after(1), 'after' in counting.seen, 'twice_after' in counting.seen]"
    assert sources.run(words)[0] == [3, False, True]
    assert list(sources.held()) == ["caller.twice_after"]
    assert sources.run(f"{words}[:1] + [caller.after(1)]")[0] == [3, 2]


def test_constants_of_every_kind_have_a_fingerprint() -> None:
    own = _Own(lambda _: None)
    values = (
        slice(1, None),
        slice(None, 1),
        (slice(None), 0),
        (0, slice(None)),
        ...,
        None,
        1,
        1.0,
        "1",
        b"1",
        np.int8(1),
    )
    told = [own.value(value) for value in values]
    assert len(set(told)) == len(values)


def test_a_deep_recursion_lies_in_one_frame_of_python() -> None:
    assert frame_room._from_large_frame.__code__.co_stacksize == frame_room._SLOTS


@pytest.mark.slow
def test_what_only_kernels_call_has_no_machine_code_until_python_calls_it(sources: Sources) -> None:
    sources.run(f"told = caller.total({VALUES})")
    assert {name: bool(stored.machine_code) for name, stored in sources.held().items()} == {
        "caller.total": True,
        "callee.scaled": False,
    }
    # its code is there, so it is not compiled once more for Python
    assert sources.run(f"caller.total({VALUES}); told = callee.scaled(2.0)")[0] == 6.0
    assert sources.held()["callee.scaled"].machine_code


@pytest.mark.slow
def test_one_process_calls_a_kernel_from_kernels_and_from_python_in_any_order(sources: Sources) -> None:
    again = "from pipeline.compiler import kernel; other = kernel(lambda x: callee.scaled(x) + 1.0)"
    kernels_first = f"{again}; told = [caller.total({VALUES}), callee.scaled(2.0), other(2.0)]"
    assert sources.run(kernels_first)[0] == [21.0, 6.0, 7.0]
    both = f"told = [callee.scaled(2.0), caller.total({VALUES})]"
    assert Sources.run(sources, both, NUMBA_CACHE_DIR=str(sources.folder / "other"))[0] == [6.0, 21.0]


@pytest.mark.slow
@pytest.mark.parametrize("order", ["python, kernel, python", "kernel, python", "python, kernel"])
def test_loaded_kernels_give_python_arrays_whoever_calls_them_first(sources: Sources, order: str) -> None:
    python, called = f"caller.halves({VALUES})[0].sum()", f"caller.first_of_halves({VALUES})"
    sources.run(f"told = [{called}, {python}]")
    words = [{"python": python, "kernel": called}[name] for name in order.split(", ")]
    told, compiled, _ = sources.run(f"told = [{', '.join(words)}]")
    assert told == [{"python": 7.0, "kernel": 1.0}[name] for name in order.split(", ")]
    assert compiled == []


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["cut", "empty", "other"])
def test_a_damaged_file_is_compiled_anew(sources: Sources, damage: str) -> None:
    sources.run(f"told = caller.total({VALUES})")
    (path,) = sources.kept.glob("caller.total*")
    whole = path.read_bytes()
    path.write_bytes({"cut": whole[:-1], "empty": b"", "other": b"x" + whole[1:]}[damage])
    assert sources.run(f"told = caller.total({VALUES})")[:2] == (21.0, ["total"])
    assert path.read_bytes() != b""


@pytest.mark.slow
def test_plain_numba_computes_the_same_and_keeps_its_own_files(sources: Sources) -> None:
    words = f"told = [caller.total({VALUES}), caller.halves({VALUES})[1], callee.scaled(2.0)]"
    ours = sources.run(words)[0]
    assert sources.run(words, GABLEWORK_PLAIN_NUMBA="1")[0] == ours
    assert list(sources.kept.rglob("*.nbc"))


@pytest.mark.slow
def test_plain_numba_follows_an_edit_of_a_callee_in_another_file(sources: Sources) -> None:
    for factor, total in (("3.0", 21.0), ("5.0", 35.0), ("5.0", 35.0)):
        sources.write(factor=factor)
        assert sources.run(f"told = caller.total({VALUES})", GABLEWORK_PLAIN_NUMBA="1")[0] == total
    assert sources.run(f"told = caller.total({VALUES})", GABLEWORK_PLAIN_NUMBA="1")[1] == []


@pytest.mark.slow
def test_a_numba_that_is_not_known_is_used_plainly_and_that_is_said(sources: Sources) -> None:
    words = f"import pipeline.compiler.backend as backend; backend.KNOWN = ('0.1.',); told = caller.total({VALUES})"
    told, _, warned = sources.run(words)
    assert told == 21.0
    assert warned.count("is not one of those that gablework knows") == 1
    assert sources.held() == {}


def test_the_numba_of_the_locks_is_known() -> None:
    from pipeline.compiler.backend import is_known

    assert is_known()


@pytest.mark.slow
def test_without_numba_kernels_are_plain_functions(sources: Sources) -> None:
    told, compiled, _ = sources.run(f"told = float(caller.total({VALUES}))", NUMBA_DISABLE_JIT="1")
    assert (told, compiled) == (21.0, [])


@pytest.mark.slow
def test_two_processes_that_meet_no_kernels_compile_each_once(sources: Sources) -> None:
    started = [sources.start(f"told = caller.total({VALUES})") for _ in range(2)]
    compiled: list[str] = []
    for process in started:
        said, warned = process.communicate()
        assert process.returncode == 0, warned
        told, seen = json.loads(said)
        assert told == 21.0
        compiled += [name for name in seen if name in {"total", "scaled"}]
    assert sorted(compiled) == ["scaled", "total"]


# ------------------------------------------------------------------------------------------------ shipped kernels


def ship(sources: Sources) -> Path:
    """Compile, and leave the kernels as a package has them."""
    folder = sources.folder / "shipped"
    words = f"caller.total({VALUES})\nfrom pathlib import Path\nfrom pipeline.compiler.warm_up import ship\n"
    (sources.kept).mkdir(exist_ok=True)
    (sources.kept / f"caller.gone.{sys.implementation.cache_tag}-x{ENDING}").write_bytes(b"of an earlier version")
    assert sources.run(f"{words}told = ship(Path({str(folder)!r}))")[0] == 2
    shutil.rmtree(sources.kept)
    return folder


@pytest.mark.slow
def test_shipped_kernels_are_loaded_and_nothing_is_written(sources: Sources) -> None:
    folder = ship(sources)
    told, compiled, warned = sources.run(f"told = caller.total({VALUES})", GABLEWORK_KERNELS=str(folder))
    assert (told, compiled, warned) == (21.0, [], "")
    assert sources.held() == {}


@pytest.mark.slow
def test_a_shipped_kernel_that_only_kernels_called_is_compiled_once_for_python_and_kept(sources: Sources) -> None:
    folder = str(ship(sources))
    for _ in range(2):
        assert sources.run("told = callee.scaled(2.0)", GABLEWORK_KERNELS=folder)[0] == 6.0
        assert sources.held()["callee.scaled"].machine_code
    assert sources.run("told = callee.scaled(2.0)", GABLEWORK_KERNELS=folder)[:2] == (6.0, [])


@pytest.mark.slow
def test_a_shipped_file_whose_hash_is_not_listed_is_not_loaded(sources: Sources) -> None:
    folder = ship(sources)
    (path,) = folder.glob("caller.total*")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    told, compiled, warned = sources.run(f"told = caller.total({VALUES})", GABLEWORK_KERNELS=str(folder))
    assert (told, compiled) == (21.0, ["total"])
    assert f"is not the file that {LIST} names" in warned


@pytest.mark.slow
def test_kernels_that_do_not_fit_the_processor_are_compiled_and_that_is_said(sources: Sources) -> None:
    folder = ship(sources)
    environment = {"GABLEWORK_KERNELS": str(folder), "NUMBA_CPU_NAME": get_host_cpu_name()}
    told, compiled, warned = sources.run(f"told = caller.total({VALUES})", **environment)
    assert (told, compiled) == (21.0, ["total", "scaled"])
    assert "were made for another Python, numba or processor" in warned


@pytest.mark.slow
def test_where_nothing_can_be_written_kernels_are_compiled_and_that_is_said(sources: Sources) -> None:
    (sources.folder / "file").write_text("")
    nowhere = str(sources.folder / "file" / "kernels")
    told, compiled, warned = sources.run(f"told = caller.total({VALUES})", NUMBA_CACHE_DIR=nowhere)
    assert (told, compiled) == (21.0, ["total", "scaled"])
    assert f"cannot be kept in {nowhere}" in warned
