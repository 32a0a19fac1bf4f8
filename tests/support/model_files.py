"""Files of models as this program and others write them, and what they are to be read as."""

import copy
import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import small_buildings as small

from pipeline.export.record_rows import RecordContext
from pipeline.export.tile import write_tile
from pipeline.io.crs import SpatialReference
from pipeline.io.crs_given import parse_crs
from pipeline.model import BuildingResult
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.triangulation.one_face import triangulate_face

Json = dict[str, Any]


def reference(
    epsg: int | None = 7415, horizontal_unit_m: float = 1.0, vertical_unit_m: float = 1.0
) -> SpatialReference:
    """A coordinate reference system as a run has it."""
    units = {"horizontal_unit_m": horizontal_unit_m, "vertical_unit_m": vertical_unit_m}
    if epsg is None:
        return SpatialReference(**units)
    crs = parse_crs(f"EPSG:{epsg}", path="test")
    return SpatialReference(wkt=crs.to_wkt(), name=crs.name, epsg=epsg, **units)


def write_run(folder: Path, results: Sequence[BuildingResult], at: SpatialReference | None = None) -> Path:
    """The tables, meshes and CityJSONSeq of a run of two tiles, without run.json."""
    context = RecordContext(reference=at or reference(), settings_hash="ab", engine_version="0")
    write_tile(folder, "t1", results[::2], [], context)
    write_tile(folder, "t2", results[1::2], [], context)
    return folder


def village() -> list[BuildingResult]:
    """A gable, a pent, a block around a court, two gables that share their planes' slopes, one that failed."""
    return [
        small.gable(touches_data_edge=True),
        small.pent(),
        small.courtyard(),
        small.two_parts(),
        small.failed(),
    ]


def sequence_of(run: Path) -> list[Json]:
    """All lines of a run's first CityJSONSeq file."""
    file = run / "cityjson" / "tile=t1" / "part-0.city.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()]


def write_sequence(path: Path, lines: Iterable[Json]) -> Path:
    """A CityJSONSeq file of these lines."""
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def made_by_cjio(sequence: Path, path: Path) -> Path:
    """One CityJSON file of a CityJSONSeq, by cjio in a process of its own."""
    command = [sys.executable, "-c", "from cjio.cjio import cli; cli()", "stdin", "save", str(path)]
    done = subprocess.run(command, input=sequence.read_text(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return path


def without_planes(lines: Sequence[Json]) -> list[Json]:
    """The lines without plane_id, as others write them."""
    bare = copy.deepcopy(list(lines))
    for solid in _solids(bare):
        for surface in solid["semantics"]["surfaces"]:
            surface.pop("plane_id", None)
    return bare


def without_semantics(lines: Sequence[Json]) -> list[Json]:
    bare = copy.deepcopy(list(lines))
    for solid in _solids(bare):
        del solid["semantics"]
    return bare


def triangulated(lines: Sequence[Json]) -> list[Json]:
    """The lines with every face cut into triangles of its own vertices, semantics handed on."""
    cut = copy.deepcopy(list(lines))
    scale = np.array(cut[0]["transform"]["scale"])
    for line in cut[1:]:
        vertices = np.array(line["vertices"]).reshape(-1, 3) * scale
        for solid in _solids([line]):
            shells, values = [], []
            semantics = solid.get("semantics")
            for shell_number, shell in enumerate(solid["boundaries"]):
                faces, of_faces = [], []
                for number, rings in enumerate(shell):
                    triangles = triangulate_face(vertices, rings).tolist()
                    faces.extend([triangle] for triangle in triangles)
                    if semantics:
                        of_faces.extend([semantics["values"][shell_number][number]] * len(triangles))
                shells.append(faces)
                values.append(of_faces)
            solid["boundaries"] = shells
            if semantics:
                semantics["values"] = values
    return cut


def _solids(lines: Iterable[Json]) -> Iterable[Json]:
    return (
        geometry
        for line in lines
        for entry in line["CityObjects"].values()
        for geometry in entry.get("geometry", ())
        if geometry["type"] == "Solid"
    )


def by_id(models: ModelSet) -> dict[str, RoofModel]:
    return {model.building_id: model for model in models.models}


def assert_same_roof(model: RoofModel, other: RoofModel, tolerance_m: float = 0.002) -> None:
    """Footprint, roof faces and planes agree: no vertex is farther than the tolerance."""
    assert shapely.hausdorff_distance(model.footprint, other.footprint) <= tolerance_m
    assert abs(model.footprint.area - other.footprint.area) <= tolerance_m * model.footprint.length
    assert len(model.surfaces) == len(other.surfaces)
    free = list(other.surfaces)
    for surface in model.surfaces:
        x, y = shapely.get_coordinates(surface.polygon).T
        same = min(free, key=lambda one: shapely.hausdorff_distance(one.polygon, surface.polygon))
        free.remove(same)
        assert shapely.hausdorff_distance(same.polygon, surface.polygon) <= tolerance_m
        assert abs(same.polygon.area - surface.polygon.area) <= tolerance_m * surface.polygon.length
        assert np.abs(same.elevation(x, y) - surface.elevation(x, y)).max() <= tolerance_m


def assert_same_models(models: ModelSet, others: ModelSet, tolerance_m: float = 0.002) -> None:
    """The same buildings with the same roofs and solids."""
    ours, theirs = by_id(models), by_id(others)
    assert set(ours) == set(theirs)
    for name, model in ours.items():
        assert_same_roof(model, theirs[name], tolerance_m)
        assert len(model.solids) == len(theirs[name].solids)
        for solid, other in zip(model.solids, theirs[name].solids, strict=True):
            spread = [np.ptp(each.vertices, axis=0) for each in (solid, other)]
            assert np.allclose(*spread, rtol=0.0, atol=tolerance_m)
