"""The benchmark of ground filters: its scenes, its figures, and what the default filter reaches on some of them."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.ground import KEPT_ASIDE, drawn_scenes, figures_of, labels_of, main, product_filter, samples
from pipeline.terrain.terrain_settings import GroundSettings


def test_scenes_are_drawn_alike_each_time_and_know_their_ground() -> None:
    first, again = list(drawn_scenes((0.2,))), list(drawn_scenes((0.2,)))
    assert len({scene.name for scene in first}) == len(first) == 17
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.z_mm, other.z_mm)
        np.testing.assert_array_equal(one.is_ground, other.is_ground)
        assert one.is_ground.mean() > 0.2
    other_draw = next(iter(drawn_scenes((0.2,), draw=1)))
    assert not np.array_equal(first[0].z_mm, other_draw.z_mm)


def test_figures_are_those_of_the_table_of_right_and_wrong_points() -> None:
    scene = next(iter(drawn_scenes((0.2,))))
    right = figures_of(scene, scene.is_ground)
    assert (right.type_1, right.type_2, right.total, right.kappa) == (0.0, 0.0, 0.0, 100.0)
    everything = figures_of(scene, np.ones_like(scene.is_ground))
    assert (everything.type_1, everything.type_2) == (0.0, 100.0)
    assert everything.total == pytest.approx(100.0 * (~scene.is_ground).mean())
    assert everything.kappa == pytest.approx(0.0)


@pytest.mark.slow
def test_the_default_filter_keeps_what_it_reached_on_drawn_scenes() -> None:
    limits = {"embankments": 0.5, "quarry": 1.0, "gaps": 0.2, "houses_on_a_slope": 0.6, "hills_and_halls": 4.0}
    ground_filter = product_filter(GroundSettings())
    for scene in drawn_scenes((1.0,)):
        kind = scene.name.split()[0]
        if kind in limits:
            assert figures_of(scene, labels_of(scene, ground_filter)).total < limits[kind], scene.name


@pytest.mark.slow
def test_blocks_of_an_old_town_stay_above_the_ground_where_points_are_sparse() -> None:
    [scene] = [scene for scene in drawn_scenes((0.2,)) if scene.name == "old_town 0.2"]
    assert figures_of(scene, labels_of(scene, product_filter(GroundSettings()))).type_2 < 4.0


@pytest.mark.slow
def test_the_mean_over_the_samples_stays_below_4_2_per_cent(shared_data: Path) -> None:
    ground_filter = product_filter(GroundSettings())
    rows = [figures_of(scene, labels_of(scene, ground_filter)) for scene in samples(shared_data)]
    assert len(rows) == 9
    assert not {row.name for row in rows} & set(KEPT_ASIDE)
    assert np.mean([row.total for row in rows]) < 4.2
    assert np.mean([row.kappa for row in rows]) > 84.0


def test_the_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--only", "gaps", "--densities", "0.2"])
    out = capsys.readouterr().out
    assert "| gaps 0.2 |" in out
    assert "| mean of drawn scenes |" in out
