"""Overrides: what the user says of single buildings, read from a TOML file, one `[[building]]` a building.

An entry names its building by `building_id` (also the id of a rejected object), by `source_id`, or by a `point` inside
it, and says what is to be done: `action = "accept"` or `"reject"`, another `footprint`, another `method`, `preset` or
`settings`. All faults of a file are reported at once.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import InputError, SettingsError
from pipeline.extras.footprints.footprints_file import LARGEST_OUTLINE_M, Footprints, read_footprints
from pipeline.extras.vector_files.nearby import OWN_OUTLINES
from pipeline.io.crs import SpatialReference
from pipeline.io.reading import one_input
from pipeline.methods import ReconstructSettings, method_named
from pipeline.parameters import is_finite_number, quoted, read_toml
from pipeline.settings import RunSettings

ACTIONS = ("accept", "reject")
"""An object that was rejected becomes a building; a building becomes a rejected object."""
TABLE = "building"
"""The name of the array of tables."""

_FARTHEST = 1e9
"""No coordinate on Earth is larger, in metres or feet."""
_PLACES = ("building_id", "source_id", "point")
_EFFECTS = ("action", "footprint", "method", "preset", "settings")
_KEYS = (*_PLACES, *_EFFECTS, "note")
_SHARED_TABLES = ("roof", "plan", "roof-type", "guides", "support")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Override:
    """What the user says of one building."""

    entry: int
    """Place in the file, from 1."""
    building_id: str | None = None
    """Id of a building or a rejected object; this, `source_id` or `point_m` is given."""
    source_id: str | None = None
    """A given footprint's own id."""
    point_m: tuple[float, float] | None = None
    """Easting and northing in metres of a place inside."""
    action: str | None = None
    """One of `ACTIONS`; None leaves the judgement as it is."""
    footprint: Polygon | MultiPolygon | None = None
    """The outline to be modelled, in metres; None leaves it as it is."""
    method: str | None = None
    """Name of the method; None leaves it as it is."""
    preset: str | None = None
    """Where the method's settings start; None leaves them as they are."""
    settings: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """Tables of settings: `roof`, `plan`, `roof-type`, `guides`, `support` and the method's own."""
    note: str = ""
    """The user's reason."""

    @property
    def remodels(self) -> bool:
        """Whether the building is modelled in another way than the others."""
        return self.method is not None or self.preset is not None or bool(self.settings)

    @property
    def effects(self) -> str:
        """What it does, as the records say it: such as `accept, footprint, method`."""
        words = [self.action, "footprint" if self.footprint is not None else None, "method" if self.remodels else None]
        return ", ".join(word for word in words if word)

    @property
    def says_building(self) -> bool:
        """Whether it says that there is a building: it is accepted, or has an outline."""
        return self.action == "accept" or self.footprint is not None

    @property
    def fingerprint(self) -> str:
        """sha256 over what it does, without the place in the file and the way in which the building is named."""
        content = {
            "action": self.action,
            "footprint": None if self.footprint is None else self.footprint.wkb_hex,
            "method": self.method,
            "preset": self.preset,
            "settings": self.settings,
            "note": self.note,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def place(self) -> str:
        """The building as the file names it."""
        if self.point_m is not None:
            return f"point {self.point_m[0]:.3f} {self.point_m[1]:.3f} (in metres)"
        name = "building_id" if self.building_id is not None else "source_id"
        return f"{name} {self.building_id or self.source_id!r}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnModelling:
    """The method of one building."""

    method: str
    """Its name."""
    settings: ReconstructSettings
    """All that modelling takes."""
    settings_hash: str
    """Digest of the run's settings with these in their place."""


def own_modelling(override: Override, base: RunSettings) -> OwnModelling:
    """The method and the settings of a building that an override models in its own way.

    What the override does not name is as in the run: the method's own settings too, where neither method nor preset is
    another. Raises SettingsError with all faults at once for names and values that do not exist.
    """
    sections = base.as_dict()
    method = method_named(override.method or base.general.method).name
    general = {**sections.pop("general"), "method": method, "preset": override.preset or base.general.preset}
    keeps = method == base.general.method and override.preset is None
    own = sections.pop(base.general.method)
    allowed = (*_SHARED_TABLES, method)
    faults = [
        f"[{name}] cannot differ by building: use {', '.join(allowed)}"
        for name in override.settings
        if name not in allowed
    ]
    if faults:
        raise SettingsError(faults)
    table: dict[str, Any] = {**general, **sections, method: own if keeps else {}}
    for name, values in override.settings.items():
        table[name] = {**table[name], **values}
    settings = RunSettings.from_mapping(table)
    return OwnModelling(
        method=settings.general.method, settings=settings.building, settings_hash=settings.settings_hash
    )


def read_overrides(path: str | Path, reference: SpatialReference, base: RunSettings) -> tuple[Override, ...]:
    """The entries of an overrides file (TOML), in its order; vector files that it names are sought beside it.

    `point` and WKT are in the coordinates of the run's CRS. Raises SettingsError if the file cannot be read or parsed,
    or holds faults: all of them at once.
    """
    document = read_toml(path, "overrides file")
    return overrides_of(document, reference, base, source=str(path), folder=Path(path).parent)


def overrides_of(
    document: Mapping[str, Any],
    reference: SpatialReference,
    base: RunSettings,
    *,
    source: str = "overrides",
    folder: Path | None = None,
) -> tuple[Override, ...]:
    """The entries of a parsed overrides file; the arguments are those of `read_overrides`."""
    faults = [f"{source}: {name} is no table of overrides: use [[{TABLE}]]" for name in document if name != TABLE]
    entries = document.get(TABLE, [])
    if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
        raise SettingsError([*faults, f"{source}: {TABLE} is no array of tables: write [[{TABLE}]] before each entry"])
    reading = _Reading(reference=reference, folder=folder or Path())
    found: list[Override] = []
    places: dict[str, int] = {}
    for number, entry in enumerate(entries, start=1):
        own = _entry_faults(entry)
        override = None if own else reading.override(number, entry, own)
        if override is not None:
            own.extend(_modelling_faults(override, base))
            first = places.setdefault(override.place, number)
            if first != number:
                own.append(f"names the same building as entry {first}: give one entry a building")
            found.append(override)
        faults.extend(f"{source}, entry {number}: {fault}" for fault in own)
    if faults:
        raise SettingsError(faults)
    return tuple(found)


def _entry_faults(entry: Mapping[str, Any]) -> list[str]:
    """What is wrong with the keys and words of an entry."""
    faults = [f"{key} is no key: use {', '.join(_KEYS)}" for key in entry if key not in _KEYS]
    given = [key for key in _PLACES if key in entry]
    if len(given) != 1:
        faults.append(f"gives {' and '.join(given) or 'no building'}: give one of {', '.join(_PLACES)}")
    if not any(key in entry for key in _EFFECTS):
        faults.append(f"does nothing: give one of {', '.join(_EFFECTS)}")
    action = entry.get("action")
    if "action" in entry and action not in ACTIONS:
        faults.append(f"action is {quoted(action)}: use one of {', '.join(ACTIONS)}")
    besides = [key for key in _EFFECTS if key in entry and key != "action"]
    if action == "reject" and besides:
        faults.append(f"rejects and gives {', '.join(besides)}: what is no building is not modelled")
    faults.extend(
        f"{key} is {quoted(entry[key])}: use text"
        for key in ("building_id", "method", "preset", "note")
        if key in entry and (not isinstance(entry[key], str) or (key != "note" and not entry[key]))
    )
    source_id = entry.get("source_id", "")
    if "source_id" in entry and (isinstance(source_id, bool) or not isinstance(source_id, int | str)):
        faults.append(f"source_id is {quoted(source_id)}: use text or a whole number")
    if "point" in entry and not _is_point(entry["point"]):
        faults.append(f"point is {quoted(entry['point'])}: use [easting, northing] in the CRS's units")
    settings = entry.get("settings", {})
    if not isinstance(settings, Mapping) or not all(isinstance(table, Mapping) for table in settings.values()):
        faults.append(f"settings are no tables: write [{TABLE}.settings.roof], or the method's name for roof")
    return faults


def _is_point(value: Any) -> bool:
    if not (isinstance(value, list) and len(value) == 2 and all(is_finite_number(v) for v in value)):
        return False
    return bool(max(map(abs, value)) <= _FARTHEST)


def _modelling_faults(override: Override, base: RunSettings) -> list[str]:
    if not override.remodels:
        return []
    try:
        own_modelling(override, base)
    except SettingsError as error:
        return list(error.faults)
    return []


class _Reading:
    """Turns entries into overrides; vector files are read once."""

    def __init__(self, reference: SpatialReference, folder: Path) -> None:
        self._reference = reference
        self._folder = folder
        self._files: dict[tuple[Any, ...], Footprints] = {}

    def override(self, number: int, entry: Mapping[str, Any], faults: list[str]) -> Override | None:
        """The override of an entry; None with its faults appended."""
        unit = self._reference.horizontal_unit_m
        footprint = self._footprint(entry["footprint"], faults) if "footprint" in entry else None
        if faults:
            return None
        point = entry.get("point")
        return Override(
            entry=number,
            building_id=entry.get("building_id"),
            source_id=None if "source_id" not in entry else str(entry["source_id"]),
            point_m=None if point is None else (float(point[0]) * unit, float(point[1]) * unit),
            action=entry.get("action"),
            footprint=footprint,
            method=entry.get("method"),
            preset=entry.get("preset"),
            settings=entry.get("settings", {}),
            note=entry.get("note", ""),
        )

    def _footprint(self, value: Any, faults: list[str]) -> Polygon | MultiPolygon | None:
        """An outline in metres, of WKT or out of a vector file."""
        if isinstance(value, str):
            return self._of_wkt(value, faults)
        names = ("file", "id", "layer", "id_column")
        if not isinstance(value, Mapping) or not {"file", "id"} <= set(value) <= set(names):
            faults.append('footprint is neither WKT nor a table such as { file = "outlines.gpkg", id = "12" }')
            return None
        wrong = [
            name for name, one in value.items() if not isinstance(one, str) and (name != "id" or type(one) is not int)
        ]
        if wrong:
            faults.extend(f"footprint has the {name} {quoted(value[name])}: use text" for name in wrong)
            return None
        path = self._folder / value["file"]
        key = (str(path), value.get("layer"), value.get("id_column"))
        try:
            if key not in self._files:
                with one_input(str(path)):
                    self._files[key] = read_footprints(
                        path, self._reference, layer=key[1], id_column=key[2], shape=OWN_OUTLINES
                    )
        except InputError as error:
            faults.append(f"footprint: {error}")
            return None
        found = self._files[key]
        wanted = str(value["id"])
        if wanted not in found.ids:
            lost = [f"{issue.problem}: {issue.detail}" for issue in found.issues if issue.source_id == wanted]
            problem = lost[0] if lost else f"none of its {len(found)} polygons has the id {quoted(wanted)}"
            faults.append(f"footprint: {path}: {problem}")
            return None
        if (several := found.ids.count(wanted)) > 1:
            faults.append(
                f"footprint: {path}: {several} of its polygons have the id {quoted(wanted)}: name an id_column"
            )
            return None
        return found.polygons[found.ids.index(wanted)]

    def _of_wkt(self, text: str, faults: list[str]) -> Polygon | MultiPolygon | None:
        try:
            geometry = shapely.force_2d(shapely.from_wkt(text))
        except shapely.errors.ShapelyError as error:
            faults.append(f"footprint {text[:60]!r} is not WKT ({error})")
            return None
        if not isinstance(geometry, Polygon | MultiPolygon) or geometry.is_empty:
            faults.append(f"footprint {text[:60]!r} is not a polygon: use POLYGON or MULTIPOLYGON")
            return None
        if not geometry.is_valid:
            faults.append(f"footprint {text[:60]!r} is invalid: {shapely.is_valid_reason(geometry)}")
            return None
        unit = self._reference.horizontal_unit_m
        west, south, east, north = geometry.bounds
        side = max(east - west, north - south) * unit
        if side > LARGEST_OUTLINE_M:
            faults.append(f"footprint {text[:60]!r} is {side:.6g} m wide or long: use at most {LARGEST_OUTLINE_M:g} m")
            return None
        if unit == 1.0:
            return geometry
        scaled = shapely.transform(geometry, lambda xy: xy * unit)
        assert isinstance(scaled, Polygon | MultiPolygon)
        return scaled
