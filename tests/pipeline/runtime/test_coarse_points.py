"""The nodes above the tiles: each level reads only its own share of every tile."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from pipeline.extras.octree.coarse_points import CoarseTask, write_coarse
from pipeline.extras.octree.point_glb import NO_BUILDING, ModelledPoints, points_glb, united
from pipeline.extras.octree.tile_points import TilePoints
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import InParts, OutcomeTask, Place, brief_within, run_and_store
from pipeline.tiling import MM, Tile

LEVELS = 7
TILES = [Tile(column, row) for column in range(6) for row in range(6)]
"""36 tiles."""


def share(seed: int, n: int) -> ModelledPoints:
    rng = np.random.default_rng(seed)
    building = rng.choice(np.array([0, 1, NO_BUILDING], np.uint16), n)
    return ModelledPoints(
        xyz_mm=rng.integers(0, 50 * MM, (n, 3)),
        point_class=rng.choice(np.array([2, 5, 6], np.uint8), n),
        building=building,
        plane=rng.integers(0, 9, n).astype(np.uint16),
        residual_mm=rng.integers(-500, 500, n).astype(np.int16),
        buildings=("ash", f"birch of {seed}"),
    )


def stored(tile: Tile) -> InParts[TilePoints]:
    """A tile with 800 points for the first level, 400 for the next one, and so on."""
    seed = TILES.index(tile)
    origin_mm = (tile.column * 50 * MM, tile.row * 50 * MM, 0)
    brief = TilePoints(
        tile=tile,
        origin_mm=origin_mm,
        low_mm=origin_mm,
        high_mm=origin_mm,
        points=0,
        error_m=0.0,
        classes={},
        terrain=None,
    )
    parts = tuple(share(seed * LEVELS + level, 800 >> level) for level in range(LEVELS))
    return InParts(brief=brief, parts=parts)


def test_each_level_reads_its_own_shares_and_writes_what_they_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = Scratch(str(tmp_path / "scratch"))
    scratch.create()
    shares = []
    for tile in TILES:
        place = Place("points", tile.key, "k")
        work = OutcomeTask(function=stored, task=tile, place=place, scratch=scratch, brief=brief_within, stage="octree")
        shares.append((place, run_and_store(work).brief.origin_mm))
    read: list[int] = []
    loads = pickle.loads
    monkeypatch.setattr(pickle, "loads", lambda content: read.append(len(content)) or loads(content))
    sizes = [(scratch.path(place.name)).stat().st_size for place, _ in shares]
    for level in range(1, LEVELS + 1):
        key = f"upper/{level}_0_0.glb"
        task = CoarseTask(
            key=key, run_dir=str(tmp_path), level=level, shares=tuple(shares), origin_mm=(0, 0, 0), scratch=scratch
        )
        expected = united(
            [stored(tile).parts[level - 1].moved(-np.array(at)) for tile, (_, at) in zip(TILES, shares, strict=True)]
        )
        assert write_coarse(task) == len(expected) == 36 * (800 >> level - 1)
        content = (tmp_path / "points" / key).read_bytes()
        assert content == points_glb(expected, key, {"origin_m": [0, 0, 0]})
    # all levels together read what is stored once
    assert 0.9 * sum(sizes) < sum(read) < sum(sizes)
