"""Points of sparse surveys: the terms against a slow twin, and what becomes of roofs, walls and trees."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from pipeline.extras.classify.point_classes import PointClass, PointEvidence, classes_of, support_m
from pipeline.extras.classify.sparse_points import (
    PRODUCT_WEIGHTS,
    SIGN_WEIGHTS,
    Role,
    Sign,
    SparsePoints,
    likely_building,
    terms_of,
)
from pipeline.terrain.terrain_settings import VegetationSettings


def random_points(seed: int = 4) -> SparsePoints:
    """150 points on 24 x 24 m, also west and south of the origin."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(-12_000, 12_000, (2, 150))
    z = rng.integers(0, 9000, 150)
    role = rng.choice([-1, 0, 1, 2], 150, p=[0.1, 0.3, 0.3, 0.3]).astype(np.int8)
    return SparsePoints(x_mm=x, y_mm=y, z_mm=z, height_mm=z + 100, role=role, several=rng.random(150) < 0.4)


def signs_of(p: SparsePoints, i: int) -> dict[Sign, float]:
    """The signs of one point by whole arrays."""
    away = np.hypot(p.x_mm - p.x_mm[i], p.y_mm - p.y_mm[i])
    dz = p.z_mm - p.z_mm[i]
    other = (np.arange(len(away)) != i) & (p.role >= 0)
    stands, held = other & (p.role > 0), other & (p.role == Role.HELD)
    near, around, far = (away <= reach for reach in (3000, 6000, 10_000))

    def share(part: Any, whole: Any) -> float:
        return float((part & whole).sum() / max(whole.sum(), 1))

    def thickness(within: Any) -> float:
        band = stands & within & (abs(dz) <= 1500)
        band[i] = True
        places = np.column_stack((p.x_mm, p.y_mm, p.z_mm))[band] / 1000.0
        if len(places) < 4:
            return 0.1
        return min(0.6, float(np.sqrt(max(0.0, np.linalg.eigvalsh(np.cov(places.T, bias=True))[0]))))

    level = abs(dz) <= 500
    height = np.log(np.clip(p.height_mm[i] / 1000.0, 0.5, 40.0) / 4.0)
    nearest = away[held & around].min() if (held & around).any() else 10_000.0
    top = dz[held & near].max() if (held & near).any() else 0
    return {
        Sign.HELD_SHARE: share(held, stands & around),
        Sign.PIERCED_AROUND: share(p.several, stands & around),
        Sign.PIERCED_NEAR: share(p.several, stands & near),
        Sign.PIERCED_HELD: share(p.several, held & far),
        Sign.PIERCED: float(p.several[i]),
        Sign.LOG_HELD_NEAR: np.log1p((held & near).sum()),
        Sign.LOG_LEVEL: np.log1p((stands & around & level).sum()),
        Sign.LOG_HELD_LEVEL: np.log1p((held & around & level).sum()),
        Sign.LEVEL_SHARE: share(level, stands & around),
        Sign.LOG_HEIGHT: height,
        Sign.LOG_HEIGHT_2: height**2,
        Sign.LOG_DENSITY: np.log(((other & far).sum() + 1) / (100.0 * np.pi)),
        Sign.STANDING_SHARE: share(stands, other & far),
        Sign.GROUND_SHARE: share(p.role == Role.GROUND, other & near),
        Sign.THICKNESS_NEAR: thickness(near),
        Sign.UNDER: float(np.clip(top, 0, 10_000)) / 1000.0,
        Sign.HELD: float(p.role[i] == Role.HELD),
        Sign.SIZE: np.log1p((held & far).sum()),
        Sign.AWAY: min(nearest, 6500.0) / 1000.0,
        Sign.THICKNESS_AROUND: thickness(around),
    }


def test_the_terms_are_those_of_a_full_search() -> None:
    points = random_points()
    wanted = points.role > 0
    terms = terms_of(points, wanted)
    assert list(SIGN_WEIGHTS) == list(Sign)
    assert terms.shape == (150, len(SIGN_WEIGHTS) + len(PRODUCT_WEIGHTS))
    for i in range(150):
        if not wanted[i]:
            assert not terms[i].any()
            continue
        signs = signs_of(points, i)
        expected = [signs[sign] for sign in Sign] + [signs[a] * signs[b] for a, b in PRODUCT_WEIGHTS]
        assert terms[i] == pytest.approx(expected, abs=1e-9)


def test_order_place_and_the_other_wanted_points_change_nothing() -> None:
    points = random_points(7)
    wanted = points.role > 0
    terms = terms_of(points, wanted)
    order = np.random.default_rng(1).permutation(150)
    mixed = terms_of(SparsePoints(*(column[order] for column in points)), wanted[order])
    assert (mixed == terms[order]).all()
    moved = terms_of(points._replace(x_mm=points.x_mm + 85_000_000, y_mm=points.y_mm - 447_000_000), wanted)
    assert (moved == terms).all()
    some = wanted & (np.arange(150) % 2 == 0)
    assert (terms_of(points, some) == np.where(some[:, None], terms, 0.0)).all()
    likely = likely_building(points, wanted)
    assert 0 < likely.sum() < wanted.sum()
    assert (likely_building(points, some) == (likely & some)).all()


def test_no_points_have_no_terms() -> None:
    empty = SparsePoints(*(column[:0] for column in random_points()))
    assert terms_of(empty, np.empty(0, np.bool_)).shape == (0, len(SIGN_WEIGHTS) + len(PRODUCT_WEIGHTS))
    assert len(likely_building(empty, np.empty(0, np.bool_))) == 0


PARTS = ("ground", "roof", "rim", "wall", "tree on the roof", "tree")


def sparse_scene(*, several: bool = True) -> tuple[PointEvidence, Any]:
    """A gable roof of 12 x 24 m at 0.5 points/m2 and two trees; the rim and the walls are in no candidate."""
    rng = np.random.default_rng(11)

    def box(count: int, x0: float, x1: float, y0: float, y1: float) -> Any:
        return rng.uniform((x0, y0), (x1, y1), (count, 2))

    ground = box(1400, -30, 50, -30, 50)
    ground = ground[~((ground[:, 0] > 0) & (ground[:, 0] < 12) & (ground[:, 1] > 0) & (ground[:, 1] < 24))]
    roof, rim = box(90, 1, 11, 1, 23), box(16, 11, 12, 0, 24)
    wall = np.column_stack((np.full(12, 12.0), rng.uniform(0, 24, 12)))
    crown, tree = box(40, -7, 0, 4, 12), box(80, 21, 33, 3, 15)
    flat = [ground, roof, rim, wall, crown, tree]

    def gable(xy: Any) -> Any:
        return 9.0 - 0.5 * abs(xy[:, 0] - 6.0) + rng.normal(0, 0.03, len(xy))

    z = [
        rng.normal(0, 0.03, len(ground)), gable(roof), gable(rim), rng.uniform(2, 5.5, 12),
        rng.uniform(3, 10, 40), rng.uniform(3, 14, 80),
    ]  # fmt: skip
    part = np.repeat(np.arange(len(PARTS)), [len(xy) for xy in flat])
    leafy = np.isin(part, (4, 5)) & several
    mm = np.rint(1000 * np.column_stack((np.vstack(flat), np.concatenate(z)))).astype(np.int64)
    x, y, up = mm.T.copy()
    evidence = PointEvidence(
        x_mm=x, y_mm=y, z_mm=up, height_mm=up.copy(), rise_mm=np.zeros_like(up), ground=part == 0,
        building=np.isin(part, (1, 4)), outlier=np.zeros(len(x), np.bool_), echoes=leafy,
    )  # fmt: skip
    return evidence, part


def shares(evidence: PointEvidence, part: Any, *, given: bool = False) -> dict[str, float]:
    """The share of class 6 in each part."""
    found = classes_of(evidence, np.ones(len(part), np.bool_), VegetationSettings(), given=given)
    return {name: float((found[part == k] == PointClass.BUILDING).mean()) for k, name in enumerate(PARTS)}


def test_a_sparse_roof_gains_its_rim_and_walls_and_loses_the_tree_at_its_side() -> None:
    found = shares(*sparse_scene())
    assert found["ground"] == 0
    assert found["roof"] > 0.95
    assert min(found["rim"], found["wall"]) > 0.8
    assert found["tree on the roof"] < 0.1
    assert found["tree"] == 0


def test_given_buildings_and_files_of_single_returns_keep_their_points() -> None:
    evidence, part = sparse_scene()
    for found in (shares(evidence, part, given=True), shares(*sparse_scene(several=False))):
        assert found["roof"] == found["tree on the roof"] == 1
        assert found["ground"] == found["tree"] == 0


def test_points_beyond_the_halo_change_nothing() -> None:
    evidence, _ = sparse_scene()
    reach = round(1000 * support_m(VegetationSettings()))
    wanted = (abs(evidence.x_mm - 10_000) < 8000) & (abs(evidence.y_mm - 8000) < 8000)
    seen = (abs(evidence.x_mm - 10_000) < 8000 + reach) & (abs(evidence.y_mm - 8000) < 8000 + reach)
    assert not seen.all()
    found = classes_of(evidence, wanted, VegetationSettings())
    window = PointEvidence(**{f.name: getattr(evidence, f.name)[seen] for f in dataclasses.fields(evidence)})
    assert (classes_of(window, wanted[seen], VegetationSettings()) == found[seen]).all()


def test_a_dense_survey_is_not_judged_point_by_point() -> None:
    evidence, part = sparse_scene()
    columns = {f.name: getattr(evidence, f.name) for f in dataclasses.fields(evidence)}
    dense = {name: np.repeat(column, 12) for name, column in columns.items()}
    for axis in ("x_mm", "y_mm"):
        dense[axis] = dense[axis] + np.tile(np.arange(12) * 7, len(part))
    found = shares(PointEvidence(**dense), np.repeat(part, 12))
    assert found["tree on the roof"] == 1
