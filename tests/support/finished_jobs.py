"""Jobs that are over, submitted as any client would."""

from pathlib import Path
from typing import Any

import httpx
from processes import wait_for

JOB_S = 600.0
"""A deadline for a job, not a promise of speed."""


def finished_job(service: str, tile: Path, **more: object) -> str:
    """Id of a job on a tile, with more inputs if given, once it is successful."""
    with httpx.Client(base_url=service, timeout=60.0) as client:
        upload = client.post("uploads", params={"filename": tile.name}, content=tile.read_bytes()).raise_for_status()
        inputs = {"tiles": [{"href": f"uploads/{upload.json()['uploadID']}"}], "title": tile.name, **more}
        job = client.post("processes/reconstruct/execution", json={"inputs": inputs}).raise_for_status().json()["jobID"]

        def over() -> dict[str, Any] | None:
            reported: dict[str, Any] = client.get(f"jobs/{job}").raise_for_status().json()
            return reported if reported["status"] not in {"accepted", "running"} else None

        status = wait_for(over, "the end of the job", JOB_S, interval_s=0.25)
        assert status["status"] == "successful", status
        return str(job)
