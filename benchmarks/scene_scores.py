"""Quality of the split into buildings: outlines of candidates against a reference, by the ruler's measures.

No building is modelled. A candidate's outline is that of its model: the same function draws it.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Iterable, Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.model import Candidate, RoofType, Status
from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.block import block_plane
from pipeline.roof.footprint import polygons_of
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.roof.settings import RoofSettings
from pipeline.ruler.evaluation.detection import Detection, detect
from pipeline.ruler.evaluation.footprints import FootprintRow, score_footprints
from pipeline.ruler.evaluation.matching import match_footprints, sound_polygons
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.scene import BUILDING_CLASS

OBJECT_M2 = 16.0
"""Smallest area of the objects that are asked for."""
_TOUCH_M = 0.3
"""Footprints closer than this touch: surveyed outlines of one wall differ by decimetres."""
_RING_M = (1.0, 3.0)
"""Where the points beside a block are looked at, metres outside its outline."""
_CUT_SHARE = 0.05
"""Share of building points in that ring from which on a block goes on beyond the given footprints."""


def candidate_outline(candidate: Candidate, settings: RoofSettings) -> Polygon | MultiPolygon | None:
    """The outline of a candidate in the CRS's metres; None where a run would deliver no model.

    Parameters
    ----------
    candidate : Candidate
        As a run finds it, without a given footprint.
    settings : RoofSettings
        As for its model.
    """
    try:
        bare = roof_points(prepare_cloud(candidate), settings)
        plane = block_plane(bare.points, candidate.ground_z_m, settings.block_height_percentile)
        labelled = dataclasses.replace(bare, labels=np.zeros(len(bare.points), np.int32))
        outline_mm = partition_roof(labelled, [plane], settings).outline_mm
    except BuildingError:
        return None
    x, y, _ = candidate.origin
    parts = [shapely.transform(part, lambda xy: xy / 1e3 + (x, y)) for part in polygons_of(outline_mm)]
    large = [part for part in parts if part.area >= settings.min_part_area_m2]
    kept = large or sorted(parts, key=lambda part: -part.area)[:1]
    if not kept:
        return None
    return kept[0] if len(kept) == 1 else MultiPolygon(kept)


def outlined_models(candidates: Iterable[Candidate], settings: RoofSettings) -> list[RoofModel]:
    """The candidates that have an outline, as models without roof faces."""
    models = []
    for candidate in candidates:
        footprint = candidate_outline(candidate, settings)
        if footprint is not None:
            models.append(
                RoofModel(
                    building_id=candidate.building_id,
                    footprint=footprint,
                    roof_type=RoofType.UNKNOWN,
                    surfaces=(),
                    touches_data_edge=candidate.touches_data_edge,
                    status=Status.OK,
                    lod="",
                )
            )
    return sorted(models, key=lambda model: model.building_id)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectionScore:
    """Detection of buildings by area and by object; nan where nothing can be asked."""

    completeness: float
    """By area, all cells."""
    correctness: float
    """See there."""
    completeness_without_ring: float
    """By area, without the ring of one cell on either side of the reference's edges."""
    correctness_without_ring: float
    """See there."""
    object_completeness: float
    """Share of the reference's objects of at least 16 m2 of which half lies on models."""
    object_correctness: float
    """Share of the models of at least 16 m2 of which half lies on the reference."""
    objects: int
    """Those reference objects: none that touches the edge of the data."""
    models: int
    """Those models, see there."""
    object_completeness_with_edge: float
    """As `object_completeness`, also of what the edge of the data cuts."""
    object_correctness_with_edge: float
    """As `object_correctness`, also of what the edge of the data cuts."""
    objects_with_edge: int
    """Those reference objects."""
    models_with_edge: int
    """Those models."""


def detection_score(found: Detection, min_m2: float = OBJECT_M2) -> DetectionScore:
    """The figures of a detection."""
    totals = {
        name: sum(getattr(block, name) for block in found.blocks)
        for layer in ("", "_without_ring")
        for name in (f"both{layer}", f"reference{layer}", f"found{layer}")
    }
    all_wanted = [row for row in found.buildings if row.area_m2 >= min_m2]
    all_made = [row for row in found.models if row.area_m2 >= min_m2]
    wanted, made = [row for row in all_wanted if row.counts], [row for row in all_made if row.counts]
    return DetectionScore(
        completeness=_ratio(totals["both"], totals["reference"]),
        correctness=_ratio(totals["both"], totals["found"]),
        completeness_without_ring=_ratio(totals["both_without_ring"], totals["reference_without_ring"]),
        correctness_without_ring=_ratio(totals["both_without_ring"], totals["found_without_ring"]),
        object_completeness=_ratio(sum(row.found for row in wanted), len(wanted)),
        object_correctness=_ratio(sum(row.found for row in made), len(made)),
        objects=len(wanted),
        models=len(made),
        object_completeness_with_edge=_ratio(sum(row.found for row in all_wanted), len(all_wanted)),
        object_correctness_with_edge=_ratio(sum(row.found for row in all_made), len(all_made)),
        objects_with_edge=len(all_wanted),
        models_with_edge=len(all_made),
    )


def detected(models: Sequence[RoofModel], reference: Reference) -> tuple[Detection, DetectionScore]:
    """The rows of a detection and its figures."""
    found = detect(models, reference)
    return found, detection_score(found)


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


# ------------------------------------------------------------------------------------------------------- footprints


def touching_united(reference: Reference, touch_m: float = _TOUCH_M) -> Reference:
    """A reference whose buildings that touch are one block each; gaps up to `touch_m` between them are closed.

    Parameters
    ----------
    reference : Reference
        Its buildings have footprints alone.
    touch_m : float
        Footprints as near as this touch.
    """
    footprints = sound_polygons([building.footprint for building in reference.buildings])
    half = touch_m / 2
    grown = shapely.buffer(footprints, half, join_style="mitre")
    united = shapely.union_all(grown).buffer(-half, join_style="mitre")
    blocks = sorted(polygons_of(united), key=lambda block: block.bounds)
    buildings = tuple(
        RoofModel(
            building_id=f"block-{number}",
            footprint=block,
            roof_type=RoofType.UNKNOWN,
            surfaces=(),
            lod="",
        )
        for number, block in enumerate(blocks)
    )
    return dataclasses.replace(reference, buildings=buildings)


def is_whole(reference: Reference, blocks: Sequence[Polygon | MultiPolygon]) -> list[bool]:
    """Which blocks end where their given footprints end: hardly a building point lies 1 to 3 m beside them.

    Footprints cover a part of the data only; the rest of a row of houses may lie outside.
    """
    rings = [block.buffer(_RING_M[1]).difference(block.buffer(_RING_M[0])) for block in blocks]
    counts = np.zeros((len(blocks), 2), np.int64)
    tree = shapely.STRtree(rings)
    for tile in reference.points():
        places = shapely.points(tile.xyz[:, :2])
        which, ring = tree.query(places, predicate="intersects")
        np.add.at(counts[:, 1], ring, 1)
        np.add.at(counts[:, 0], ring, tile.classification[which] == BUILDING_CLASS)
    return [bool(building <= _CUT_SHARE * total) for building, total in counts.tolist()]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FootprintScore:
    """Outlines against blocks of given footprints; nan without any."""

    blocks: int
    """Blocks of the reference."""
    iou: float
    """Median IoU with all models that share at least half of either area: a block that was split is whole again."""
    iou_one_to_one: float
    """Median IoU with the one model that stands for the block; 0 where there is none."""
    area_bias: float
    """Median of model area / block area - 1, with all models as for `iou`."""
    area_bias_total: float
    """The same of the sums over all blocks that have models."""
    offset_m: float
    """Median shift of the outline that explains the area, positive outwards."""
    models: int
    """Models of which at least half lies on these blocks: the units."""


def footprint_score(
    models: Sequence[RoofModel], reference: Reference, chosen: Sequence[bool]
) -> tuple[FootprintScore, tuple[FootprintRow, ...]]:
    """The figures over the chosen blocks of a reference, and the rows of all.

    Parameters
    ----------
    models : sequence of RoofModel
        Any.
    reference : Reference
        From `touching_united`, or any other.
    chosen : sequence of bool
        Which of its buildings count.
    """
    matching = match_footprints(models, reference)
    rows = score_footprints(models, reference, matching)
    counted = [row for row in rows if chosen[row.building]]
    made = sound_polygons([model.footprint for model in models])
    pairs = matching.overlaps
    bias, offsets, areas = [], [], [0.0, 0.0]
    units = 0
    for row in counted:
        here = pairs.first == row.building
        least = np.minimum(matching.reference_m2[row.building], matching.model_m2[pairs.second])
        over = pairs.second[here & (pairs.common_m2 >= 0.5 * least)]
        units += int((here & (pairs.common_m2 >= 0.5 * matching.model_m2[pairs.second])).sum())
        if len(over):
            block, together = reference.buildings[row.building].footprint, shapely.union_all(made[over])
            bias.append(together.area / block.area - 1.0)
            offsets.append(2.0 * (together.area - block.area) / (together.length + block.length))
            areas[0] += together.area
            areas[1] += block.area
    return (
        FootprintScore(
            blocks=len(counted),
            iou=_median([row.iou_together for row in counted]),
            iou_one_to_one=_median([row.iou for row in counted]),
            area_bias=_median(bias),
            area_bias_total=_ratio(areas[0] - areas[1], areas[1]),
            offset_m=_median(offsets),
            models=units,
        ),
        rows,
    )


def houses_alone(models: Sequence[RoofModel], houses: Reference) -> tuple[int, float]:
    """Single houses that are asked for, and the share of them that have a model of their own."""
    matching = match_footprints(models, houses)
    wanted = [k for k, b in enumerate(houses.buildings) if b.footprint.area >= OBJECT_M2 and not b.touches_data_edge]
    if not wanted:
        return 0, math.nan
    return len(wanted), float(np.mean(matching.model_of[wanted] >= 0))


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else math.nan
