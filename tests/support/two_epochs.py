"""Two epochs of one scene: before and after changes to some buildings, and the change of each.

Each changed building undergoes one kind of change. New buildings are part of the whole scene and are left out of the
earlier one, so both scenes are as plausible as their suite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from enum import StrEnum

import numpy as np
import shapely

from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Building, Scene, Terrain, outline_samples, place_building


class Work(StrEnum):
    """A change of a building between two epochs."""

    BUILT = "built"
    DEMOLISHED = "demolished"
    RAISED = "raised"
    LOWERED = "lowered"
    NEW_ROOF = "new_roof"
    EXTENDED = "extended"


STOREY_M = 2.8
"""Height by which walls are raised or lowered."""
MIN_EAVE_M = 2.2
"""No walls are made lower than this."""
EXTENSION_M = 4.0
"""Length by which a building grows along its ridge."""
_CLEARANCE_M = 1.5
"""Smallest distance of a changed building to its neighbours."""

_OTHER_ROOF: Mapping[RoofShape, tuple[RoofShape, float]] = {
    RoofShape.GABLE: (RoofShape.FLAT, 0.0),
    RoofShape.HIP: (RoofShape.GABLE, 45.0),
    RoofShape.FLAT: (RoofShape.GABLE, 35.0),
    RoofShape.PENT: (RoofShape.GABLE, 40.0),
}
"""The shape and the pitch that take the place of a roof."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoEpochs:
    """A scene before and after."""

    earlier: Scene
    """Before."""
    later: Scene
    """After."""
    works: Mapping[str, Work]
    """The change of each changed building, by building_id."""


def two_epochs(scene: Scene, seed: int, *, share: float = 0.25, kinds: Sequence[Work] = tuple(Work)) -> TwoEpochs:
    """Change some buildings of a scene.

    Parameters
    ----------
    seed : int
        Which buildings; not negative.
    share : float
        Share of buildings to change, about: a kind that a building cannot undergo passes on to the next one.
    kinds : sequence of Work
        What may happen, in turns.
    """
    random = np.random.default_rng([seed, 0x2E])
    outlines = shapely.STRtree([building.footprint for building in scene.buildings])
    works: dict[str, Work] = {}
    changed: dict[str, Building] = {}
    wanted = max(len(kinds), round(share * len(scene.buildings)))
    turn = 0
    for number in random.permutation(len(scene.buildings)).tolist():
        if turn == wanted:
            break
        building, kind = scene.buildings[number], kinds[turn % len(kinds)]
        made = _worked_on(building, kind, scene.terrain)
        if made is None or not _has_room(made, number, outlines):
            continue
        works[building.building_id] = kind
        changed[building.building_id] = made
        turn += 1
    earlier = [one for one in scene.buildings if works.get(one.building_id) is not Work.BUILT]
    later = [
        changed.get(one.building_id, one)
        for one in scene.buildings
        if works.get(one.building_id) is not Work.DEMOLISHED
    ]
    return TwoEpochs(
        earlier=dataclasses.replace(scene, buildings=tuple(earlier)),
        later=dataclasses.replace(scene, buildings=tuple(later)),
        works=works,
    )


def _has_room(made: Building, number: int, outlines: shapely.STRtree) -> bool:
    """Whether a building keeps clear of all others."""
    near = outlines.query(made.footprint, predicate="dwithin", distance=_CLEARANCE_M)
    return set(near.tolist()) <= {number}


def _worked_on(building: Building, kind: Work, terrain: Terrain) -> Building | None:
    """The building afterwards; None if it cannot undergo the change. Built and demolished ones stay as they are."""
    size = building.dimensions
    eave_m = _eave_height_m(building, terrain)
    if kind in {Work.BUILT, Work.DEMOLISHED}:
        return building
    if kind is Work.RAISED:
        return _placed(building, building.shape, size, eave_m + STOREY_M, terrain)
    if kind is Work.LOWERED:
        lower_m = eave_m - STOREY_M
        return None if lower_m < MIN_EAVE_M else _placed(building, building.shape, size, lower_m, terrain)
    if kind is Work.NEW_ROOF:
        if building.shape not in _OTHER_ROOF:
            return None
        shape, pitch_deg = _OTHER_ROOF[building.shape]
        bare = RoofDimensions(length_m=size.length_m, width_m=size.width_m, pitch_deg=pitch_deg)
        return _placed(building, shape, bare, eave_m, terrain)
    longer = dataclasses.replace(size, length_m=size.length_m + EXTENSION_M)
    return _placed(building, building.shape, longer, eave_m, terrain)


def _eave_height_m(building: Building, terrain: Terrain) -> float:
    """Eave above the highest terrain at the outline, as `place_building` took it."""
    samples = outline_samples(shapely.get_coordinates(building.footprint.exterior)[:-1])
    return building.eave_z_m - float(terrain.elevation(samples[:, 0], samples[:, 1]).max())


def _placed(
    building: Building, shape: RoofShape, size: RoofDimensions, eave_height_m: float, terrain: Terrain
) -> Building:
    """Another building at the same place with the same name."""
    return place_building(
        building.building_id,
        shape,
        size,
        at=(building.x, building.y),
        azimuth_deg=building.azimuth_deg,
        eave_height_m=eave_height_m,
        terrain=terrain,
        block_id=building.block_id,
    )
