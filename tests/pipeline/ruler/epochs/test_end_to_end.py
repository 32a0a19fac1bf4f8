"""A simulated suburb, changed, scanned twice with other noise, reconstructed twice: every change is found, no other."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from two_epochs import TwoEpochs, Work, two_epochs

from pipeline.ruler.epochs.diff import DiffRequest, diff
from pipeline.ruler.simulation.als import scan
from pipeline.ruler.simulation.suburb import suburb
from pipeline.ruler.simulation.suites import suite_named
from pipeline.ruler.simulation.survey_files import write_points
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run

EXPECTED = {
    Work.BUILT: "new",
    Work.DEMOLISHED: "gone",
    Work.RAISED: "raised",
    Work.LOWERED: "lowered",
    Work.NEW_ROOF: "reshaped",
    Work.EXTENDED: "reshaped",
    None: "unchanged",
}


@pytest.fixture(scope="module")
def epochs() -> TwoEpochs:
    """Some 25 houses, each kind of work done once."""
    return two_epochs(suburb(90_002, size_m=(160.0, 150.0)), 5, share=0.0)


@pytest.fixture(scope="module")
def runs(epochs: TwoEpochs, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Both epochs scanned with another seed, and reconstructed."""
    made = []
    for seed, scene in ((11, epochs.earlier), (12, epochs.later)):
        folder = tmp_path_factory.mktemp("epoch")
        laz = folder / "points.laz"
        write_points(scan(scene, suite_named("suburb").scanner, seed), scene, laz, folder / "labels.parquet")
        run(RunRequest(inputs=(str(laz),), out=str(folder / "run"), meshes="none", resources=SERIAL))
        made.append(str(folder / "run"))
    return made[0], made[1]


def test_every_change_is_found_and_nothing_else(epochs: TwoEpochs, runs: tuple[str, str], tmp_path: Path) -> None:
    assert sorted(epochs.works.values()) == sorted(Work)
    made = diff(DiffRequest(old=runs[0], new=runs[1], out=str(tmp_path)))
    rows = pq.read_table(tmp_path / "changes.parquet").to_pylist()
    geometries = shapely.from_wkb(np.array([row["geometry"] for row in rows], dtype=object))
    origin = np.array(epochs.later.origin[:2])
    facts = {}
    for building in (*epochs.earlier.buildings, *epochs.later.buildings):
        footprint = shapely.transform(building.footprint, lambda xy: xy + origin)
        over = [
            row["change"]
            for row, geometry in zip(rows, geometries, strict=True)
            if geometry.intersection(footprint).area > 0.5 * min(footprint.area, geometry.area)
        ]
        facts[building.building_id] = over
    expected = {name: [EXPECTED[epochs.works.get(name)]] for name in facts}
    assert facts == expected
    assert len(rows) == len(facts)
    assert made.warnings == ()
    assert abs(made.summary.level.median_m or 0.0) < 0.01


def test_a_run_records_where_its_data_lie(runs: tuple[str, str], epochs: TwoEpochs) -> None:
    manifest = read_manifest(runs[0])
    (points,) = manifest.inputs
    assert points.bounds_m is not None
    west, south, east, north = epochs.earlier.extent
    x, y, _ = epochs.earlier.origin
    assert points.bounds_m == pytest.approx((west + x, south + y, east + x, north + y), abs=2.0)
    assert manifest.lattice["tile_size_m"] > 0.0
    facts = json.loads(Path(runs[0], "run.json").read_text())
    assert facts["lattice"] == dict(manifest.lattice)
