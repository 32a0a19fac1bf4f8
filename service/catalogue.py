"""The settings of a run, as the API process knows them: read from `catalogue.json`, which is written from the code.

Importing the settings classes themselves would bring the science of every stage, module after module, into a process
that only answers requests. So their fields are kept as data beside this module; `make docs` writes the file
and a test holds it against the classes. Values are checked by the same code as in a run; what concerns several
settings at once is checked by the driver, but for the tables of `WHOLE`, whose classes are light enough.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.parameters import Parameters, build, parameter
from pipeline.terrain.class_codes import ClassCodeSettings

PATH = Path(__file__).with_name("catalogue.json")
"""The written fields."""

WHOLE: Mapping[str, type[Parameters]] = {"class-codes": ClassCodeSettings}
"""Tables whose own classes are used, with all that they check: they bring nothing else along."""

LARGEST_INTEGER = 2**53
"""Beyond it JSON's numbers are not exact everywhere."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Catalogue:
    """All settings by table."""

    general: type[Parameters]
    """What stands at the top of a settings file; `method` among it."""
    tables: Mapping[str, type[Parameters]]
    """The tables that every method shares, then one a method."""
    presets_of: Mapping[str, tuple[str, ...]]
    """The presets of every method; the default first."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods."""
        return self._choices("method")

    @property
    def presets(self) -> tuple[str, ...]:
        """Names of all presets; the default first."""
        return self._choices("preset")

    @property
    def classes(self) -> tuple[str, ...]:
        """What the file's own classes may be worth."""
        return self._choices("classes")

    @property
    def lods(self) -> tuple[str, ...]:
        """The sets of levels of detail that can be modelled, each with commas between them."""
        return self._choices("lods")

    def default(self, name: str) -> Any:
        """Default of a general setting."""
        return self._fields()[name].default

    def _fields(self) -> dict[str, dataclasses.Field[Any]]:
        return {field.name: field for field in dataclasses.fields(self.general)}

    def _choices(self, name: str) -> tuple[str, ...]:
        choices: tuple[str, ...] = self._fields()[name].metadata["choices"]
        return choices

    def variants(self) -> tuple[str, ...]:
        """What a comparison can run: every method by itself, and with each of its presets."""
        return tuple(
            word
            for method, presets in self.presets_of.items()
            for word in (method, *(f"{method}:{p}" for p in presets))
        )

    def faults(self, settings: Mapping[str, Any]) -> list[str]:
        """What is wrong with settings, a sentence a fault, the tables' names before them."""
        faults: list[str] = []
        general = {}
        for name, value in settings.items():
            if not isinstance(value, Mapping):
                general[name] = value
            elif name not in self.tables:
                faults.append(f"[{name}] is no table of settings: use one of {', '.join(self.tables)}")
            else:
                build(self.tables[name], name, _sane(value, f"[{name}] ", faults), faults)
        build(self.general, "", _sane(general, "", faults), faults)
        return faults

    def preset_faults(self, settings: Mapping[str, Any]) -> list[str]:
        """What is wrong with the preset beside the method, each known by itself."""
        method = settings.get("method", self.default("method"))
        preset = settings.get("preset", self.default("preset"))
        own = self.presets_of.get(method)
        if own is None or preset not in self.presets or preset in own:
            return []
        return [f"preset is {preset}, which {method} does not have: use {' or '.join(own)}, or name another method"]

    def schema(self) -> dict[str, Any]:
        """JSON schema of the settings."""
        tables = {
            name: {"type": "object", "additionalProperties": False, "properties": _properties(kind)}
            for name, kind in self.tables.items()
        }
        return {
            "type": "object",
            "additionalProperties": False,
            "properties": {**_properties(self.general), **tables},
        }


def _sane(values: Mapping[str, Any], prefix: str, faults: list[str]) -> dict[str, Any]:
    """What may be looked at further: JSON knows nulls and integers without end, settings do not."""
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


def _properties(kind: type[Parameters]) -> dict[str, Any]:
    """JSON schemas of the fields of a settings class."""
    properties = {}
    for field in dataclasses.fields(kind):
        meta, default = field.metadata, field.default
        unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
        found: dict[str, Any] = {"description": f"{meta['doc']}{unit}", "default": default}
        if meta["choices"] is not None:
            found |= {"type": "string", "enum": list(meta["choices"])}
        elif isinstance(default, tuple):
            limits = {name: meta[name] for name in ("minimum", "maximum") if meta[name] is not None}
            found |= {"type": "array", "items": {"type": "integer", **limits}, "default": list(default)}
        elif isinstance(default, bool):
            found["type"] = "boolean"
        elif isinstance(default, int | float):
            found["type"] = "integer" if isinstance(default, int) else "number"
            found |= {name: meta[name] for name in ("minimum", "maximum") if meta[name] is not None}
        else:
            found["type"] = "string"
        properties[field.name] = found
    return properties


def render() -> str:
    """The text of `catalogue.json`, from the settings classes themselves; imports the whole science."""
    from pipeline.methods import METHODS
    from pipeline.settings import SECTIONS, GeneralSettings

    kinds: dict[str, type[Parameters]] = {**SECTIONS, **{name: entry.settings_type for name, entry in METHODS.items()}}
    written = {
        "general": _fields_of(GeneralSettings),
        "tables": {name: _fields_of(kind) for name, kind in kinds.items()},
        "presets": {name: list(entry.presets) for name, entry in METHODS.items()},
    }
    return json.dumps(written, indent=1, ensure_ascii=False) + "\n"


def _fields_of(kind: type[Parameters]) -> dict[str, Any]:
    return {field.name: {"default": field.default, **field.metadata} for field in dataclasses.fields(kind)}


@functools.cache
def load() -> Catalogue:
    """The catalogue as it was written."""
    written = json.loads(PATH.read_text(encoding="utf-8"))
    return Catalogue(
        general=_kind("general", written["general"]),
        tables={name: WHOLE.get(name) or _kind(name, fields) for name, fields in written["tables"].items()},
        presets_of={name: tuple(presets) for name, presets in written["presets"].items()},
    )


def _kind(name: str, fields: Mapping[str, Mapping[str, Any]]) -> type[Parameters]:
    """A settings class with the fields of the original, and so with its checks of values."""
    made = []
    for field, facts in fields.items():
        values = dict(facts)
        choices = values.pop("choices")
        default = values.pop("default")
        if isinstance(default, list):
            default = tuple(default)
        described = parameter(default, values.pop("doc"), choices=None if choices is None else tuple(choices), **values)
        made.append((field, type(default), described))
    return dataclasses.make_dataclass(name, made, bases=(Parameters,), frozen=True, kw_only=True)


if __name__ == "__main__":
    PATH.write_text(render(), encoding="utf-8")
