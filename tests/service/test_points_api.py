"""Points by REST: the tilesets and their nodes, the points of one building, and what a job without points says."""

import functools
import json
import shutil
import struct
from typing import Any
from urllib.parse import urljoin

import finished_runs as runs
import numpy as np
import pytest
from points_glb import read_points_glb
from starlette.testclient import TestClient

GABLE = runs.ident("gable")


@pytest.fixture(scope="module")
def job_id(service: runs.Service) -> str:
    """A job with points."""
    return service.finished()


@pytest.fixture(scope="module")
def bare(service: runs.Service) -> str:
    """A job without points."""
    return service.finished(functools.partial(runs.write_run, points=False))


def contents(client: TestClient, address: str) -> dict[str, bytes]:
    """All nodes that are reached from a tileset, by their addresses."""
    found: dict[str, bytes] = {}
    waiting = [client.get(address).json()["root"] | {"at": address}]
    for node in waiting:
        if "content" in node:
            there = urljoin(node["at"], node["content"]["uri"])
            answer = client.get(there)
            assert answer.status_code == 200, there
            if answer.headers["content-type"] == "application/json":
                waiting.append(answer.json()["root"] | {"at": there})
            else:
                assert answer.headers["content-type"] == "model/gltf-binary"
                found[there] = answer.content
        waiting.extend(child | {"at": node["at"]} for child in node.get("children", ()))
    return found


@pytest.mark.parametrize("start", ["points/tileset.json", "results/tileset"])
def test_a_tileset_leads_to_all_points(client: TestClient, job_id: str, start: str) -> None:
    nodes = contents(client, f"http://127.0.0.1/jobs/{job_id}/{start}")
    assert list(nodes) == [f"http://127.0.0.1/jobs/{job_id}/points/x850_y4470/r.glb"]
    (content,) = nodes.values()
    points, _ = read_points_glb(content)
    assert len(points) == 5
    assert points.buildings == (GABLE,)


def test_the_points_of_a_building_are_one_file(client: TestClient, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/buildings/{GABLE}/points")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "model/gltf-binary"
    size = struct.unpack_from("<I", answer.content, 12)[0]
    document: dict[str, Any] = json.loads(answer.content[20 : 20 + size])
    assert document["meshes"][0]["extras"] == {"points": 4, "buildings": [GABLE]}
    columns = document["meshes"][0]["primitives"][0]["attributes"]
    view = document["bufferViews"][document["accessors"][columns["_RESIDUAL"]]["bufferView"]]
    stored = answer.content[28 + size + view["byteOffset"] :][: view["byteLength"]]
    assert np.frombuffer(stored, "<i2")[::2].tolist() == [12, -7, 0, 33]


def test_a_building_without_points_says_so(client: TestClient, job_id: str, bare: str) -> None:
    other = client.get(f"/jobs/{job_id}/buildings/{runs.ident('courtyard')}/points")
    assert "has no points" in runs.problem(other, 404, "no-such-building")
    unknown = client.get(f"/jobs/{job_id}/buildings/{'a' * 24}/points")
    assert "hold no building" in runs.problem(unknown, 404, "no-such-building")
    without = client.get(f"/jobs/{bare}/buildings/{GABLE}/points")
    assert "request points" in runs.problem(without, 404, "no-such-building")


def test_a_job_without_points_has_no_tileset(client: TestClient, bare: str) -> None:
    answer = client.get(f"/jobs/{bare}/points/tileset.json")
    assert "submit it again with points" in runs.problem(answer, 404, "no-such-output")
    assert "tileset" not in client.get(f"/jobs/{bare}/results").json()


def test_a_file_that_is_gone_is_a_clear_answer(service: runs.Service) -> None:
    job = service.finished()
    shutil.rmtree(service.folder.run(job, 1) / "points" / "x850_y4470")
    assert "start at points/tileset.json" in runs.problem(
        service.client.get(f"/jobs/{job}/points/x850_y4470/r.glb"), 404, "no-such-output"
    )
    assert "submit the job again" in runs.problem(
        service.client.get(f"/jobs/{job}/buildings/{GABLE}/points"), 404, "no-such-building"
    )
