"""A large file is read by several tasks at once, and the run is the same."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from las_files import copc_of
from one_file_site import Site, one_file_site

from pipeline.errors import UnreadableInputError
from pipeline.io import ReadOptions, open_source
from pipeline.io.file_facts import Share
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.run_plan import is_fetched_by_nodes, shares_of
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.ingest import IngestTask, ingest_file
from pipeline.tiling import TileGrid

Box = tuple[float, float, float, float]


@pytest.fixture(scope="module")
def plain(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb without compression, of which any stretch can be read."""
    path = tmp_path_factory.mktemp("plain") / "suburb.las"
    laspy.read(suburb).write(path)
    return path


@pytest.fixture(scope="module")
def octree(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb as COPC."""
    las = laspy.convert(laspy.read(plain), point_format_id=6, file_version="1.4")
    return copc_of(tmp_path_factory.mktemp("octree") / "suburb.copc.laz", las, "EPSG:25832")


@pytest.fixture
def small_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of three thousand points."""
    monkeypatch.setattr("pipeline.runtime.run_plan._POINTS_PER_SHARE", 3_000)


def test_files_are_cut_by_their_points(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = open_source(plain).info
    assert shares_of(info, ReadOptions()) == [None]
    monkeypatch.setattr("pipeline.runtime.run_plan._POINTS_PER_SHARE", info.point_count // 4 + 1)
    assert shares_of(info, ReadOptions()) == [Share(number=k, of=4) for k in range(4)]
    monkeypatch.setattr("pipeline.runtime.run_plan._MOST_SHARES", 3)
    assert len(shares_of(info, ReadOptions())) == 3
    np.savetxt(tmp_path / "a.xyz", np.random.default_rng(1).uniform(0, 50, (info.point_count, 3)))
    assert shares_of(open_source(tmp_path / "a.xyz").info, ReadOptions()) == [None]


@pytest.mark.usefixtures("small_shares")
@pytest.mark.parametrize("name", ["plain", "octree"])
def test_a_run_of_a_file_in_shares_is_the_run_of_the_file(
    name: str, request: pytest.FixtureRequest, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = request.getfixturevalue(name)
    assert len(shares_of(open_source(path).info, ReadOptions())) > 3
    cut = reconstruct(path, settings={"tile_size_m": 40.0})
    monkeypatch.undo()
    whole = reconstruct(path, settings={"tile_size_m": 40.0})
    assert cut.digest == whole.digest
    (of_cut,), (of_whole,) = (read_manifest(summary.run_dir).inputs for summary in (cut, whole))
    assert of_cut == of_whole
    assert {k: v for k, v in cut.counts.items() if k != "reused"} == {
        k: v for k, v in whole.counts.items() if k != "reused"
    }


def test_classes_of_a_file_in_shares_come_back_in_its_order(
    plain: Path, run_classify: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run_classify(plain, settings={"tile_size_m": 40.0})
    monkeypatch.setattr("pipeline.runtime.run_plan._POINTS_PER_SHARE", 3_000)
    cut = run_classify(plain, settings={"tile_size_m": 40.0})
    contents = [Path(summary.files[0].path).read_bytes() for summary in (whole, cut)]
    assert contents[0] == contents[1]


def share_of(folder: Path, path: str, options: ReadOptions, share: Share | None) -> IngestTask:
    """The task of a share, planned now."""
    scratch = Scratch(str(folder / "scratch"))
    scratch.create()
    return IngestTask(
        part="a",
        path=path,
        options=options,
        grid=TileGrid(size_mm=30_000, halo_mm=10_000),
        scratch=scratch,
        known=open_source(path, options).info,
        share=share,
    )


def test_a_file_that_changes_between_its_shares_is_refused(plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "suburb.las"
    path.write_bytes(plain.read_bytes())
    task = share_of(tmp_path, str(path), ReadOptions(), Share(number=1, of=2))
    assert sum(ingest_file(task).points_by_tile.values()) > 0
    os.utime(path, ns=(1, 1))
    with pytest.raises(UnreadableInputError, match=r"suburb\.las: it changed after the run began\. Run again once"):
        ingest_file(task)


@pytest.fixture
def half(octree: Path) -> tuple[float, float, float, float]:
    """The western half of the suburb."""
    x_min, y_min, _, x_max, y_max, _ = open_source(octree).info.bounds_m
    return x_min, y_min, (x_min + x_max) / 2.0, y_max


@pytest.fixture
def site(octree: Path) -> Iterator[Site]:
    """A server of the octree."""
    with one_file_site() as site:
        site.content = octree.read_bytes()
        yield site


def test_a_window_of_a_remote_octree_is_the_window_of_the_file(
    octree: Path, half: Box, site: Site, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = reconstruct(octree, bbox=half)
    there = reconstruct(site.url, bbox=half)
    monkeypatch.setattr("pipeline.runtime.run_plan._POINTS_PER_SHARE", 3_000)
    cut = reconstruct(site.url, bbox=half)
    assert here.digest == there.digest == cut.digest
    figures = [[summary.counts[k] for k in ("points", "dropped_outside")] for summary in (here, there, cut)]
    assert figures[0] == figures[1] == figures[2]
    (of_there,), (of_cut,) = (read_manifest(summary.run_dir).inputs for summary in (there, cut))
    assert of_there == of_cut
    assert len(of_there.sha256) == 64


def test_a_remote_octree_is_fetched_whole_where_no_part_of_it_will_do(
    site: Site, half: Box, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.extras.remote.remote_file.BLOCK_BYTES", 4096)
    window = ReadOptions(bbox=half)
    assert is_fetched_by_nodes(open_source(site.url, window).info, window)
    x_min, y_min, _, x_max, y_max, _ = open_source(site.url).info.bounds_m
    for options in (ReadOptions(), ReadOptions(bbox=(x_min - 1.0, y_min - 1.0, x_max + 1.0, y_max + 1.0))):
        assert not is_fetched_by_nodes(open_source(site.url, options).info, options)
    site.ranges = False
    assert not is_fetched_by_nodes(open_source(site.url, window).info, window)


def test_a_remote_octree_that_changes_while_its_nodes_are_read_is_refused(
    site: Site, half: Box, tmp_path: Path
) -> None:
    window = ReadOptions(bbox=half)
    task = share_of(tmp_path, site.url, window, None)
    assert sum(ingest_file(task).points_by_tile.values()) > 0
    site.etag = '"2"'
    with pytest.raises(UnreadableInputError, match=r"a\.laz: it changed after the run began"):
        ingest_file(task)
