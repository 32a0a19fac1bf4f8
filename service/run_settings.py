"""The settings of a run as clients send them: their JSON schema, the valid words of choices, and all faults."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from pipeline.errors import SettingsError
from pipeline.methods import METHODS
from pipeline.parameters import Parameters
from pipeline.settings import SECTIONS, GeneralSettings, RunSettings

LARGEST_INTEGER = 2**53
"""JSON parsers need not read larger integers exactly."""

DEFAULTS = GeneralSettings()
"""Defaults of the general settings."""

VARIANTS = tuple(
    word for method, entry in METHODS.items() for word in (method, *(f"{method}:{preset}" for preset in entry.presets))
)
"""The variants that a comparison can run: every method by itself, and with each of its presets."""


def choices(name: str) -> tuple[str, ...]:
    """The valid words of a general setting."""
    field = next(field for field in dataclasses.fields(GeneralSettings) if field.name == name)
    words: tuple[str, ...] = field.metadata["choices"]
    return words


def settings_schema() -> dict[str, Any]:
    """JSON schema of the settings."""
    kinds = {**SECTIONS, **{name: entry.settings_type for name, entry in METHODS.items()}}
    tables = {name: _table(kind) for name, kind in kinds.items()}
    return _table(GeneralSettings, tables)


def _table(kind: type[Parameters], tables: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Schema of a settings class, with its tables."""
    properties: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        meta, default = field.metadata, field.default
        bounds = {name: meta[name] for name in ("minimum", "maximum") if meta[name] is not None}
        unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
        found: dict[str, Any] = {"description": f"{meta['doc']}{unit}", "default": default}
        if meta["choices"] is not None:
            found |= {"type": "string", "enum": list(meta["choices"])}
        elif isinstance(default, tuple):
            found |= {"type": "array", "items": {"type": "integer", **bounds}, "default": list(default)}
        elif isinstance(default, bool):
            found["type"] = "boolean"
        elif isinstance(default, int | float):
            found |= {"type": "integer" if isinstance(default, int) else "number", **bounds}
        elif bounds:
            found["oneOf"] = [{"type": "string", "enum": [default]}, {"type": "integer", **bounds}]
        else:
            found["type"] = "string"
        properties[field.name] = found
    return {"type": "object", "additionalProperties": False, "properties": {**properties, **(tables or {})}}


def settings_faults(settings: Mapping[str, Any]) -> list[str]:
    """All faults of settings, one sentence each, with the names of their tables."""
    faults: list[str] = []
    kept = {name: _representable(value, f"[{name}] ", faults) for name, value in settings.items() if _is_table(value)}
    kept |= _representable({name: value for name, value in settings.items() if not _is_table(value)}, "", faults)
    try:
        RunSettings.from_mapping(kept)
    except SettingsError as error:
        faults += error.faults
        faults += _preset_faults(kept)
    return list(dict.fromkeys(faults))


def _preset_faults(settings: Mapping[str, Any]) -> list[str]:
    """The fault of a preset that the method does not have."""
    method, preset = settings.get("method", DEFAULTS.method), settings.get("preset", DEFAULTS.preset)
    if method not in choices("method") or preset not in choices("preset"):
        return []
    try:
        METHODS[method].preset(preset)
    except SettingsError as error:
        return list(error.faults)
    return []


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _representable(values: Mapping[str, Any], prefix: str, faults: list[str]) -> dict[str, Any]:
    """The values that settings can hold; JSON also has nulls, lists of anything and integers of any length."""
    kept = {}
    for name, value in values.items():
        whole = isinstance(value, list) and all(type(item) is int and abs(item) <= LARGEST_INTEGER for item in value)
        if value is None or (isinstance(value, list) and not whole):
            faults.append(f"{prefix}{name} is {json.dumps(value)[:80]}: use a value, or leave it out")
        elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            faults.append(f"{prefix}{name} has {len(str(value))} digits: use a smaller number")
        else:
            kept[name] = value
    return kept
