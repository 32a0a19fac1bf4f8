"""A model beside the true buildings of its scene: right or wrong, and why."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import BoolArray, FloatArray
from pipeline.quality.residuals import TopSurface
from pipeline.ruler.evaluation.models import RoofModel

LEAST_SHARE = 0.7
"""Of the area in plan within the tolerance, in a right model."""
COVERED_SHARE = 0.5
"""Of a model that lies over true buildings; of a true building that has a model."""
BOX_SHARE = 0.4
"""Of the box around a rejected object that lies over true buildings, if it is one: turned houses do not fill theirs."""
STEP_M, LIFT_STEP_M = 0.25, 0.05
"""Distance of the places at which roofs are compared, and of the elevations that are tried for strips that disagree."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judgement:
    """A model beside the truth."""

    right: bool
    """Whether it is of a building, and near enough to its roof."""
    wrong_because: str | None
    """not_a_building, roof_under_it or roof_of_building; None if it is right."""
    covered_share: float
    """Share of the model that lies over true buildings."""
    share_under: float
    """Share of the true roofs under it within the tolerance; 0 without any."""
    share_of_building: float
    """Share of the roof of the true building that it stands for within the tolerance of it."""
    share_together: float
    """The same share within the tolerance of all models of the run."""
    true_building: str | None
    """The true building under most of it."""
    true_area_m2: float
    """Plan area of that building; 0 without one."""


class Truth:
    """The true buildings of a scene."""

    def __init__(self, buildings: Sequence[RoofModel]) -> None:
        self.buildings = buildings
        self.outlines = np.array([building.footprint for building in buildings], dtype=object)
        self.plan = shapely.union_all(self.outlines)
        self.top = top_of(buildings)

    def judge(
        self, model: RoofModel, tolerance_m: float, lift_m: float = 0.0, all_models: TopSurface | None = None
    ) -> Judgement:
        """Hold a model against the truth, which may be up to `lift_m` higher than it is.

        `all_models` is the top surface of all models of the run; None if this is the only one.
        """
        shared = shapely.area(shapely.intersection(self.outlines, model.footprint))
        covered = shapely.intersection(self.plan, model.footprint).area / model.footprint.area
        top = top_of([model])
        best = (0.0, 0.0, 0.0)
        building = self.buildings[int(np.argmax(shared))] if shared.any() else None
        if building is not None:
            under, own = places_in(model.footprint), places_in(building.footprint)
            roof = top_of([building])
            gaps = gap(top, self.top, under), gap(top, roof, own), gap(all_models or top, roof, own)
            beneath = ~np.isnan(self.top.elevation(*under.T))
            for lift in np.arange(0.0, lift_m + LIFT_STEP_M / 2, LIFT_STEP_M):
                within = [np.abs(one - lift) <= tolerance_m for one in gaps]
                near = _share(within[0], beneath), float(within[1].mean()), float(within[2].mean())
                best = max(best, near, key=lambda one: min(one[0], max(one[1:])))
        why = None
        if covered < COVERED_SHARE or building is None:
            why = "not_a_building"
        elif best[0] < LEAST_SHARE:
            why = "roof_under_it"
        elif max(best[1:]) < LEAST_SHARE:
            why = "roof_of_building"
        return Judgement(
            right=why is None,
            wrong_because=why,
            covered_share=covered,
            share_under=best[0],
            share_of_building=best[1],
            share_together=best[2],
            true_building=None if building is None else building.building_id,
            true_area_m2=0.0 if building is None else building.footprint.area,
        )

    def without_model(self, models: Sequence[RoofModel]) -> list[str]:
        """The buildings of which models cover less than half."""
        modelled = shapely.union_all([model.footprint for model in models])
        return [
            building.building_id
            for building in self.buildings
            if shapely.intersection(building.footprint, modelled).area < COVERED_SHARE * building.footprint.area
        ]

    def is_building(self, box: shapely.Geometry | None) -> bool:
        """Whether a box holds most of a true building, and little else."""
        if box is None or not box.area or not len(self.outlines):
            return False
        shares = shapely.area(shapely.intersection(self.outlines, box)) / shapely.area(self.outlines)
        return bool(shares.max() >= COVERED_SHARE) and shapely.intersection(self.plan, box).area >= BOX_SHARE * box.area


def _share(flags: BoolArray, among: BoolArray) -> float:
    return float(flags[among].mean()) if among.any() else 0.0


def top_of(models: Sequence[RoofModel]) -> TopSurface:
    """The top surface of the roofs of models."""
    faces = [face for model in models for face in model.surfaces]
    return TopSurface(
        [face.polygon for face in faces],
        np.array([face.coefficients for face in faces]).reshape(-1, 3),
        np.array([face.origin for face in faces]).reshape(-1, 3),
        tolerance_m=0.002,
    )


def gap(above: TopSurface, below: TopSurface, places: FloatArray) -> FloatArray:
    """One surface minus another at places (n, 2), (n,) m; nan where one is missing."""
    x, y = places.T
    return above.elevation(x, y) - below.elevation(x, y)


def places_in(outline: shapely.Geometry) -> FloatArray:
    """Places (n, 2) of a lattice of `STEP_M` inside an outline; one inside it if it is smaller."""
    x0, y0, x1, y1 = outline.bounds
    x, y = np.meshgrid(np.arange(x0 + STEP_M / 2, x1, STEP_M), np.arange(y0 + STEP_M / 2, y1, STEP_M))
    inside = shapely.contains_xy(outline, x, y)
    if not inside.any():
        return shapely.get_coordinates(outline.representative_point())
    return np.column_stack([x[inside], y[inside]])
