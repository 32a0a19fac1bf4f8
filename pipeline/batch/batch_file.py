"""The batch file: one TOML document that describes a batch run completely.

```toml
[inputs]
paths = ["tiles/*.laz"]
crs = "EPSG:28992"
footprints = "footprints.gpkg"
[settings]
method = "arrangement"
[output]
path = "models"
```

Paths are relative to the file's folder. All faults are reported at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import SettingsError
from pipeline.export.folders import MESHES
from pipeline.io.reading import INPUT_TIMEOUT_S
from pipeline.parameters import Parameters, build, is_finite_number, parameter, quoted, read_toml
from pipeline.runtime.cluster.tls import given_tls
from pipeline.runtime.isolation.limits import IsolationLimits
from pipeline.schedule import Cron, Missed, Overlap, Rules
from pipeline.settings import RunSettings

if TYPE_CHECKING:
    from pipeline.runtime.request import RunRequest


class InputsTable(Parameters):
    """`[inputs]`: data to read."""

    crs: str = parameter("", "CRS of the inputs, if their header has none or a wrong one.")
    vertical_unit: str = parameter("", "Unit of elevations: m, ft or us-ft; empty takes it from the header.")
    allow_outside_area_of_use: bool = parameter(
        False, "Accept inputs that lie far outside the area of use of their CRS."
    )
    footprints: str = parameter("", "Building outlines to model; empty finds the buildings in the points.")
    footprints_layer: str = parameter("", "Layer of the outlines, where their file has several.")
    guides: str = parameter("", "Lines of roofs that models follow.")
    overrides: str = parameter("", "File with manual overrides for single buildings.")
    aoi: str = parameter("", "Vector file with polygons; only points inside them are used.")
    licence: str = parameter("", "Licence of the source data, written into the results.")


class OutputTable(Parameters):
    """`[output]`: files to write."""

    path: str = parameter("", "The run directory.")
    meshes: str = parameter(
        "building", "One OBJ per building, one OBJ per tile, one GLB per tile, or none.", choices=MESHES
    )
    points: bool = parameter(False, "Also write the points as 3D Tiles, with their distances to the models.")
    overwrite: bool = parameter(False, "Replace an existing run that does not belong to this batch.")
    report: bool = parameter(True, "Write run.html, the page about the run, when it is over.")


class WorkTable(Parameters):
    """`[work]`: intermediate results."""

    path: str = parameter(
        "",
        "The work folder, on a file system that all workers share; empty takes the batch file's name with the ending "
        ".work.",
    )


class ClusterTable(Parameters):
    """`[cluster]`: processes that do the work."""

    workers: int | str = parameter(
        "auto",
        "Processes of the embedded cluster; 0 runs serially in the driver, auto starts a cluster for large runs only.",
        minimum=0,
        maximum=1024,
    )
    scheduler: str = parameter(
        "", "A Dask scheduler to use in place of the embedded cluster; not together with workers."
    )
    tls_ca: str = parameter("", "Certificate of the CA of all the cluster's processes, PEM; with tls_cert.")
    tls_cert: str = parameter("", "The driver's certificate, PEM.")
    tls_key: str = parameter("", "The driver's private key, PEM; empty if the certificate file has it, too.")
    performance_report: str = parameter("", "HTML page about the time of the workers; empty writes none.")
    metrics_port: int = parameter(
        0, "Port of 127.0.0.1 for the run's figures in the format of Prometheus; 0 for none.", minimum=0, maximum=65535
    )
    isolate: bool = parameter(True, "Model buildings in supervised child processes: a bad building costs only itself.")
    input_timeout_s: float = parameter(
        INPUT_TIMEOUT_S,
        "Most seconds within which some more of an input must be read.",
        unit="s",
        minimum=1.0,
        maximum=86_400.0,
    )
    building_timeout_s: float = parameter(
        IsolationLimits.timeout_s,
        "Most seconds per building in its child process.",
        unit="s",
        minimum=1.0,
        maximum=86_400.0,
    )
    building_memory_gib: float = parameter(
        IsolationLimits.memory_bytes / 2**30,
        "Most memory of the child process of a building.",
        unit="GiB",
        minimum=0.5,
        maximum=4096.0,
    )


class ScheduleTable(Parameters):
    """`[schedule]`: when `gablework batch schedule` runs it."""

    cron: str = parameter("", "Minute, hour, day, month, day of the week, such as 30 2 * * *; empty for no schedule.")
    time_zone: str = parameter("UTC", "Time zone of these times, such as Europe/Amsterdam.")
    missed: str = parameter(
        Missed.RUN_LATEST.value,
        "Times that passed while the schedule was not running: run the latest once, or none.",
        choices=tuple(one.value for one in Missed),
    )
    overlap: str = parameter(
        Overlap.SKIP.value,
        "A time that comes while a run is under way is skipped, or waits until that run is over.",
        choices=tuple(one.value for one in Overlap),
    )
    grace_s: float = parameter(
        300.0,
        "How late a time may be seen and still count as seen in time.",
        unit="s",
        minimum=1.0,
        maximum=86_400.0,
    )
    paused: bool = parameter(False, "Ignore the clock.")

    @property
    def rules(self) -> Rules:
        """As the scheduler reads it; only if it has times."""
        return Rules(
            cron=Cron(self.cron, self.time_zone),
            missed=Missed(self.missed),
            grace_s=self.grace_s,
            overlap=Overlap(self.overlap),
            is_paused=self.paused,
        )


TABLES: Mapping[str, type[Parameters]] = {
    "inputs": InputsTable,
    "output": OutputTable,
    "work": WorkTable,
    "cluster": ClusterTable,
    "schedule": ScheduleTable,
}
"""Tables of a batch file beside `[settings]`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Batch:
    """A batch file, read."""

    path: Path
    """The file."""
    inputs: InputsTable
    """Table `[inputs]`, without paths and bbox."""
    paths: tuple[str, ...]
    """Files, folders or patterns, absolute."""
    bbox: tuple[float, float, float, float] | None
    """x_min, y_min, x_max, y_max in the CRS's units."""
    output: OutputTable
    """Table `[output]`."""
    work: WorkTable
    """Table `[work]`."""
    cluster: ClusterTable
    """Table `[cluster]`."""
    schedule: ScheduleTable
    """Table `[schedule]`."""
    settings: RunSettings
    """All settings."""

    def whole(self, name: str) -> str:
        """A path of the file made absolute; URLs stay."""
        return name if "://" in name else str((self.path.parent / name).resolve())

    @property
    def work_folder(self) -> str:
        """The work folder."""
        return self.whole(self.work.path) if self.work.path else str(self.path.with_suffix(".work"))

    @property
    def out(self) -> str:
        """The run directory."""
        return self.whole(self.output.path)

    @property
    def workers(self) -> int | None:
        """Processes of the embedded cluster; None leaves it to the estimate."""
        return self.cluster.workers if isinstance(self.cluster.workers, int) else None

    def request(self) -> RunRequest:
        """The request of a run."""
        # imported late: a status does not need it
        from pipeline.runtime.request import RunRequest
        from pipeline.runtime.resources import Resources

        def given(name: str) -> str | None:
            return self.whole(name) if name else None

        return RunRequest(
            inputs=self.paths,
            out=self.out,
            settings=self.settings,
            footprints=given(self.inputs.footprints),
            footprints_layer=self.inputs.footprints_layer or None,
            guides=given(self.inputs.guides),
            overrides=given(self.inputs.overrides),
            crs=self.inputs.crs or None,
            vertical_unit=self.inputs.vertical_unit or None,
            allow_outside_area_of_use=self.inputs.allow_outside_area_of_use,
            bbox=self.bbox,
            aoi=given(self.inputs.aoi),
            resources=Resources(
                workers=self.workers,
                scheduler=self.cluster.scheduler or None,
                traffic="batch",
                tls=given_tls(given(self.cluster.tls_ca), given(self.cluster.tls_cert), given(self.cluster.tls_key)),
                performance_report=given(self.cluster.performance_report),
                work=self.work_folder,
                isolate=None if self.cluster.isolate else False,
                input_timeout_s=self.cluster.input_timeout_s,
                building_timeout_s=self.cluster.building_timeout_s,
                building_memory_bytes=round(self.cluster.building_memory_gib * 2**30),
            ),
            meshes=self.output.meshes,
            points=self.output.points,
            licence=self.inputs.licence or None,
            overwrite=self.output.overwrite,
        )


def read_batch(path: str | Path) -> Batch:
    """Read a batch file; raises SettingsError if it cannot be read or parsed, or for all its faults."""
    file = Path(path).resolve()
    document = read_toml(path, "batch file")
    faults: list[str] = []
    known = (*TABLES, "settings")
    faults.extend(
        f"[{name}] is not a table of a batch file: use one of {', '.join(known)}"
        for name in document
        if name not in known
    )
    tables = {name: document.get(name, {}) for name in known}
    faults.extend(
        f"{name} is {quoted(table)}: use a table" for name, table in tables.items() if not isinstance(table, Mapping)
    )
    tables = {name: table if isinstance(table, Mapping) else {} for name, table in tables.items()}
    inputs = dict(tables["inputs"])
    if type(inputs.get("crs")) is int:  # an EPSG code without quotes
        inputs["crs"] = str(inputs["crs"])
    paths, bbox = _paths(inputs.pop("paths", None), faults), _bbox(inputs.pop("bbox", None), faults)
    built = {
        name: build(kind, name, inputs if name == "inputs" else tables[name], faults) for name, kind in TABLES.items()
    }
    output = built["output"]
    if output is not None and not output.path:
        faults.append('[output] path is missing: give the run directory, such as path = "models"')
    work = built["work"]
    if work is not None and "://" in work.path:
        faults.append(f"[work] path is {work.path!r}: use a folder of a file system that all workers share, not a URL")
    if tables["cluster"].get("scheduler") and "workers" in tables["cluster"]:
        faults.append(
            "[cluster] has both scheduler and workers: leave out workers, since the scheduler has its own, or "
            "scheduler for an embedded cluster"
        )
    faults.extend(f"{where} holds a NUL character: use a path of this system" for where in _with_nul(document))
    faults.extend(_times_faults(built["schedule"]))
    settings = RunSettings()
    try:
        settings = RunSettings.from_mapping(tables["settings"])
    except SettingsError as error:
        faults.extend(f"[settings] {fault}" for fault in error.faults)
    if faults:
        raise SettingsError(faults)
    batch = Batch(path=file, paths=(), bbox=bbox, settings=settings, **built)
    return dataclasses.replace(batch, paths=tuple(batch.whole(name) for name in paths))


def _with_nul(value: Any, where: str = "batch file") -> list[str]:
    """The places of a document with a character that no path can have."""
    if isinstance(value, Mapping):
        return [fault for name, entry in value.items() for fault in _with_nul(entry, name)]
    if isinstance(value, list):
        return [fault for entry in value for fault in _with_nul(entry, where)]
    return [where] if isinstance(value, str) and "\0" in value else []


def _times_faults(table: ScheduleTable | None) -> list[str]:
    if table is None or not table.cron:
        return []
    try:
        Cron(table.cron, table.time_zone)
    except SettingsError as error:
        return [f"[schedule] {fault}" for fault in error.faults]
    return []


def _paths(value: Any, faults: list[str]) -> tuple[str, ...]:
    if isinstance(value, list) and value and all(isinstance(entry, str) and entry for entry in value):
        return tuple(value)
    shown = "missing" if value is None else quoted(value)
    faults.append(f'[inputs] paths is {shown}: give a list of files, folders or patterns, such as ["tiles/*.laz"]')
    return ()


def _bbox(value: Any, faults: list[str]) -> tuple[float, float, float, float] | None:
    if value is None:
        return None
    numbers = isinstance(value, list) and all(is_finite_number(v) for v in value)
    if numbers and len(value) == 4:
        x_min, y_min, x_max, y_max = (float(v) for v in value)
        return x_min, y_min, x_max, y_max
    faults.append(f"[inputs] bbox is {quoted(value)}: use [x_min, y_min, x_max, y_max]")
    return None
