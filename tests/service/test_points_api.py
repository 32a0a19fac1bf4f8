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

from pipeline.extras.octree.point_glb import NO_BUILDING
from service.keys import Scope, new_key

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


def test_files_of_points_are_kept_by_the_client_for_good(client: TestClient, job_id: str) -> None:
    for name in ("tileset.json", "x850_y4470/tileset.json", "x850_y4470/r.glb"):
        answer = client.get(f"/jobs/{job_id}/points/{name}")
        assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
        again = client.get(f"/jobs/{job_id}/points/{name}", headers={"If-None-Match": answer.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
        head = client.head(f"/jobs/{job_id}/points/{name}")
        assert (head.status_code, head.headers["etag"]) == (200, answer.headers["etag"])


def test_nodes_are_sent_in_ranges_and_compressed(client: TestClient, job_id: str) -> None:
    address = f"/jobs/{job_id}/points/x850_y4470/r.glb"
    whole = client.get(address)
    part = client.get(address, headers={"Range": "bytes=4-11"})
    assert (part.status_code, part.content) == (206, whole.content[4:12])
    beyond = client.get(address, headers={"Range": "bytes=999999-"})
    assert "lies beyond the end" in runs.problem(beyond, 416, "about:blank")
    packed = client.get(address, headers={"Accept-Encoding": "gzip"})
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.content == whole.content


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


@pytest.mark.parametrize(
    "name",
    ["x850_y4470/buildings.json", "x850_y4470/..%2f..%2frun.json", "..%2frun.json", "x850_y4470/r9.glb", "a/b.glb",
     "x850_y4470/r0.glb", "tileset-ecef.json", "x850_y4470%2ftileset.json%0a"],
)  # fmt: skip
def test_only_files_of_tilesets_are_served(client: TestClient, job_id: str, name: str) -> None:
    answer = client.get(f"/jobs/{job_id}/points/{name}")
    assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json")


def test_points_of_another_key_are_not_seen(tmp_path: Any) -> None:
    with runs.service(tmp_path / "state") as service:
        keys = [new_key(name, Scope.SUBMIT, now=service.store.now()) for name in ("mine", "theirs")]
        for key, _ in keys:
            service.store.add_key(key)
        job = service.finished(owner=keys[0][0].key_id)
        for path in ("points/tileset.json", "points/x850_y4470/r.glb", f"buildings/{GABLE}/points"):
            answers = [
                service.client.get(f"/jobs/{job}/{path}", headers={"Authorization": f"Bearer {secret}"}).status_code
                for _, secret in keys
            ]
            assert answers == [200, 404]
            assert service.client.get(f"/jobs/{job}/{path}").status_code == 401


def test_a_file_that_is_gone_is_a_clear_answer(service: runs.Service) -> None:
    job = service.finished()
    shutil.rmtree(service.folder.run(job, 1) / "points" / "x850_y4470")
    assert "start at points/tileset.json" in runs.problem(
        service.client.get(f"/jobs/{job}/points/x850_y4470/r.glb"), 404, "no-such-output"
    )
    assert "submit the job again" in runs.problem(
        service.client.get(f"/jobs/{job}/buildings/{GABLE}/points"), 404, "no-such-building"
    )


def test_the_points_of_the_example_hold_one_that_belongs_to_no_building(client: TestClient, job_id: str) -> None:
    points, _ = read_points_glb(client.get(f"/jobs/{job_id}/points/x850_y4470/r.glb").content)
    assert (points.building == NO_BUILDING).sum() == 1
