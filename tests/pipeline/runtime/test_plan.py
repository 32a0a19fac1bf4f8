"""What a plan says of inputs that cannot be used: of all of them, not of the first alone."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import laspy
import numpy as np
import pyproj
import pytest

from pipeline.errors import CrsError, InconsistentInputError, InputError, RunCancelledError, UnreadableInputError
from pipeline.extras.classify.classify import ClassifyRequest, classify
from pipeline.io import ReadOptions
from pipeline.runtime import looking, request
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor
from pipeline.runtime.looking import look_at_all
from pipeline.runtime.monitoring.progress import Progress, Watch, ignore
from pipeline.runtime.request import RunRequest, plan_inputs
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_plan import check_memory, looked_at, make_plan
from pipeline.settings import RunSettings


def _file(path: Path, crs: str) -> str:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_crs(pyproj.CRS(crs))
    header.scales, header.offsets = np.full(3, 0.01), np.array([500_000.0, 5_000_000.0, 0.0])
    las = laspy.LasData(header)
    las.x, las.y, las.z = header.offsets[:, None] + np.arange(4.0)
    las.write(path)
    return str(path)


def _refused(paths: Sequence[str]) -> InputError:
    with pytest.raises(InputError) as refused:
        make_plan(paths, ReadOptions(), RunSettings())
    return refused.value


def test_inputs_that_cannot_be_read_are_named_together(tmp_path: Path) -> None:
    sound = _file(tmp_path / "a.laz", "EPSG:25832")
    broken = tmp_path / "b.laz"
    broken.write_bytes(b"<html>not found</html>")
    short = tmp_path / "c.laz"
    short.write_bytes(Path(sound).read_bytes()[:100])
    fault = _refused([sound, str(broken), str(short)])
    assert type(fault) is UnreadableInputError
    assert fault.path == str(broken)
    assert f"1 more input cannot be used: {short}: " in str(fault)


def test_of_many_inputs_that_cannot_be_used_some_are_named_and_the_others_counted(tmp_path: Path) -> None:
    paths = [str(tmp_path / f"{number:02}.laz") for number in range(25)]
    for path in paths:
        Path(path).write_bytes(b"<html>not found</html>")
    message = str(_refused(paths))
    assert [path for path in paths if path in message] == paths[:10]
    assert "24 more inputs cannot be used" in message
    assert message.endswith("; and 15 more")


def test_inputs_of_another_crs_are_named_together(tmp_path: Path) -> None:
    paths = [_file(tmp_path / f"{code}.laz", f"EPSG:{code}") for code in (25832, 25833, 25834)]
    fault = _refused(paths)
    assert type(fault) is CrsError
    assert fault.path == paths[1]
    assert f"{paths[2]}: its CRS is ETRS89 / UTM zone 34N" in str(fault)


def test_inputs_far_outside_the_area_of_use_of_their_crs_are_refused_together_unless_allowed(tmp_path: Path) -> None:
    paths = [_file(tmp_path / f"{name}.laz", "EPSG:28992") for name in "ab"]
    request = RunRequest(inputs=tuple(paths), out=str(tmp_path / "run"))
    with pytest.raises(CrsError, match="in EPSG:28992") as refused:
        plan_inputs(request, Progress(lambda _: None))
    assert f"1 more input cannot be used: {paths[1]}: in EPSG:28992" in str(refused.value)
    allowed = dataclasses.replace(request, allow_outside_area_of_use=True)
    assert plan_inputs(allowed, Progress(lambda _: None))[1] == paths


def test_a_plan_that_is_denser_than_any_survey_names_the_extent_and_no_absurd_memory(tmp_path: Path) -> None:
    xyz = np.random.default_rng(1).uniform(0.0, 1.0, (1000, 3)) * [1e-5, 1e-5, 9.0] + [84_000.0, 447_000.0, 0.0]
    np.savetxt(tmp_path / "a.xyz", xyz, fmt="%.8f")
    plan = make_plan([str(tmp_path / "a.xyz")], ReadOptions(), RunSettings())
    with pytest.raises(InconsistentInputError, match=r"its 1000 points lie within 1e-05 by 9.98e-06 m") as refused:
        check_memory(plan, 4 << 30)
    assert "GB" not in str(refused.value)


def test_a_file_whose_points_lie_over_millions_of_tiles_is_refused_unless_a_region_is_cut(tmp_path: Path) -> None:
    xyz = np.random.default_rng(1).uniform(0.0, 30.0, (1000, 3))
    # a byte of many coordinates is damaged: a few points would be left aside
    xyz[::5, :2] *= 2e6 / 30.0
    path = tmp_path / "a.xyz"
    np.savetxt(path, xyz, fmt="%.3f")
    with pytest.raises(UnreadableInputError, match=r"lie over 1,9\d\d by 1,9\d\d km, .*tile_size_m") as refused:
        make_plan([str(path)], ReadOptions(), RunSettings())
    assert refused.value.path == str(path)
    window = ReadOptions(bbox=(0.0, 0.0, 30.0, 30.0))
    assert make_plan([str(path)], window, RunSettings()).points == 1000


# --- many inputs


@pytest.fixture
def many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """More inputs than this process looks at itself."""
    for module in (looking, request):
        monkeypatch.setattr(module, "MANY_FILES", 5)
    monkeypatch.setattr(looking, "_FILES_PER_TASK", 3)
    return [_file(tmp_path / f"{number}.laz", "EPSG:25832") for number in range(8)]


@pytest.mark.parametrize("workers", [0, 2])
def test_tasks_that_look_at_many_inputs_see_what_this_process_sees(
    many: list[str], workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = looked_at(many, ReadOptions())
    executors: list[object] = []
    executor = looking._executor

    def noted(resources: Resources) -> Executor | None:
        executors.append(executor(resources))
        return executors[-1]

    monkeypatch.setattr(looking, "_executor", noted)
    assert look_at_all(many, ReadOptions(), Resources(workers=workers)) == here
    assert [info.path for info in here] == many
    assert [one is not None for one in executors] == [workers > 0]
    assert look_at_all(many[:4], ReadOptions(), Resources(workers=workers)) == here[:4]
    assert len(executors) == 1


def test_tasks_that_look_at_many_inputs_name_all_that_cannot_be_used(many: list[str]) -> None:
    for path in (many[1], many[6]):
        Path(path).write_bytes(b"<html>not found</html>")
    with pytest.raises(InputError) as refused:
        look_at_all(many, ReadOptions(), Resources(workers=1))
    assert refused.value.path == many[1]
    assert f"1 more input cannot be used: {many[6]}: " in str(refused.value)


def test_a_look_at_many_inputs_is_the_callers_and_can_be_cancelled(many: list[str]) -> None:
    class Noted(SerialExecutor):
        seen: ClassVar[list[str]] = []

        def map(self, stage: str, function: Any, tasks: Any, watch: Watch) -> Any:
            self.seen.append(stage)
            return super().map(stage, function, tasks, watch)

    asked = RunRequest(inputs=tuple(many), out="nowhere", resources=Resources(workers=2))
    assert plan_inputs(asked, Progress(ignore), executor=Noted())[1] == many
    assert Noted.seen == ["plan"]
    with pytest.raises(RunCancelledError):
        plan_inputs(asked, Progress(ignore), cancelled=lambda: True)


def test_commands_that_run_in_this_process_look_here(many: list[str], tmp_path: Path, monkeypatch: Any) -> None:
    wanted: list[int | None] = []

    def noted(resources: Resources) -> None:
        wanted.append(resources.workers)

    monkeypatch.setattr(looking, "_executor", noted)
    request = ClassifyRequest(inputs=tuple(many), out=str(tmp_path / "out"), resources=Resources(workers=0))
    with pytest.raises(InputError):  # four points on a line
        classify(request)
    assert wanted == [0]
