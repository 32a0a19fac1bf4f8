"""Classified points as a reference: class 6 is building, class 2 is ground, with given footprints or without."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import InconsistentInputError, InputError, SettingsError
from pipeline.extras.footprints.footprints_file import read_footprints
from pipeline.extras.footprints.placed_features import off_the_data
from pipeline.io import ReadOptions, open_source, shown
from pipeline.io.crs import SpatialReference, with_one_vertical
from pipeline.io.file_facts import Readable
from pipeline.io.places import file_at
from pipeline.io.source import Source
from pipeline.model import RoofType
from pipeline.quality.residuals import TopSurface, plan_index
from pipeline.ruler.evaluation.building_raster import PointRaster
from pipeline.ruler.evaluation.ground_scores import NOT_JUDGED, UNCLASSIFIED
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS

MIN_BUILDING_POINTS = 11
"""A given footprint with fewer points of class 6 is not a reference building: it was not measured."""
MIN_OUTLINE_M2 = 10.0
"""Smaller outlines of the raster are specks: they need not be found, but their points count."""
_SEAM_M = 1.0
"""A gap between the bounds of adjacent tiles up to this is not an edge of the data."""

Area: TypeAlias = Polygon | MultiPolygon
Counts: TypeAlias = npt.NDArray[np.int64]


def read_points_reference(
    tiles: Sequence[str | Path],
    *,
    footprints: str | Path | None = None,
    layer: str | None = None,
    crs: str | None = None,
    vertical_unit: str | None = None,
    read_options: ReadOptions | None = None,
) -> Reference:
    """Classified point files of one CRS as a reference. Reads all points once, tile by tile.

    Files may abut; points in two files count twice. Footprints with at least 11 points of class 6 are the reference
    buildings; their file may cover only a part of the tiles, so nothing is known elsewhere. Without it, the buildings
    are the connected areas of the raster of class 6 (see `building_raster`). Without class 6 there are no buildings,
    and the reference serves the ground measures only. Raises InputError if a file cannot be read, has neither class 2
    nor 6, or its CRS is not that of the first.
    """
    if not tiles:
        raise SettingsError(["no point files are given as a reference: name at least one"])
    options = read_options or ReadOptions()
    options = dataclasses.replace(options, crs=crs or options.crs, vertical_unit=vertical_unit or options.vertical_unit)
    sources = [open_source(path, options) for path in tiles]
    reference = _one_reference(sources, is_given=options.crs is not None)
    bounds = tuple(_plan_bounds(source) for source in sources)
    extent = _extent(bounds)
    notes = list(dict.fromkeys(warning for source in sources for warning in source.info.warnings))
    areas: dict[str, Area]
    if footprints is not None:
        areas, classes, more = _given_areas(sources, footprints, reference, layer)
    else:
        areas, classes, more = _raster_areas(sources, bounds)
    notes += more
    _check_classes(sources, classes)
    if not classes[BUILDING_CLASS]:
        areas = {}
        notes.append(f"The points have no class {BUILDING_CLASS}: only the ground can be measured")
    if classes[GROUND_CLASS] and _has_object_classes(classes) and classes[list(UNCLASSIFIED)].any():
        notes.append(
            "Points that the file leaves unclassified (0, 1) are judged neither as ground nor as object, for other "
            "classes name the objects"
        )
    index = plan_index(list(areas.values()))
    return Reference(
        name=", ".join(file_at(path).name for path in tiles),
        kind="points",
        buildings=_buildings(areas, extent, is_given=footprints is not None),
        has_faces=False,
        outlines="given" if footprints is not None else "raster",
        tiles=tuple(functools.partial(_read_tile, file_at(path), options, index) for path in tiles),
        bounds=bounds,
        extent=None if footprints is not None or not areas else extent,
        has_ground=bool(classes[GROUND_CLASS]),
        unclassified_is_object=not _has_object_classes(classes),
        crs=None if reference.wkt is None else (f"EPSG:{reference.epsg}" if reference.epsg else reference.name),
        notes=tuple(notes),
    )


def _given_areas(
    sources: Sequence[Source], footprints: str | Path, reference: SpatialReference, layer: str | None
) -> tuple[dict[str, Area], Counts, list[str]]:
    """The given footprints with enough points of class 6 by name, the number of points of each class, and notes."""
    given = read_footprints(footprints, reference, layer=layer)
    area = shapely.union_all([shapely.box(*_plan_bounds(source)) for source in sources])
    if not any(area.intersects(polygon) for polygon in given.polygons):
        raise off_the_data(shown(str(footprints)), "footprints", given.elsewhere, area, reference)
    notes = list(given.warnings)
    index = plan_index(list(given.polygons))
    counts, classes = np.zeros(len(given.polygons) + 1, np.int64), np.zeros(256, np.int64)
    for source in sources:
        for cloud in source.chunks():
            classes += np.bincount(cloud.classification, minlength=256)
            roof = cloud.xyz[cloud.classification == BUILDING_CLASS]
            counts += np.bincount(index.face(roof[:, 0], roof[:, 1]) + 1, minlength=len(counts))
    measured = np.flatnonzero(counts[1:] >= MIN_BUILDING_POINTS).tolist()
    if len(measured) < len(given.polygons):
        notes.append(
            f"{len(given.polygons) - len(measured)} of {len(given.polygons)} given footprints have fewer than "
            f"{MIN_BUILDING_POINTS} points of class {BUILDING_CLASS} and are not reference buildings"
        )
    return {given.ids[k]: given.polygons[k] for k in measured}, classes, notes


def _raster_areas(
    sources: Sequence[Source], bounds: Sequence[Sequence[float]]
) -> tuple[dict[str, Area], Counts, list[str]]:
    """The outlines of the raster of class 6 by name, the number of points of each class, and notes."""
    raster, classes = PointRaster(), np.zeros(256, np.int64)
    for number, source in enumerate(sources):
        for cloud in source.chunks():
            classes += np.bincount(cloud.classification, minlength=256)
            raster.add(cloud.xyz, cloud.classification == BUILDING_CLASS)
        raster.finish(bounds[number + 1 :])
    areas: dict[str, Area] = {f"outline-{number}": area for number, area in enumerate(raster.outlines())}
    small = sum(area.area < MIN_OUTLINE_M2 for area in areas.values())
    note = (
        f"Reference buildings are the {len(areas)} outlines of class {BUILDING_CLASS} on the raster: houses that touch "
        f"are one; {small} of them are smaller than {MIN_OUTLINE_M2:g} m2 and need not be found, as those that the end "
        "of the data cuts"
    )
    return areas, classes, [note] if areas else []


def _buildings(areas: dict[str, Area], extent: Area, *, is_given: bool) -> tuple[RoofModel, ...]:
    """The areas as buildings without roof faces; those at the edge of the extent, and specks, need not be found."""
    whole = extent.buffer(-_SEAM_M, join_style="mitre")
    return tuple(
        RoofModel(
            building_id=name,
            footprint=area,
            roof_type=RoofType.UNKNOWN,
            surfaces=(),
            touches_data_edge=not whole.contains(area) or (not is_given and area.area < MIN_OUTLINE_M2),
            source_id=name if is_given else None,
            lod="",
        )
        for name, area in areas.items()
    )


def _has_object_classes(classes: Counts) -> bool:
    """Whether any class names an object: then classes 0 and 1 are points that were not classified."""
    named = classes.copy()
    named[[GROUND_CLASS, *NOT_JUDGED, *UNCLASSIFIED]] = 0
    return bool(named.any())


def _one_reference(sources: Sequence[Source], *, is_given: bool) -> SpatialReference:
    """The CRS of all files."""
    found = [source.info.reference for source in sources]
    if is_given:
        found = with_one_vertical(found)
    for source, reference in zip(sources, found, strict=True):
        if reference != found[0]:
            raise InconsistentInputError(
                source.info.path,
                f"its CRS is {reference.name}, that of {sources[0].info.path} is {found[0].name}",
                "Give reference points of one CRS, or --crs where the headers are wrong",
            )
    return found[0]


def _plan_bounds(source: Source) -> tuple[float, float, float, float]:
    x0, y0, _, x1, y1, _ = source.info.bounds_m
    return x0, y0, x1, y1


def _extent(bounds: Sequence[Sequence[float]]) -> Area:
    """The area that the tiles cover together, without the seams between them."""
    boxes = [shapely.box(*b).buffer(_SEAM_M / 2, join_style="mitre") for b in bounds]
    extent = shapely.union_all(boxes).buffer(-_SEAM_M / 2, join_style="mitre")
    if not isinstance(extent, Polygon | MultiPolygon):
        raise TypeError(f"an extent became a {extent.geom_type}")
    return extent


def _check_classes(sources: Sequence[Source], classes: Counts) -> None:
    if not classes[BUILDING_CLASS] and not classes[GROUND_CLASS]:
        found = ", ".join(str(code) for code in np.flatnonzero(classes)) or "none"
        raise InputError(
            sources[0].info.path,
            f"no point of class {GROUND_CLASS} (ground) or {BUILDING_CLASS} (building); its classes are {found}",
            "Give a classified file as the reference, or simulated truth",
        )


def _read_tile(path: Readable, options: ReadOptions, index: TopSurface) -> ReferencePoints:
    """The points of a tile; points of class 6 inside a footprint are roof."""
    clouds = list(open_source(path, options).chunks())
    xyz = np.concatenate([np.zeros((0, 3)), *(cloud.xyz for cloud in clouds)])
    classification = np.concatenate([np.zeros(0, np.uint8), *(cloud.classification for cloud in clouds)])
    building = index.face(xyz[:, 0], xyz[:, 1])
    return ReferencePoints(
        name=path.name,
        xyz=xyz,
        classification=classification.astype(np.int32),
        building=building,
        face=np.full(len(xyz), -1, np.int32),
        is_roof=(classification == BUILDING_CLASS) & (building >= 0),
        last=np.concatenate([np.zeros(0, np.bool_), *(cloud.return_number >= cloud.return_count for cloud in clouds)]),
        return_number=np.concatenate([np.zeros(0, np.uint8), *(cloud.return_number for cloud in clouds)]),
    )
