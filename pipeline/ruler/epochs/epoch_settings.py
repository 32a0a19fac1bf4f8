"""The thresholds of a comparison of two epochs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.errors import SettingsError
from pipeline.parameters import Parameters, build, parameter, read_toml

TABLE = "diff"
"""The table of the settings file."""


class DiffSettings(Parameters):
    """The least size of a change."""

    min_overlap_share: float = parameter(
        0.25,
        "Two footprints belong together if they share at least this part of the smaller one.",
        minimum=0.01,
        maximum=1.0,
    )
    min_iou: float = parameter(
        0.2,
        "Buildings that belong together and share less than this of their common area count as gone and new.",
        minimum=0.0,
        maximum=0.9,
    )
    min_height_change_m: float = parameter(
        0.5, "A roof surface counts as higher or lower from this difference on.", unit="m", minimum=0.02, maximum=50.0
    )
    sigmas: float = parameter(
        3.0,
        "The difference must also reach this many standard deviations of both epochs together.",
        minimum=0.0,
        maximum=20.0,
    )
    uniform_share: float = parameter(
        0.9,
        "A building is raised (lowered) if this part of its roof is higher (lower).",
        minimum=0.5,
        maximum=1.0,
    )
    min_area_change_m2: float = parameter(
        5.0,
        "A building is reshaped if this much of its plan was added or removed, or has another roof.",
        unit="m2",
        minimum=0.1,
        maximum=100_000.0,
    )
    min_volume_change_m3: float = parameter(
        5.0, "A reshaped building must also gain or lose this much volume.", unit="m3", minimum=0.0, maximum=1_000_000.0
    )
    min_width_m: float = parameter(
        1.5,
        "Narrower parts do not count: outlines and edges of roofs are not more accurate.",
        unit="m",
        minimum=0.2,
        maximum=50.0,
    )
    spacings: float = parameter(
        1.5, "Parts that are narrower than this many point spacings do not count either.", minimum=0.0, maximum=10.0
    )
    min_covered_share: float = parameter(
        0.95,
        "A building is new or gone only if the other epoch has data in this part of its footprint.",
        minimum=0.01,
        maximum=1.0,
    )
    edge_m: float = parameter(
        2.0,
        "Places nearer to the end of the data of an epoch count as not covered by it.",
        unit="m",
        minimum=0.0,
        maximum=100.0,
    )
    vertical_shift_m: float = parameter(
        0.0,
        "Known difference of the elevations, NEW less OLD, that is not a change of any building.",
        unit="m",
        minimum=-1000.0,
        maximum=1000.0,
    )


def read_settings(path: str | None, options: Mapping[str, Any]) -> DiffSettings:
    """The settings of the `[diff]` table of a TOML file, overridden by options that are not None.

    Raises SettingsError, which lists all faults, if the file cannot be read or parsed, or has faults.
    """
    table: dict[str, Any] = {}
    if path is not None:
        document = read_toml(path, "settings file")
        found = document.get(TABLE)
        if not isinstance(found, dict):
            held = ", ".join(document) or "nothing"
            raise SettingsError([f"settings file {path} has no [{TABLE}] table; it has {held}"])
        table = dict(found)
    table.update({name: value for name, value in options.items() if value is not None})
    faults: list[str] = []
    settings: DiffSettings | None = build(DiffSettings, TABLE, table, faults)
    if faults or settings is None:
        raise SettingsError(faults)
    return settings
