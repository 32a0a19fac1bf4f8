"""The earlier run that a rerun changes: what its directory says of it, and whether its inputs are still the same."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from pipeline import __version__
from pipeline.errors import RunError, SettingsError
from pipeline.export.geoparquet import table_dataset
from pipeline.export.record_rows import KEYS
from pipeline.io.locations import has_mark, is_url, shown
from pipeline.options import ModelFiles, ModelOptions, values_of
from pipeline.runtime.manifest import RunManifest, RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest, input_file
from pipeline.runtime.run_directory import OVERRIDES
from pipeline.runtime.stages.batch_figures import REJECTED
from pipeline.runtime.stages.ingested import Ingested
from pipeline.settings import RunSettings

_AGAIN = "Run the whole again"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """What the tables of a run say about one building or rejected object."""

    points: int
    box: tuple[float, float, float, float] | None
    """xmin, ymin, xmax, ymax in the CRS's units; None where it has no geometry."""
    source_id: str | None
    status: str
    """As in the table of buildings, or `rejected`."""
    input_hash: str | None
    """None for rejected objects."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Earlier:
    """What the run directory says before the rerun."""

    run_dir: Path
    manifest: RunManifest
    fingerprints: Mapping[str, str]
    """Fingerprints of the overrides that took effect, by building_id."""
    redrawn: frozenset[str]
    """Buildings with another footprint from overrides."""

    def records(self, names: Collection[str], source_ids: Collection[str] = ()) -> dict[str, Record]:
        """The records of some buildings and rejected objects, by id; unknown ids are missing."""
        found: dict[str, Record] = {}
        of_buildings = _is_one_of("building_id", names) | _is_one_of("source_id", source_ids)
        chosen = {"buildings": of_buildings, "rejected": _is_one_of("object_id", names)}
        for table, condition in chosen.items():
            (key,) = KEYS[table]
            columns = [key, "n_points", "bbox"]
            if table == "buildings":
                columns += ["source_id", "status", "input_hash"]
            rows = table_dataset(str(self.run_dir), table).to_table(columns=columns, filter=condition).to_pylist()
            for row in rows:
                bbox = row["bbox"]
                found[row[key]] = Record(
                    points=row["n_points"],
                    box=None if bbox is None else (bbox["xmin"], bbox["ymin"], bbox["xmax"], bbox["ymax"]),
                    source_id=row.get("source_id"),
                    status=row.get("status", REJECTED),
                    input_hash=row.get("input_hash"),
                )
        return found

    def faces(self, names: Collection[str]) -> int:
        """Roof faces of some buildings."""
        condition = _is_one_of("building_id", names)
        planes = table_dataset(str(self.run_dir), "planes").to_table(columns=["geometry"], filter=condition)
        geometries = shapely.from_wkb(planes.column("geometry").to_pylist())
        return int(np.sum(shapely.get_num_geometries(geometries)))


def _is_one_of(column: str, values: Collection[str]) -> pc.Expression:
    return pc.field(column).isin(pa.array(sorted(values), pa.string()))


def earlier_run(run_dir: str) -> Earlier:
    """What a run directory says about its run.

    Raises RunError if it has no finished run of this version with its request.
    """
    if is_url(run_dir):
        raise RunError(
            f"{run_dir}: only runs in folders are changed in place, since new files are made beside the old "
            "ones and renamed. Copy the run to a folder of this machine, or run the whole again"
        )
    root = Path(run_dir).resolve()
    manifest = read_manifest(root)
    if manifest.status is not RunStatus.FINISHED:
        raise RunError(f"the run in {root} is {manifest.status}, not finished. {_AGAIN}")
    if manifest.engine_version != __version__:
        made = f"was made by gablework {manifest.engine_version}; this is {__version__}"
        raise RunError(f"the run in {root} {made}: its other buildings could differ. {_AGAIN}")
    if not manifest.request:
        raise RunError(f"run.json in {root} does not tell how the run was asked for. {_AGAIN}")
    entries = json.loads((root / OVERRIDES).read_text(encoding="utf-8")) if (root / OVERRIDES).is_file() else []
    effective = [entry for entry in entries if entry["fingerprint"] is not None]
    return Earlier(
        run_dir=root,
        manifest=manifest,
        fingerprints={entry["building_id"]: entry["fingerprint"] for entry in effective},
        redrawn=frozenset(entry["building_id"] for entry in effective if entry["footprint"] is not None),
    )


def request_of(manifest: RunManifest) -> RunRequest:
    """The request of a run, from its manifest."""
    sections = {str(name): dict(values) for name, values in manifest.settings.items()}
    try:
        settings = RunSettings.from_mapping({**sections.pop("general"), **sections})
    except SettingsError as error:
        raise RunError(f"run.json has the settings of an older gablework ({error.faults[0]}). {_AGAIN}") from error
    if settings.settings_hash != manifest.settings_hash:
        new = [
            f"{name}.{key}"
            for name, values in settings.as_dict().items()
            for key in values
            if key not in manifest.settings.get(name, {})
        ]
        if new:
            raise RunError(f"run.json has the settings of an older gablework, without {new[0]}. {_AGAIN}")
        raise RunError("the settings in run.json are not those of its settings_hash: it was changed by hand")
    asked = manifest.request
    hidden = [entry.path for entry in manifest.inputs if has_mark(entry.path)]
    if hidden:
        raise RunError(f"{hidden[0]}: run.json keeps no queries of URLs, so this cannot be fetched again. {_AGAIN}")
    values = values_of(ModelFiles, asked) | values_of(ModelOptions, asked)
    bbox = None if asked["bbox"] is None else tuple(asked["bbox"])
    # the run itself has decided about places; only what is modelled again is written
    values |= {"bbox": bbox, "allow_outside_area_of_use": True, "overrides": None, "points": False}
    return RunRequest(
        inputs=tuple(entry.path for entry in manifest.inputs if entry.n_points is not None),
        out="",
        settings=settings,
        **values,
    )


def check_points(manifest: RunManifest, paths: Sequence[str], ingested: Sequence[Ingested]) -> None:
    """Refuse points that the run did not have."""
    known = {entry.path: entry.sha256 for entry in manifest.inputs}
    for path, found in zip(paths, ingested, strict=True):
        if known.get(shown(path)) != found.sha256:
            raise RunError(f"{shown(path)} is not the file that the run read: its content changed. {_AGAIN}")


def check_outlines(manifest: RunManifest, request: RunRequest) -> None:
    """Refuse footprints, guides, or an area of interest, that the run did not have."""
    known = {entry.path: entry.sha256 for entry in manifest.inputs if entry.n_points is None}
    for path in (request.footprints, request.guides, request.aoi):
        if path is not None and known.get(shown(path)) != input_file(path).sha256:
            raise RunError(f"{shown(path)} is not the file that the run read. {_AGAIN}")
