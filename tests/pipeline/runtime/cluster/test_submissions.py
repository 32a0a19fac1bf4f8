"""The API is killed while clients submit: every acknowledged job exists, complete and once."""

import hashlib
import threading
import time
from pathlib import Path

import httpx
import pytest
from deployment import Deployment
from processes import LONG_S, Programs, wait_for

from pipeline.ruler.simulation.dataset import simulate
from service.files import StateFolder
from service.jobs import JobStatus
from service.settings import ServiceSettings
from service.store import JobFilter, JobStore

pytestmark = pytest.mark.slow

CLIENTS, KILLS = 4, 4


def test_every_answered_submission_is_there_once_with_its_input(programs: Programs, tmp_path: Path) -> None:
    tile = simulate("gable", tmp_path / "scene").laz
    content = tile.read_bytes()
    service = Deployment(programs, tmp_path)
    service.start("api")
    answered: dict[str, str] = {}
    sent: set[str] = set()
    over = threading.Event()

    def submit(client: int) -> None:
        number = 0
        while not over.is_set():
            title = f"client {client}, submission {number}"
            number += 1
            sent.add(title)
            try:
                files = {"tile": ("tile.laz", content)}
                answer = httpx.post(f"{service.url}/jobs", files=files, data={"title": title}, timeout=LONG_S)
            except httpx.TransportError:
                time.sleep(0.05)
                continue
            assert answer.status_code == 201, answer.text
            answered[title] = answer.json()["jobID"]

    clients = [threading.Thread(target=submit, args=(client,)) for client in range(CLIENTS)]
    for client in clients:
        client.start()
    try:
        for _ in range(KILLS):
            before = len(answered)
            wait_for(lambda before=before: len(answered) >= before + 10, "ten more answers")
            service.running["api"].kill()
            service.supervise()
    finally:
        over.set()
        for client in clients:
            client.join()

    settings = ServiceSettings(state=tmp_path / "state")
    folder = StateFolder(settings.state)
    with JobStore(settings.database) as store:
        jobs = store.list(JobFilter(limit=10_000))
        assert {job.status for job in jobs} == {JobStatus.ACCEPTED}
        titles = [job.request.title for job in jobs]
        assert len(titles) == len(set(titles))
        assert {answered[title] for title in answered} <= {job.job_id for job in jobs}
        assert set(titles) <= sent
        assert len(answered) >= 10 * KILLS
        digest = hashlib.sha256(content).hexdigest()
        for job in jobs:
            (reference,) = job.request.tiles
            upload = store.upload(reference.value)
            (kept,) = folder.upload(reference.value).iterdir()
            assert (upload.sha256, hashlib.sha256(kept.read_bytes()).hexdigest()) == (digest, digest)
