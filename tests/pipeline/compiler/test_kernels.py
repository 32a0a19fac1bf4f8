"""Which kernels are compiled and stored, and what makes a stored kernel stale, each in fresh processes."""

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

@kernel
def first_plus_one(values):
    return first_of_halves(values) + 1.0
"""
COUNTED = """
import json, warnings
import numpy as np
from numba.core import event

class Counting(event.Listener):
    def __init__(self):
        self.seen = []
    def on_start(self, started):
        self.seen.append(started.data["dispatcher"].py_func.__name__)
    def on_end(self, ended):
        pass

counting = Counting()
event.register("numba:compile", counting)
import caller, callee
"""
VALUES = "np.array([1.0, 2.0, 4.0])"


class Sources:
    """Two files with kernels, and a folder of the compiled kernels."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cache = folder / "cache"
        self.write()

    def write(self, *, factor: str = "3.0", minus: str = "1.0", end: str = "") -> None:
        (self.folder / "callee.py").write_text(CALLEE.format(factor=factor, minus=minus) + end)
        (self.folder / "caller.py").write_text(CALLER)

    def start(self, words: str, **environment: str) -> subprocess.Popen[str]:
        path = os.pathsep.join([str(self.folder), *filter(None, sys.path)])
        # Python's own cache misses an edit within a second that keeps the length
        own = {"NUMBA_CACHE_DIR": str(self.cache), "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        env = {**os.environ, **own, **environment}
        code = f"{COUNTED}\n{words}\nprint(json.dumps([result, counting.seen]))"
        return subprocess.Popen(
            [sys.executable, "-c", code], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def run(self, words: str, **environment: str) -> tuple[object, list[str], str]:
        """Run code; returns its `result`, the compiled functions of these files, and the warnings."""
        printed, warned = (process := self.start(words, **environment)).communicate()
        assert process.returncode == 0, warned
        result, compiled = json.loads(printed)
        return result, [name for name in compiled if name in {"total", "scaled", "unrelated", "halves"}], warned

    def stored(self) -> dict[str, Stored]:
        """The stored kernels by name."""
        found = {}
        for path in self.cache.glob(f"*{ENDING}"):
            content = path.read_bytes()
            stored = Stored.from_bytes(content, Stored.fingerprint_of(content))
            assert stored is not None
            found[path.name.split(".cpython")[0]] = stored
        return found


@pytest.fixture
def sources(tmp_path: Path) -> Sources:
    return Sources(tmp_path)


def test_a_kernel_is_compiled_once_and_loaded_by_the_next_process(sources: Sources) -> None:
    assert sources.run(f"result = caller.total({VALUES})")[:2] == (21.0, ["total", "scaled"])
    assert sources.run(f"result = caller.total({VALUES})")[:2] == (21.0, [])


def test_an_edit_of_a_callee_in_another_file_recompiles_its_caller_and_nothing_else(sources: Sources) -> None:
    both = f"result = [caller.total({VALUES}), caller.halves({VALUES})[1]]"
    assert sources.run(both)[:2] == ([21.0, 1], ["total", "scaled", "halves"])
    sources.write(factor="5.0")
    assert sources.run(both)[:2] == ([35.0, 1], ["total", "scaled"])


def test_a_comment_a_new_time_stamp_or_an_edit_of_another_kernel_recompiles_nothing(sources: Sources) -> None:
    sources.run(f"result = caller.total({VALUES})")
    sources.write(minus="2.0", end="\n# a remark\n")
    (sources.folder / "caller.py").write_text("\n# moved down\n\n" + CALLER)
    for path in sources.folder.glob("call*.py"):
        os.utime(path, (1e9, 1e9))
    assert sources.run(f"result = caller.total({VALUES})")[:2] == (21.0, [])


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
def test_new_values_of_an_enum_and_new_fields_of_a_tuple_recompile_kernels(sources: Sources) -> None:
    path = sources.folder / "caller.py"
    words = "result = [caller.kind_of(1), caller.low_of(caller.Pair(2.0, 3.0)), caller.twice_after(1)]"
    path.write_text(TYPES.format(roof=4, one="low", other="high", step=1))
    assert sources.run(words)[0] == [5, 2.0, 3]
    path.write_text(TYPES.format(roof=6, one="high", other="low", step=10))
    assert sources.run(words)[0] == [7, 3.0, 21]


@pytest.mark.slow
def test_an_inlined_kernel_is_not_compiled_and_has_no_file(sources: Sources) -> None:
    (sources.folder / "caller.py").write_text(TYPES.format(roof=4, one="low", other="high", step=1))
    words = "result = [caller.twice_after(1), 'after' in counting.seen, 'twice_after' in counting.seen]"
    assert sources.run(words)[0] == [3, False, True]
    assert list(sources.stored()) == ["caller.twice_after"]
    assert sources.run(f"{words}[:1] + [caller.after(1)]")[0] == [3, 2]


def test_constants_of_every_kind_have_a_fingerprint() -> None:
    own = _Own(lambda _: None)
    slices = (slice(1, None), slice(None, 1), (slice(None), 0), (0, slice(None)), ...)
    values = (*slices, None, 1, 1.0, "1", b"1", np.int8(1))
    assert len({own.value(value) for value in values}) == len(values)


def test_a_deep_recursion_runs_in_one_large_frame() -> None:
    assert frame_room._from_large_frame.__code__.co_stacksize == frame_room._SLOTS


@pytest.mark.slow
def test_a_kernel_that_only_kernels_call_gets_machine_code_when_python_calls_it(sources: Sources) -> None:
    sources.run(f"result = caller.total({VALUES})")
    assert {name: bool(stored.machine_code) for name, stored in sources.stored().items()} == {
        "caller.total": True,
        "callee.scaled": False,
    }
    # its code is stored, so it is not compiled again for Python
    assert sources.run(f"caller.total({VALUES}); result = callee.scaled(2.0)")[0] == 6.0
    assert sources.stored()["callee.scaled"].machine_code


@pytest.mark.slow
def test_one_process_calls_a_kernel_from_kernels_and_from_python_in_any_order(sources: Sources) -> None:
    again = "from pipeline.compiler import kernel; other = kernel(lambda x: callee.scaled(x) + 1.0)"
    kernels_first = f"{again}; result = [caller.total({VALUES}), callee.scaled(2.0), other(2.0)]"
    assert sources.run(kernels_first)[0] == [21.0, 6.0, 7.0]
    both = f"result = [callee.scaled(2.0), caller.total({VALUES})]"
    assert Sources.run(sources, both, NUMBA_CACHE_DIR=str(sources.folder / "other"))[0] == [6.0, 21.0]


@pytest.mark.slow
@pytest.mark.parametrize("order", ["python, kernel, python", "kernel, python", "python, kernel"])
def test_loaded_kernels_give_python_arrays_in_any_order_of_calls(sources: Sources, order: str) -> None:
    python, called = f"caller.halves({VALUES})[0].sum()", f"caller.first_of_halves({VALUES})"
    sources.run(f"result = [{called}, {python}]")
    words = [{"python": python, "kernel": called}[name] for name in order.split(", ")]
    result, compiled, _ = sources.run(f"result = [{', '.join(words)}]")
    assert result == [{"python": 7.0, "kernel": 1.0}[name] for name in order.split(", ")]
    assert compiled == []


def test_a_kernel_loaded_while_a_kernel_between_is_compiled_can_be_called_from_python(sources: Sources) -> None:
    sources.run(f"result = caller.halves({VALUES})[1]")
    words = f"result = [caller.first_plus_one({VALUES}), caller.halves({VALUES})[1]]"
    assert sources.run(words)[0] == [2.0, 1]


@pytest.mark.slow
def test_a_loaded_kernel_that_another_process_then_makes_callable_can_be_called_from_python(sources: Sources) -> None:
    sources.run(f"result = caller.first_of_halves({VALUES})")
    assert not sources.stored()["caller.halves"].machine_code

    def also(addend: float) -> str:
        """Compile one more caller, which loads the kernel without constants."""
        made = f"kernel(lambda values: caller.halves(values)[0][0] + {addend})"
        return f"from pipeline.compiler import kernel; also = {made}({VALUES})"

    call = f"caller.halves({VALUES})[0].sum()"
    # the file keeps the name of the kernel's constants and now has them
    other = f"import numpy as np, caller; {also(2.0)}; {call}"
    meanwhile = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {other!r}], check=True)"
    assert sources.run(f"{also(1.0)}; {meanwhile}; result = [also, {call}]")[0] == [2.0, 7.0]
    assert sources.stored()["caller.halves"].machine_code


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["cut", "empty", "other"])
def test_a_kernel_with_a_damaged_file_is_compiled_again(sources: Sources, damage: str) -> None:
    sources.run(f"result = caller.total({VALUES})")
    (path,) = sources.cache.glob("caller.total*")
    whole = path.read_bytes()
    path.write_bytes({"cut": whole[:-1], "empty": b"", "other": b"x" + whole[1:]}[damage])
    assert sources.run(f"result = caller.total({VALUES})")[:2] == (21.0, ["total"])
    assert path.read_bytes() != b""


def test_a_loaded_kernel_may_be_the_first_of_a_process(sources: Sources) -> None:
    # a wrapper that is made after its kernel needs the code that releases arrays, too
    fitted = "fitted_run(np.array([[0.0, 0.0], [3.0, 4.0]]), 0, 1).length"
    sources.write(
        end="""
from pipeline.roof.lines import _fit

@kernel
def chord(border):
    return _fit(border, 0, 1)[3]
"""
    )
    sources.run(f"from pipeline.roof.lines import fitted_run; callee.chord(np.zeros((2, 2)));result = {fitted}")
    assert sources.run(f"from pipeline.roof.lines import fitted_run; result = {fitted}")[0] == 5.0


@pytest.mark.slow
def test_plain_numba_computes_the_same_and_stores_its_own_files(sources: Sources) -> None:
    words = f"result = [caller.total({VALUES}), caller.halves({VALUES})[1], callee.scaled(2.0)]"
    ours = sources.run(words)[0]
    assert sources.run(words, GABLEWORK_PLAIN_NUMBA="1")[0] == ours
    assert list(sources.cache.rglob("*.nbc"))


@pytest.mark.slow
def test_plain_numba_follows_an_edit_of_a_callee_in_another_file(sources: Sources) -> None:
    for factor, total in (("3.0", 21.0), ("5.0", 35.0), ("5.0", 35.0)):
        sources.write(factor=factor)
        assert sources.run(f"result = caller.total({VALUES})", GABLEWORK_PLAIN_NUMBA="1")[0] == total
    assert sources.run(f"result = caller.total({VALUES})", GABLEWORK_PLAIN_NUMBA="1")[1] == []


@pytest.mark.slow
def test_an_unknown_numba_is_used_plainly_with_a_warning(sources: Sources) -> None:
    words = f"import pipeline.compiler.backend as backend; backend.KNOWN = ('0.1.',); result = caller.total({VALUES})"
    result, _, warned = sources.run(words)
    assert result == 21.0
    assert warned.count("gablework does not know numba") == 1
    assert sources.stored() == {}


def test_the_numba_of_the_locks_is_known() -> None:
    from pipeline.compiler.backend import is_known

    assert is_known()


@pytest.mark.slow
def test_without_numba_kernels_are_plain_functions(sources: Sources) -> None:
    result, compiled, _ = sources.run(f"result = float(caller.total({VALUES}))", NUMBA_DISABLE_JIT="1")
    assert (result, compiled) == (21.0, [])


@pytest.mark.slow
def test_two_processes_without_stored_kernels_compile_each_once(sources: Sources) -> None:
    started = [sources.start(f"result = caller.total({VALUES})") for _ in range(2)]
    compiled: list[str] = []
    for process in started:
        printed, warned = process.communicate()
        assert process.returncode == 0, warned
        result, seen = json.loads(printed)
        assert result == 21.0
        compiled += [name for name in seen if name in {"total", "scaled"}]
    assert sorted(compiled) == ["scaled", "total"]


# ------------------------------------------------------------------------------------------------ shipped kernels


def ship(sources: Sources) -> Path:
    """Compile, and copy the kernels as a package does."""
    folder = sources.folder / "shipped"
    words = f"caller.total({VALUES})\nfrom pathlib import Path\nfrom pipeline.compiler.warm_up import ship\n"
    (sources.cache).mkdir(exist_ok=True)
    (sources.cache / f"caller.gone.{sys.implementation.cache_tag}-x{ENDING}").write_bytes(b"of an earlier version")
    assert sources.run(f"{words}result = ship(Path({str(folder)!r}))")[0] == 2
    shutil.rmtree(sources.cache)
    return folder


@pytest.mark.slow
def test_shipped_kernels_are_loaded_and_nothing_is_written(sources: Sources) -> None:
    folder = ship(sources)
    result, compiled, warned = sources.run(f"result = caller.total({VALUES})", GABLEWORK_KERNELS=str(folder))
    assert (result, compiled, warned) == (21.0, [], "")
    assert sources.stored() == {}


@pytest.mark.slow
def test_a_shipped_kernel_that_only_kernels_called_is_compiled_once_for_python_and_kept(sources: Sources) -> None:
    folder = str(ship(sources))
    for _ in range(2):
        assert sources.run("result = callee.scaled(2.0)", GABLEWORK_KERNELS=folder)[0] == 6.0
        assert sources.stored()["callee.scaled"].machine_code
    assert sources.run("result = callee.scaled(2.0)", GABLEWORK_KERNELS=folder)[:2] == (6.0, [])


@pytest.mark.slow
def test_a_shipped_file_whose_hash_is_not_listed_is_not_loaded(sources: Sources) -> None:
    folder = ship(sources)
    (path,) = folder.glob("caller.total*")
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    result, compiled, warned = sources.run(f"result = caller.total({VALUES})", GABLEWORK_KERNELS=str(folder))
    assert (result, compiled) == (21.0, ["total"])
    assert f"is not the file that {LIST} lists" in warned


@pytest.mark.slow
def test_kernels_for_another_processor_are_compiled_with_a_warning(sources: Sources) -> None:
    folder = ship(sources)
    environment = {"GABLEWORK_KERNELS": str(folder), "NUMBA_CPU_NAME": get_host_cpu_name()}
    result, compiled, warned = sources.run(f"result = caller.total({VALUES})", **environment)
    assert (result, compiled) == (21.0, ["total", "scaled"])
    assert "were made for another Python, numba or processor" in warned


@pytest.mark.slow
def test_kernels_are_compiled_with_a_warning_if_nothing_can_be_written(sources: Sources) -> None:
    (sources.folder / "file").write_text("")
    nowhere = str(sources.folder / "file" / "kernels")
    result, compiled, warned = sources.run(f"result = caller.total({VALUES})", NUMBA_CACHE_DIR=nowhere)
    assert (result, compiled) == (21.0, ["total", "scaled"])
    assert f"cannot be stored in {nowhere}" in warned
