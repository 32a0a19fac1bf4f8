"""The commands of the client against a service that runs as a process and is killed meanwhile."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import httpx
import pytest
from processes import LONG_S, Program, Programs, free_port, program, wait_for

pytestmark = pytest.mark.slow


def test_submit_and_wait_survives_a_killed_service_and_fetches_what_it_has_made(
    programs: Programs, tile: Path, tmp_path: Path
) -> None:
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    environment = {"GABLEWORK_URL": url, "XDG_CACHE_HOME": str(tmp_path / "cache"), "OPENBLAS_NUM_THREADS": "1"}
    gablework = str(program("gablework"))

    def serve(name: str) -> Program:
        options = ["--port", str(port), "--state", str(tmp_path / "state"), "--workers", "1"]
        started = programs.start(name, [gablework, "serve", *options], env={**environment, "GABLEWORK_LEASE_S": "5"})
        started.wait_for_port(port)
        return started

    def run(*words: str) -> str:
        command = [gablework, *words]
        return subprocess.run(
            command, env={**os.environ, **environment}, capture_output=True, text=True, check=True, timeout=LONG_S
        ).stdout

    def running() -> dict[str, Any] | None:
        found = httpx.get(f"{url}/jobs?status=running", timeout=LONG_S).json()["jobs"]
        return found[0] if found else None

    first = serve("first")
    submitting = programs.start("submit", [gablework, "submit", str(tile), "--wait"], env=environment)
    job = submitting.wait_for(running, "a running job")
    first.kill()
    wait_for(lambda: "does not answer" in submitting.text, "the client notices")
    serve("second")
    assert submitting.ended() == 0
    assert f"job {job['jobID']} is successful" in submitting.text
    assert run("submit", str(tile)).strip() == job["jobID"]
    files = json.loads(run("fetch", job["jobID"], "--out", str(tmp_path / "models"), "--json"))["files"]
    assert {"buildings", "report"} <= {file["output"] for file in files}
    assert json.loads((tmp_path / "models" / "report.json").read_text())
