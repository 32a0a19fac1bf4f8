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
from pipeline.options import AUTO, ModelFiles, ModelOptions, Option, all_options, values_of
from pipeline.parameters import Parameters, build, is_finite_number, parameter, quoted, read_toml
from pipeline.schedule import Cron, Missed, Overlap, Rules
from pipeline.settings import RunSettings

if TYPE_CHECKING:
    from pipeline.runtime.request import RunRequest


def _table(name: str, doc: str, **own: Any) -> type[Parameters]:
    """The settings class of a table: its own keys, and the options of a run that are there."""
    keys = own | {one.name: _key(one) for one in all_options() if one.meta["table"] == name and one.name != "bbox"}
    return type(
        name, (Parameters,), {"__doc__": f"`[{name}]`: {doc}", "__annotations__": dict.fromkeys(keys, Any), **keys}
    )


def _key(option: Option) -> Any:
    """An option as a key, where a text without a value is empty."""
    default = option.default
    if default is None:
        default = {str: "", int: AUTO, bool: True}[option.type]
    limits = {name: option.meta[name] for name in ("unit", "minimum", "maximum", "choices")}
    return parameter(default, option.meta["doc"], **limits)


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
    "inputs": _table("inputs", "data to read."),
    "output": _table(
        "output",
        "files to write.",
        path=parameter("", "The run directory."),
        overwrite=parameter(False, "Replace an existing run that does not belong to this batch."),
        report=parameter(True, "Write run.html, the page about the run, when it is over."),
    ),
    "work": _table(
        "work",
        "intermediate results.",
        path=parameter(
            "",
            "The work folder, on a file system that all workers share; empty takes the batch file's name with the "
            "ending .work.",
        ),
    ),
    "cluster": _table(
        "cluster",
        "processes that do the work.",
        metrics_port=parameter(
            0,
            "Port of 127.0.0.1 for the run's figures in the format of Prometheus; 0 for none.",
            minimum=0,
            maximum=65535,
        ),
    ),
    "schedule": ScheduleTable,
}
"""Tables of a batch file beside `[settings]`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Batch:
    """A batch file, read."""

    path: Path
    """The file."""
    inputs: Any
    """Table `[inputs]`, without paths and bbox."""
    paths: tuple[str, ...]
    """Files, folders or patterns, absolute."""
    bbox: tuple[float, float, float, float] | None
    """x_min, y_min, x_max, y_max in the CRS's units."""
    output: Any
    """Table `[output]`."""
    work: Any
    """Table `[work]`."""
    cluster: Any
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

    def given(self) -> dict[str, Any]:
        """The options in the file by their names; None for those that are not given."""
        found: dict[str, Any] = {"bbox": self.bbox}
        for one in all_options():
            if one.meta["table"] and one.name not in found:
                value = getattr(getattr(self, one.meta["table"]), one.name)
                empty = AUTO if one.type is int else ""
                if one.default is None and (value == empty or value is True):
                    value = None
                found[one.name] = self.whole(value) if one.is_path and value is not None else value
        return found

    def request(self) -> RunRequest:
        """The request of a run."""
        # imported late: a status does not need it
        from pipeline.runtime.request import RunRequest
        from pipeline.runtime.resources import resources_of

        given = self.given()
        return RunRequest(
            inputs=self.paths,
            out=self.out,
            settings=self.settings,
            resources=resources_of(given, traffic="batch", work=self.work_folder),
            overwrite=self.output.overwrite,
            **values_of(ModelFiles, given),
            **values_of(ModelOptions, given),
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
