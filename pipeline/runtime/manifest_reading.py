"""The manifest of a finished run, read."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import RunError
from pipeline.io import arrow_at
from pipeline.runtime.manifest import FORMAT, NAME, InputFile, PointFileFacts, RunManifest, RunStatus, SlowBuilding

if TYPE_CHECKING:
    import pyarrow.fs as pafs


def read_manifest(run_dir: str | Path, filesystem: pafs.FileSystem | None = None) -> RunManifest:
    """Read `run.json`; raises RunError if there is none, or it cannot be read.

    Parameters
    ----------
    run_dir : str or Path
        The run directory: a path or URL, or a path of `filesystem`.
    filesystem : pyarrow.fs.FileSystem, optional
        Where the run lies; by default as `run_dir` says.
    """
    if filesystem is None:
        filesystem, run_dir = arrow_at(run_dir)
    path = f"{str(run_dir).rstrip('/')}/{NAME}"
    try:
        with filesystem.open_input_stream(path) as stream:
            text = stream.read().decode()
    except FileNotFoundError:
        raise RunError(f"{path} does not exist: give the directory that a run wrote") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    return manifest_of(text, path)


def manifest_of(text: str, source: str = NAME) -> RunManifest:
    """The manifest from JSON text as `RunManifest.to_json` writes it; unknown entries are ignored.

    Messages name `source`. Raises RunError if the text is not a manifest, or has another format.
    """
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        raise RunError(f"{source} is no JSON ({error}): the run directory is damaged") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        form = found.get("format") if isinstance(found, dict) else type(found).__name__
        raise RunError(f"{source} has format {form!r}, this version reads {FORMAT}: use the version that wrote it")
    names = {field.name for field in dataclasses.fields(RunManifest)}
    values = {name: value for name, value in found.items() if name in names}
    try:
        values["status"] = RunStatus(values["status"])
        for name in ("started_at", "finished_at"):
            if values.get(name) is not None:
                values[name] = dt.datetime.fromisoformat(values[name])
        values["inputs"] = tuple(_input_file(entry) for entry in values.get("inputs", ()))
        values["slowest"] = tuple(SlowBuilding(**entry) for entry in values.get("slowest", ()))
        for name in ("tiles", "failed_tiles", "tiles_without_points", "tiles_without_terrain", "warnings"):
            values[name] = tuple(values.get(name, ()))
        return RunManifest(**values)
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{source} is no manifest of a run ({error}): the run directory is damaged") from error


def _input_file(entry: Mapping[str, Any]) -> InputFile:
    """An input as JSON holds it; lists become tuples again."""
    bounds, file = entry.get("bounds_m"), entry.get("file")
    values = {**entry, "bounds_m": None if bounds is None else tuple(bounds)}
    if file is not None:
        times = file["acquired"] and tuple(map(dt.datetime.fromisoformat, file["acquired"]))
        values["file"] = PointFileFacts(**{**file, "bounds_m": tuple(file["bounds_m"]), "acquired": times})
    return InputFile(**values)


def city_unit_m(crs: Mapping[str, Any] | None) -> float:
    """Metres per vertical unit of a run's CityJSON and GLB, by the entry `crs` of its run.json.

    >>> city_unit_m({"vertical_unit_m": 0.3048}), city_unit_m({"vertical_unit_m": 0.3, "cityjson_vertical_unit_m": 1.0})
    (0.3048, 1.0)
    """
    facts = crs or {}
    # older runs have the unit of the tables there, too
    return float(facts.get("cityjson_vertical_unit_m") or facts.get("vertical_unit_m") or 1.0)
