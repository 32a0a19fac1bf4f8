"""A finished run in the formats of `gablework publish`, as outputs of its job.

What is a folder is laid out as the service serves it: `results/<format>/<file>` below the job, and `run/<file>` for the
files of the run. So relative paths in the files, such as those of a catalogue to the run, hold in both places.
"""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from service.outputs.files import write_json, write_moved_tileset, zip_files
from service.outputs.kinds import FORMATS, OUTPUTS

if TYPE_CHECKING:
    from pipeline.runtime.monitoring.progress import Listener

_TILE = r"x-?\d{1,9}_y-?\d{1,9}"
_SQUARE = rf"{_TILE}_\d{{1,9}}"
FILES: Mapping[str, re.Pattern[str]] = MappingProxyType(
    {
        "3dtiles": re.compile(
            rf"(tileset|terrain)\.json|(models|blocks|terrain)/{_TILE}\.glb|skylines/{_SQUARE}\.glb", re.ASCII
        ),
        "stac": re.compile(
            rf"(points/)?collection\.json|(?P<tile>{_TILE})/(?P=tile)\.json|points/[\w-]+\.json", re.ASCII
        ),
    }
)
"""The paths of the files below an output that is a folder."""
ROOTS: Mapping[str, str] = MappingProxyType({"3dtiles": "tileset.json", "stac": "collection.json"})
"""The file to open first, by output."""
RUN_FILE = re.compile(
    rf"(buildings|planes|rejected|decisions)/tile={_TILE}/part-0\.parquet|(cityjson|terrain)/tile={_TILE}/part-0\.city\.jsonl|"
    rf"meshes/(?P<tile>{_TILE})/(?P=tile)(-lod1[23])?\.(obj|glb)",
    re.ASCII,
)
"""Matches the files of a run that a catalogue lists."""


def _nothing(done: int, total: int) -> None:
    del done, total


def publish(
    run_dir: Path,
    out_dir: Path,
    formats: Sequence[str],
    *,
    name: str,
    geoid_height_m: float | None = None,
    on_progress: Callable[[int, int], None] = _nothing,
) -> dict[str, Exception]:
    """Write a finished run in some formats, beside its outputs; returns why those that are missing could not be made.

    A format that fails leaves nothing behind. The caller must report its error, which may be unexpected.

    Parameters
    ----------
    run_dir : Path
        A run directory whose run ended.
    out_dir : Path
        The folder of outputs; made if it is missing.
    formats : sequence of str
        Words of `FORMATS`.
    name : str
        Name of the run in a catalogue.
    geoid_height_m : float, optional
        Height of the geoid above the ellipsoid, for 3D Tiles.
    on_progress : callable
        Gets the number of finished formats and of all, after each tile, too. RunCancelledError from it
        ends the work.

    Raises
    ------
    OSError
        The folder cannot be made.
    MemoryError
        A format does not fit into memory.
    """
    from pipeline.errors import RunCancelledError

    problems: dict[str, Exception] = {}
    out_dir.mkdir(parents=True, exist_ok=True)
    for done, form in enumerate(formats):

        def heard(_event: Any, done: int = done) -> None:
            on_progress(done, len(formats))

        on_progress(done, len(formats))
        try:
            _WRITERS[form](run_dir, out_dir, {"name": name, "geoid_height_m": geoid_height_m}, heard)
        except (RunCancelledError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - the caller reports it
            problems[form] = error
            shutil.rmtree(out_dir / form, ignore_errors=True)
            for output_id in FORMATS[form]:
                (out_dir / OUTPUTS[output_id].filename).unlink(missing_ok=True)
    on_progress(len(formats), len(formats))
    return problems


_Options = Mapping[str, Any]


def _tiles(run_dir: Path, out_dir: Path, options: _Options, on_event: Listener) -> None:
    from pipeline.extras.publish_3dtiles.publishing_3dtiles import publish_3dtiles

    place = out_dir / "3dtiles"
    publish_3dtiles(str(run_dir), str(place), geoid_height_m=options["geoid_height_m"], on_event=on_event)
    _zip(place, out_dir / OUTPUTS["3dtiles-zip"].filename)
    write_moved_tileset(place / ROOTS["3dtiles"], out_dir / OUTPUTS["3dtiles"].filename, "3dtiles")


def _geopackage(run_dir: Path, out_dir: Path, _: _Options, on_event: Listener) -> None:
    from pipeline.extras.publish.publishing import publish_geopackage

    publish_geopackage(str(run_dir), str(out_dir / OUTPUTS["geopackage"].filename), on_event=on_event)


def _pmtiles(run_dir: Path, out_dir: Path, _: _Options, on_event: Listener) -> None:
    from pipeline.extras.publish.publishing import publish_pmtiles

    publish_pmtiles(str(run_dir), str(out_dir / OUTPUTS["pmtiles"].filename), on_event=on_event)


def _cityjson(run_dir: Path, out_dir: Path, _: _Options, on_event: Listener) -> None:
    from pipeline.extras.publish.publishing import publish_cityjson

    place = out_dir / "cityjson"
    publish_cityjson(str(run_dir), str(place), on_event=on_event)
    _zip(place, out_dir / OUTPUTS["cityjson-zip"].filename)
    shutil.rmtree(place)


def _stac(run_dir: Path, out_dir: Path, options: _Options, on_event: Listener) -> None:
    from pipeline.extras.publish.publishing import publish_stac

    place = out_dir / "stac"
    # what is about the run as a whole names folders of the server
    publish_stac(str(run_dir), str(place), name=options["name"], documents=(), on_event=on_event)
    collection = json.loads((place / ROOTS["stac"]).read_bytes())
    for link in collection["links"]:
        if link["href"].startswith("./"):
            link["href"] = f"stac/{link['href'].removeprefix('./')}"
    write_json(out_dir / OUTPUTS["stac"].filename, collection)


def _solar(run_dir: Path, out_dir: Path, _: _Options, on_event: Listener) -> None:
    from pipeline.errors import RunError
    from pipeline.extras.solar.solar_of_run import solar
    from pipeline.runtime.manifest_reading import read_manifest

    if not (read_manifest(str(run_dir)).crs or {}).get("wkt"):
        raise RunError("the CRS of the tiles is unknown, so the sun's place is, too: submit again with --crs EPSG:n")
    solar(str(run_dir), str(out_dir / OUTPUTS["solar"].filename), on_event=on_event)


def _party_walls(run_dir: Path, out_dir: Path, _: _Options, on_event: Listener) -> None:
    from pipeline.extras.party_walls.party_walls_of_run import party_walls

    walls, areas = (str(out_dir / OUTPUTS[name].filename) for name in FORMATS["party-walls"])
    party_walls(str(run_dir), walls, buildings=areas, on_event=on_event)


_WRITERS: Mapping[str, Callable[[Path, Path, _Options, Listener], None]] = MappingProxyType(
    {
        "3dtiles": _tiles,
        "geopackage": _geopackage,
        "pmtiles": _pmtiles,
        "cityjson": _cityjson,
        "stac": _stac,
        "solar": _solar,
        "party-walls": _party_walls,
    }
)


def _zip(folder: Path, target: Path) -> None:
    """All files of a folder in a zip file, by name."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    with zipfile.ZipFile(target, "w") as archive:
        zip_files(archive, folder, names)


def formats_of(outputs: Sequence[str]) -> tuple[str, ...]:
    """The formats that some outputs need, in the order of `FORMATS`.

    >>> formats_of(["report", "3dtiles-zip", "3dtiles"])
    ('3dtiles',)
    """
    return tuple(form for form, ids in FORMATS.items() if not set(ids).isdisjoint(outputs))
