"""The models and notes that a reader collects, and the resulting set of models."""

from __future__ import annotations

import dataclasses
from typing import Literal

import shapely
from shapely import Polygon

from pipeline.model import RoofType, Status
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reading.model_surfaces import Assembled

Kind = Literal["run", "cityjson", "cityjsonseq", "obj"]


@dataclasses.dataclass(kw_only=True)
class Collected:
    """Models, failed ones, and notes for the report, in the order of the files."""

    models: list[RoofModel] = dataclasses.field(default_factory=list)
    """Those with a footprint and roof faces."""
    failed: list[RoofModel] = dataclasses.field(default_factory=list)
    notes: dict[str, None] = dataclasses.field(default_factory=dict)
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    """Numbers by sentences with `{n}` in place of the number."""
    crs: str | None = None
    """Coordinate reference system of the first file that has one."""
    has_footprints: bool = False

    def note(self, sentence: str) -> None:
        """Keep a sentence."""
        self.notes[sentence] = None

    def count(self, sentence: str) -> None:
        """Keep a sentence with `{n}`, one more of it."""
        self.counts[sentence] = self.counts.get(sentence, 0) + 1

    def is_at(self, crs: str | None) -> None:
        """Keep the coordinate reference system of a file."""
        if crs is not None and self.crs not in (None, crs):
            self.note(f"files differ in their coordinate reference system: {self.crs} and {crs}")
        self.crs = self.crs or crs

    def add(self, model: RoofModel) -> None:
        """Keep a building where it belongs."""
        if model.surfaces and not model.footprint.is_empty:
            self.models.append(model)
        else:
            self.failed.append(model)

    def finish(self, *, name: str, kind: Kind, path: str) -> ModelSet:
        """The set: sorted by building_id, unique ids, notes in their order."""
        models, failed = _unique(self.models), _unique(self.failed)
        renamed = sum(a.building_id != b.building_id for a, b in zip(_sorted(self.models), models, strict=True))
        if renamed:
            self.note(f"{renamed} models had the id of another one and were given a number behind it")
        return ModelSet(
            name=name,
            kind=kind,
            path=path,
            models=models,
            failed=failed,
            crs=self.crs,
            has_footprints=self.has_footprints,
            notes=(*self.notes, *(sentence.format(n=count) for sentence, count in self.counts.items())),
        )


def _sorted(models: list[RoofModel]) -> list[RoofModel]:
    return sorted(models, key=lambda model: model.building_id)


def _unique(models: list[RoofModel]) -> tuple[RoofModel, ...]:
    """Sorted models; the second of an id becomes `id#2`."""
    seen: dict[str, int] = {}
    named = []
    for model in _sorted(models):
        count = seen[model.building_id] = seen.get(model.building_id, 0) + 1
        named.append(model if count == 1 else dataclasses.replace(model, building_id=f"{model.building_id}#{count}"))
    return tuple(named)


def model_of(
    building_id: str,
    assembled: Assembled | None,
    *,
    roof_type: RoofType = RoofType.UNKNOWN,
    status: Status = Status.OK,
    lod: str = "2.2",
    source_id: str | None = None,
    touches_data_edge: bool = False,
) -> RoofModel:
    """A building of assembled parts: failed and without type if they have no roof."""
    has_roof = assembled is not None and bool(assembled.surfaces) and not assembled.footprint.is_empty
    return RoofModel(
        building_id=building_id,
        footprint=shapely.force_2d(assembled.footprint) if assembled is not None else Polygon(),
        roof_type=roof_type if has_roof else RoofType.NONE,
        surfaces=assembled.surfaces if assembled is not None else (),
        touches_data_edge=touches_data_edge,
        source_id=source_id,
        status=status if has_roof else Status.FAILED,
        lod=lod if has_roof else "",
        solids=assembled.solids if assembled is not None else (),
        solid_origin=assembled.solid_origin if assembled is not None else (0.0, 0.0, 0.0),
    )
