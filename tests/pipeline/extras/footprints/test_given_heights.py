"""Heights among the attributes of footprints: which values count, and what block they give."""

import math
import re
from typing import Any

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import BuildingError
from pipeline.extras.footprints.given_heights import given_block, given_heights
from pipeline.methods import ReconstructSettings
from pipeline.model import Candidate, GivenHeights, GroundSource, HeightSource, Reason, Status
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.roof_settings import FootprintSettings

NAMED = FootprintSettings(height="h", roof_elevation="roof", storeys="n", ground_elevation="ground")
LACK = BuildingError(Reason.TOO_FEW_POINTS, "2 roof points")


def candidate(heights: GivenHeights | None, points: Any = (), **changes: Any) -> Candidate:
    """An L-shaped footprint with a few points or none."""
    outline = shapely.union(shapely.box(0.0, 0.0, 10.0, 4.0), shapely.box(0.0, 0.0, 3.0, 9.0))
    words = {"footprint": outline, "given": heights, "ground_z_m": math.nan} | changes
    return Candidate(
        building_id="a",
        origin=(0.0, 0.0, 0.0),
        points=np.array(points, float).reshape(-1, 3),
        ground=np.zeros((0, 3)),
        **words,
    )


@pytest.mark.parametrize(
    ("value", "metres"), [(7, 7.0), (7.5, 7.5), ("7.5", 7.5), (" 3 ", 3.0), (None, None), ("", None), (" ", None)]
)
def test_numbers_count_also_as_texts_and_empty_values_are_no_faults(value: Any, metres: float | None) -> None:
    found, faults = given_heights({"h": value}, FootprintSettings(height="h"), 1.0)
    assert (None if found is None else found.height_m) == metres
    assert faults == []


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("h", -3.0, r"h is -3 m: a building has 0\.1 to 1000 m"),
        ("h", 0, r"h is 0 m"),
        ("h", 4000, r"h is 4000 m"),
        ("h", "tall", r"h is 'tall': not a number"),
        ("h", "12 m", r"h is '12 m': not a number"),
        ("h", "nan", r"h is 'nan': not a number"),
        ("h", "1e999", r"h is '1e999': not a number"),
        ("h", True, r"h is 'True': not a number"),
        ("h", [3], r"h is '\[3\]': not a number"),
        ("h", 10**400, r"not a number"),
        ("n", 2000, r"n is 2000 storeys: a building has 0\.1 to 300 storeys"),
        ("roof", 12_000.0, r"roof is 12000 m"),
        ("ground", -9999, r"ground is -9999 m"),
    ],
)
def test_a_value_that_no_building_has_is_a_fault_and_counts_as_missing(column: str, value: Any, words: str) -> None:
    found, faults = given_heights({column: value}, NAMED, 1.0)
    assert found is None
    (fault,) = faults
    assert re.search(words, fault), fault


def test_feet_become_metres_and_storeys_do_not() -> None:
    attributes = {"h": 20.0, "roof": 120.0, "n": 3, "ground": 100.0}
    found, faults = given_heights(attributes, NAMED, 0.3048)
    assert faults == []
    assert found is not None
    assert found.height_m == pytest.approx(6.096)
    assert (found.roof_z_m, found.ground_z_m) == pytest.approx((36.576, 30.48))
    assert found.storeys_m == 9.0
    # a fault names the value as the file has it
    assert given_heights({"h": "20000"}, FootprintSettings(height="h"), 0.3048)[1] == [
        "its h is 20000 (6096 m): a building has 0.1 to 1000 m"
    ]


@pytest.mark.parametrize(
    ("heights", "source", "ground", "roof_z_m"),
    [
        (GivenHeights(height_m=7.0, roof_z_m=20.0, storeys_m=6.0, terrain_z_m=2.0), "height", "terrain", 9.0),
        (
            GivenHeights(roof_z_m=20.0, storeys_m=6.0, terrain_z_m=2.0, ground_z_m=1.0),
            "roof_elevation",
            "terrain",
            20.0,
        ),
        (GivenHeights(storeys_m=6.0, ground_z_m=1.0), "storeys", "attribute", 7.0),
        # a roof below the ground is no roof: the storeys remain
        (GivenHeights(roof_z_m=1.5, storeys_m=6.0, terrain_z_m=2.0), "storeys", "terrain", 8.0),
    ],
)
def test_the_first_height_that_fits_the_ground_counts(
    heights: GivenHeights, source: str, ground: str, roof_z_m: float
) -> None:
    block = given_block(candidate(heights), LACK)
    assert (block.height_source, block.ground_source) == (HeightSource(source), GroundSource(ground))
    assert block.plane.c == roof_z_m


@pytest.mark.parametrize(
    ("heights", "words"),
    [
        (None, ": 2 roof points$"),
        (GivenHeights(height_m=7.0), "2 roof points; its ground is neither"),
        (GivenHeights(ground_z_m=7.0), "2 roof points; no attribute gives its height"),
        (GivenHeights(roof_z_m=3.0, terrain_z_m=7.0), r"above it: roof_elevation -4\.0 m"),
        (GivenHeights(roof_z_m=3000.0, terrain_z_m=7.0), r"above it: roof_elevation 2993\.0 m"),
    ],
)
def test_without_ground_or_height_the_reason_stays_and_says_why(heights: GivenHeights | None, words: str) -> None:
    with pytest.raises(BuildingError, match=words) as raised:
        given_block(candidate(heights), LACK)
    assert raised.value.reason is Reason.TOO_FEW_POINTS
    failed = reconstruct_building(candidate(heights), "arrangement", ReconstructSettings())
    assert (failed.status, failed.reason, failed.solids) == (Status.FAILED, Reason.TOO_FEW_POINTS, ())


@settings(max_examples=examples(30), deadline=None)
@given(
    height_m=st.floats(0.1, 900.0),
    ground_m=st.floats(-400.0, 5000.0),
    n_points=st.integers(0, 3),
    lods=st.sampled_from([("1.2",), ("2.2",), ("1.2", "1.3", "2.2")]),
)
def test_the_block_fills_the_footprint_with_the_height_and_claims_no_accuracy(
    height_m: float, ground_m: float, n_points: int, lods: tuple[str, ...]
) -> None:
    points = [[1.0 + k, 1.0, ground_m + 300.0] for k in range(n_points)]
    known = GivenHeights(height_m=height_m, terrain_z_m=ground_m)
    found = reconstruct_building(candidate(known, points), "arrangement", ReconstructSettings(lods=lods))
    assert (found.status, found.reason, found.lod) == (Status.FALLBACK, Reason.HEIGHT_GIVEN, "1.2")
    (solid,) = found.solids
    assert check_solid(solid) == ()
    z = solid.vertices[:, 2]
    assert z.min() == pytest.approx(ground_m, abs=6e-4)
    assert np.ptp(z) == pytest.approx(height_m, abs=1.1e-3)
    assert found.footprint is not None
    assert found.footprint.area == pytest.approx(55.0)
    assert found.footprint_share == pytest.approx(1.0)
    assert found.n_points == n_points
    figures = (found.rmse_m, found.p95_m, found.coverage, found.quality.noise_m, found.quality.ridge_z_sigma_m)
    assert all(math.isnan(figure) for figure in figures)
    assert (found.height_source, found.ground_source) == (HeightSource.HEIGHT, GroundSource.TERRAIN)


def test_points_come_before_attributes() -> None:
    east, north = np.meshgrid(np.arange(0.25, 10.0, 0.5), np.arange(0.25, 4.0, 0.5))
    points = np.column_stack((east.ravel(), north.ravel(), np.full(east.size, 5.0)))
    plain, known = (
        reconstruct_building(
            candidate(heights, points, footprint=shapely.box(0.0, 0.0, 10.0, 4.0), ground_z_m=0.0),
            "arrangement",
            ReconstructSettings(),
        )
        for heights in (None, GivenHeights(height_m=30.0, terrain_z_m=0.0))
    )
    assert known.status is Status.OK
    assert known.height_source is HeightSource.POINTS
    assert np.array_equal(known.solids[0].vertices, plain.solids[0].vertices)
