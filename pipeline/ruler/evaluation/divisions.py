"""Models that divide a block rightly into its houses count as one model of the block.

True buildings that touch are judged as one block (`blocks`), since points do not always show where a house of a row
ends. Models may still divide the row, and a right division must not cost the block. A division is right if each of its
models stands for one house, or for several that touch: the IoU with them is at least 0.8. One wall in a wrong place, or
a cut through a house, and the models stay as they are: no part of a block stands for the whole.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline.model import BoolArray, FloatArray, IntArray, Status
from pipeline.ruler.evaluation.block_scores import block_numbers, joined_building
from pipeline.ruler.evaluation.building_matching import MIN_SHARE, Overlaps, overlapping, sound_polygons, summed
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference

MIN_PART_IOU = 0.8
"""Least IoU of a part with its houses: in a row of houses 6 m wide, a wall may be off by 0.6 m on either side."""
_ROUNDING = 1e-9
"""Numerical guard for comparisons of shares."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WholeModels:
    """Models as they are judged against blocks."""

    models: tuple[RoofModel, ...]
    """(w,) the models, where those of a right division are joined to one in the place of the first of them."""
    whole_of: IntArray
    """(m,) int64, index into `models` of each delivered model."""
    names: tuple[tuple[str, ...], ...]
    """(w,) the building_ids of the delivered models in each."""

    @property
    def divided(self) -> int:
        """Number of blocks that are divided rightly."""
        return sum(len(names) > 1 for names in self.names)


def undivided(models: Sequence[RoofModel]) -> WholeModels:
    """Each model alone: where houses are judged one by one."""
    names = tuple((model.building_id,) for model in models)
    return WholeModels(models=tuple(models), whole_of=np.arange(len(models)), names=names)


def whole_models(models: Sequence[RoofModel], houses: Reference) -> WholeModels:
    """The models, right divisions of blocks joined; the reference still has its single houses.

    A part is a model of which at least half lies on one block, and the block has several. It stands for the houses of
    which it covers at least half and more than any other part. A block without a part, or with a single one, keeps its
    model. The joined model has the status and the level of detail of its weakest part, and no solids.
    """
    numbers = block_numbers(houses.buildings)
    made = sound_polygons([model.footprint for model in models])
    true = sound_polygons([house.footprint for house in houses.buildings])
    made_m2 = np.array([footprint.area for footprint in made])
    true_m2 = np.array([footprint.area for footprint in true])
    pairs = overlapping(true, made)
    block_of = _block_of(pairs, numbers, made_m2)
    is_right = _is_right(pairs, _owners(pairs, numbers, block_of, true_m2), true_m2, made_m2)
    parts: dict[int, list[int]] = {}
    for k, block in enumerate(block_of.tolist()):
        if block >= 0:
            parts.setdefault(block, []).append(k)
    division_of = {
        k: members for members in parts.values() if len(members) > 1 and is_right[members].all() for k in members
    }
    wholes: list[RoofModel] = []
    names: list[tuple[str, ...]] = []
    whole_of = np.full(len(models), -1, np.int64)
    for k, model in enumerate(models):
        if whole_of[k] >= 0:
            continue
        members = division_of.get(k, [k])
        whole_of[members] = len(wholes)
        wholes.append(model if len(members) == 1 else _joined([models[i] for i in members], made[members].tolist()))
        names.append(tuple(models[i].building_id for i in members))
    return WholeModels(models=tuple(wholes), whole_of=whole_of, names=tuple(names))


def _block_of(pairs: Overlaps, numbers: IntArray, made_m2: FloatArray) -> IntArray:
    """The block that holds at least half of each model, (m,); -1 for none."""
    count = int(numbers.max()) + 1 if len(numbers) else 0
    found = np.full(len(made_m2), -1, np.int64)
    if count == 0 or len(pairs.first) == 0:
        return found
    key, place = np.unique(pairs.second * count + numbers[pairs.first], return_inverse=True)
    common_m2 = summed(place, pairs.common_m2, len(key))
    model, block = key // count, key % count
    enough = common_m2 >= (MIN_SHARE - _ROUNDING) * made_m2[model]
    found[model[enough]] = block[enough]
    return found


def _owners(pairs: Overlaps, numbers: IntArray, block_of: IntArray, true_m2: FloatArray) -> BoolArray:
    """Which pairs, (p,), are a house and the part of its block that stands for it."""
    own = np.flatnonzero(
        (block_of[pairs.second] == numbers[pairs.first])
        & (pairs.common_m2 >= (MIN_SHARE - _ROUNDING) * true_m2[pairs.first])
    )
    # The largest common area of each house comes first, then the smallest index.
    order = own[np.lexsort((pairs.second[own], -pairs.common_m2[own], pairs.first[own]))]
    owners = np.zeros(len(pairs.first), np.bool_)
    owners[order[np.unique(pairs.first[order], return_index=True)[1]]] = True
    return owners


def _is_right(pairs: Overlaps, owners: BoolArray, true_m2: FloatArray, made_m2: FloatArray) -> BoolArray:
    """Whether each model, (m,), agrees with the houses that it stands for; true footprints do not overlap."""
    model = pairs.second[owners]
    common_m2 = summed(model, pairs.common_m2[owners], len(made_m2))
    houses_m2 = summed(model, true_m2[pairs.first[owners]], len(made_m2))
    right: BoolArray = common_m2 >= (MIN_PART_IOU - _ROUNDING) * (houses_m2 + made_m2 - common_m2)
    return right & (common_m2 > 0.0)


def _joined(parts: Sequence[RoofModel], footprints: Sequence[object]) -> RoofModel:
    """The parts of a division as one model."""
    sound = [dataclasses.replace(part, footprint=area) for part, area in zip(parts, footprints, strict=True)]
    weakest = min(parts, key=lambda part: (part.status is Status.OK, part.lod))
    joined = joined_building(sound, [surface for part in parts for surface in part.surfaces])
    return dataclasses.replace(joined, status=weakest.status, lod=weakest.lod)
