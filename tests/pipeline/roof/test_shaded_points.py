"""Hidden points on the plane of a lower roof belong to it; facades and points far from the roof stay out."""

import dataclasses

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.methods import ReconstructSettings
from pipeline.model import Candidate, IntArray, Plane, PreparedCloud
from pipeline.prepared_cloud import prepare_cloud
from pipeline.quality.residuals import vertical_residuals
from pipeline.recipe import reconstruct_building
from pipeline.roof.plan import RoofPoints, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.shaded_points import with_shaded_points

LOW_M, HIGH_M = 3.0, 7.0
PLANES = tuple(Plane(a=0.0, b=0.0, c=height, n_points=100, rmse_m=0.02) for height in (LOW_M, HIGH_M))


def house(strip_m: float, *, facade: int = 0, seed: int = 0) -> Candidate:
    """A flat house of 10 m by 8 m with a lower strip along one end, 10 points per m2, and points on the wall."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 10, 800), rng.uniform(0, 8, 800)
    z = np.where(x < strip_m, LOW_M, HIGH_M) + rng.normal(0, 0.02, 800)
    wall = np.column_stack(
        (np.full(facade, strip_m - 0.02), rng.uniform(0, 8, facade), rng.uniform(LOW_M + 0.5, HIGH_M - 0.5, facade))
    )
    return candidate(np.vstack((np.column_stack((x, y, z)), wall)), footprint=shapely.box(0, 0, 10, 8))


def labelled(one: Candidate) -> tuple[PreparedCloud, RoofPoints]:
    cloud = prepare_cloud(one)
    roof = roof_points(cloud, RoofSettings())
    nearest = np.abs(roof.points[:, 2, None] - [LOW_M, HIGH_M]).argmin(axis=1).astype(np.int32)
    on_plane = np.abs(roof.points[:, 2, None] - [LOW_M, HIGH_M]).min(axis=1) < 0.1
    return cloud, dataclasses.replace(roof, labels=np.where(on_plane, nearest, -1).astype(np.int32))


def test_a_low_strip_gets_its_points_at_the_wall() -> None:
    cloud, roof = labelled(house(1.0))
    more = with_shaded_points(roof, cloud, PLANES)
    low = cloud.candidate.points[:, 2] < 0.5 * (LOW_M + HIGH_M)
    positions = len(np.unique(cloud.candidate.points[low, :2], axis=0))
    assert (roof.labels == 0).sum() < 0.7 * positions
    assert (more.labels == 0).sum() == positions
    assert (more.labels == 1).sum() == (roof.labels == 1).sum()
    assert np.array_equal(more.points, cloud.candidate.points[more.index])
    assert len(np.unique(more.xy_mm, axis=0)) == len(more.xy_mm)


def test_points_of_a_facade_stay_out() -> None:
    cloud, roof = labelled(house(1.0, facade=100))
    more = with_shaded_points(roof, cloud, PLANES)
    z = more.points[more.labels >= 0, 2]
    assert np.abs(z[:, None] - [LOW_M, HIGH_M]).min(axis=1).max() < 0.21


def test_points_beneath_the_edge_of_the_upper_roof_stay_out() -> None:
    """The lower roof goes on beneath an eave, where pulses through gaps of the upper roof meet it."""
    rng = np.random.default_rng(4)
    beneath = np.column_stack((rng.uniform(1.0, 1.5, 60), rng.uniform(0, 8, 60), np.full(60, LOW_M)))
    one = house(1.0)
    cloud, roof = labelled(dataclasses.replace(one, points=np.vstack((one.points, beneath))))
    more = with_shaded_points(roof, cloud, PLANES)
    added = cloud.candidate.points[np.setdiff1d(more.index, roof.index)]
    assert (added[:, 0] < 1.0).sum() > 20
    assert 20 < (beneath[:, 0] > 1.25).sum() > 2 * (added[:, 0] > 1.25).sum()


def test_hidden_points_far_from_the_roof_on_their_plane_stay_out() -> None:
    cloud, roof = labelled(house(1.0))
    beyond = dataclasses.replace(roof, labels=np.where(roof.points[:, 1] < 4.0, roof.labels, -1).astype(np.int32))
    more = with_shaded_points(beyond, cloud, PLANES)
    added = np.setdiff1d(more.index, beyond.index)
    assert len(added) > 5
    assert cloud.candidate.points[added, 1].max() < 5.1


def test_without_hidden_points_the_roof_stays_as_it_is() -> None:
    cloud, roof = labelled(house(0.0))
    assert with_shaded_points(roof, cloud, PLANES) is roof


@pytest.mark.parametrize("strip_m", [0.7, 1.0, 1.5])
def test_a_narrow_lower_level_is_modelled_up_to_the_wall(strip_m: float) -> None:
    one = house(strip_m)
    result = reconstruct_building(one, "arrangement", ReconstructSettings())
    low = one.points[:, 2] < 0.5 * (LOW_M + HIGH_M)
    near = np.abs(vertical_residuals(one.points, result.faces, result.planes)) < 0.2
    assert near[low].mean() > 0.9
    assert near[~low].mean() > 0.98


def test_roof_points_ascend_in_plan_whatever_the_order_of_the_candidate_s() -> None:
    rng = np.random.default_rng(3)
    points = np.rint(np.column_stack((rng.uniform(0, 12, (2000, 2)), rng.uniform(5, 6, 2000))) * 1e3) / 1e3
    ground = np.column_stack((np.full(4, -3.0), np.arange(4.0), np.zeros(4)))

    def found(order: IntArray) -> RoofPoints:
        one = Candidate(
            building_id="",
            origin=(0.0, 0.0, 0.0),
            points=points[order],
            ground=ground,
            ground_z_m=0.0,
            split_returns=points[::7],
        )
        return roof_points(prepare_cloud(one), RoofSettings())

    shuffled, sorted_ = found(rng.permutation(2000)), found(np.lexsort((points[:, 1], points[:, 0])))
    np.testing.assert_array_equal(shuffled.xy_mm, sorted_.xy_mm)
    np.testing.assert_array_equal(shuffled.split, sorted_.split)
    assert sorted_.split.sum() > 100
