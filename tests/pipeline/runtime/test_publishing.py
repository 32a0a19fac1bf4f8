"""Publishing a run as it is made: the counts of its manifest are those of its tables."""

from collections.abc import Callable
from pathlib import Path

import pyogrio
import pytest

from pipeline.extras.publish_gis.geopackage import publish_geopackage
from pipeline.runtime.digest import run_digest
from pipeline.runtime.run import RunSummary


@pytest.mark.slow
def test_a_simulated_run_is_published_whole(
    reconstruct: Callable[..., RunSummary], suburb: Path, tmp_path: Path
) -> None:
    summary = reconstruct(suburb, settings={"tile_size_m": 40.0, "lattice_x_m": 7.0})
    published = publish_geopackage(summary.run_dir, str(tmp_path / "run.gpkg"))
    assert published.rows["buildings"] == summary.counts["candidates"] > 1
    assert published.rows["rejected"] == summary.counts["rejected"] > 0
    assert published.rows["planes"] > published.rows["buildings"]
    assert published.rows["decisions"] > 0
    assert run_digest(summary.run_dir) == summary.digest
    info = pyogrio.read_info(tmp_path / "run.gpkg", layer="buildings")
    assert info["layer_metadata"]["content_sha256"] == summary.digest
    tiles = pyogrio.read_dataframe(tmp_path / "run.gpkg", layer="buildings", columns=["tile"], read_geometry=False)
    assert tiles["tile"].nunique() > 1
