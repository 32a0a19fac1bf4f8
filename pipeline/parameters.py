"""What a settings class is made of: frozen fields that know their unit, range and meaning.

Every stage keeps a small frozen settings class beside its code, derived from `Parameters`;
`pipeline.settings` composes them. The metadata serves validation, the reference docs and the test
that holds both together.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from pipeline.errors import SettingsError


def parameter(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] | None = None,
    changes_geometry: bool = True,
) -> Any:
    """Describe one field of a settings class.

    Parameters
    ----------
    default : bool, int, float, str, tuple of int or None
        The default; its type is the field's type.
    doc : str
        One sentence for the reference docs.
    unit : str
        Unit of a number, empty where it has none.
    minimum, maximum : float, optional
        Inclusive bounds of a number, or of each number of a tuple; of a whole number that may stand in the place of a
        text.
    choices : tuple of str, optional
        The valid words of a string.
    changes_geometry : bool
        Whether the value can change results, and so belongs to the settings hash.
    """
    metadata = {
        "doc": doc,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
        "changes_geometry": changes_geometry,
    }
    return dataclasses.field(default=default, metadata=metadata)


def _fault(name: str, value: Any, field: dataclasses.Field[Any]) -> str | None:
    """The sentence for a value that its field does not allow, or None."""
    meta = field.metadata
    if not meta or value is None:
        return None
    default, choices = field.default, meta["choices"]
    if choices is not None:
        return None if value in choices else f"{name} is {value!r}: use one of {', '.join(choices)}"
    if isinstance(default, tuple):
        low, high = meta["minimum"], meta["maximum"]
        if isinstance(value, tuple) and all(type(v) is int and low <= v <= high for v in value):
            return None
        return f"{name} is {value!r}: use a list of whole numbers from {low:g} to {high:g}"
    if isinstance(default, bool):
        return None if isinstance(value, bool) else f"{name} is {value!r}: use true or false"
    if isinstance(default, int | float):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return f"{name} is {value!r}: use a finite number"
        if isinstance(default, int) and not isinstance(value, int):
            return f"{name} is {value!r}: use a whole number"
        low, high, unit = meta["minimum"], meta["maximum"], meta["unit"]
        if (low is not None and value < low) or (high is not None and value > high):
            low_text = "any" if low is None else f"{low:g}"
            high_text = "any" if high is None else f"{high:g}"
            return f"{name} is {value:g}: use {low_text} to {high_text} {unit}".rstrip()
    if isinstance(default, str) and meta["minimum"] is not None:
        low, high = meta["minimum"], meta["maximum"]
        if value == default or (type(value) is int and low <= value <= high):
            return None
        return f"{name} is {value!r}: use {default!r} or a whole number from {low:g} to {high:g}"
    if isinstance(default, str) and not isinstance(value, str):
        return f"{name} is {value!r}: use a text in quotes"
    return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameters:
    """Base of all settings classes: checks every field once, at construction.

    Raises
    ------
    SettingsError
        Listing all faults at once.
    """

    def __post_init__(self) -> None:
        """Check every field."""
        faults = []
        for field in dataclasses.fields(self):
            fault = _fault(field.name, getattr(self, field.name), field)
            if fault:
                faults.append(fault)
        faults.extend(self.cross_faults())
        if faults:
            raise SettingsError(faults)

    def cross_faults(self) -> list[str]:
        """Faults that concern more than one field; overridden where there are any."""
        return []


def build(
    kind: type[Parameters],
    section: str,
    values: Mapping[str, Any],
    faults: list[str],
    base: Parameters | None = None,
) -> Any:
    """One settings object, or None with its faults appended, each under the name of its table.

    What `values` does not name is taken from `base`, or from the defaults.
    """
    names = {field.name: field for field in dataclasses.fields(kind)}
    prefix = f"[{section}] " if section else ""
    unknown = [name for name in values if name not in names]
    faults.extend(f"{prefix}{name} is no setting: use one of {', '.join(names)}" for name in unknown)
    given = {}
    for name, value in values.items():
        if name in names:
            # TOML writes 2 where a float is meant
            wants_float = isinstance(names[name].default, float) and isinstance(value, int)
            given[name] = float(value) if wants_float and not isinstance(value, bool) else value
            if isinstance(names[name].default, tuple) and isinstance(value, list):
                given[name] = tuple(value)
    try:
        return kind(**given) if base is None else dataclasses.replace(base, **given)
    except SettingsError as error:
        faults.extend(f"{prefix}{fault}" for fault in error.faults)
        return None
