"""A worker's figures and log lines name what it did, and what it lost."""

import json
import re
import sys
from pathlib import Path

import httpx
import pyarrow.dataset as ds
import pytest
from faults import asked
from processes import Programs, free_port, wait_for

from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL, Resources
from pipeline.runtime.run import run

pytestmark = pytest.mark.slow


def test_a_building_that_is_lost_is_named_with_its_run_and_counted(programs: Programs, tmp_path: Path) -> None:
    tile = simulate("suburb", tmp_path / "scene", 3, size_m=(60.0, 60.0), density_per_m2=4.0).laz
    run(RunRequest(inputs=(str(tile),), out=str(tmp_path / "serial"), resources=SERIAL, meshes="none"))
    found = ds.dataset(tmp_path / "serial" / "buildings", partitioning="hive").to_table(["building_id", "status"])
    lost = min(b for b, status in zip(*found.to_pydict().values(), strict=True) if status == "ok")

    port, figures = free_port(), free_port()
    programs.start_scheduler(port)
    address = f"tcp://127.0.0.1:{port}"
    command = [sys.executable, "-m", "service.cli", "worker", "--scheduler", address, "--log-json"]
    env = asked.environment(crash=[lost])
    worker = programs.start("worker", [*command, "--metrics-port", str(figures)], env=env)
    worker.wait_for_text("is at the scheduler")
    resources = Resources(scheduler=address)
    summary = run(RunRequest(inputs=(str(tile),), out=str(tmp_path / "run"), resources=resources))
    assert summary.reasons["crashed"] == 1

    def page() -> str:
        return httpx.get(f"http://127.0.0.1:{figures}/metrics", timeout=60.0).text

    wait_for(lambda: 'gablework_tasks_worked_total{outcome="done",stage="publish"}' in page(), "the last stage")
    buildings = dict(re.findall(r"^gablework_buildings_total\{(.*)\} (\S+)$", page(), re.MULTILINE))
    assert sum(map(float, buildings.values())) == read_manifest(tmp_path / "run").counts["candidates"]
    assert float(buildings['reason="crashed",status="failed"']) == 1.0

    (line,) = [json.loads(line) for line in worker.text.splitlines() if '"a building is lost"' in line]
    facts = {"level": "warning", "stage": "reconstruct", "building": lost, "reason": "crashed"}
    assert line.items() >= facts.items()
    assert re.fullmatch(r"[0-9a-f]{32}", line["run"])
    assert re.fullmatch(r"x-?\d+_y-?\d+", line["tile"])
    assert worker.stop() == 0
    # figures end with the worker
    with pytest.raises(httpx.TransportError):
        page()
