"""Base of the settings classes: frozen fields with their unit, range and meaning.

Every chapter has a module of settings classes derived from `Parameters`; `pipeline.settings` composes them. The
metadata serves validation and the reference docs.
"""

from __future__ import annotations

import dataclasses
import reprlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, dataclass_transform

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
    added: bool = False,
) -> Any:
    """Describe one field of a settings class: default, one sentence for the reference docs, unit, and what is valid.

    Parameters
    ----------
    default : bool, int, float, str, tuple of int or None
        The default; its type is the field's type.
    minimum, maximum : float, optional
        Inclusive bounds of a number, of each number of a tuple, or of a whole number allowed instead of a text.
    choices : tuple of str, optional
        The valid words of a string.
    changes_geometry : bool
        Whether the value can change results and belongs to the settings hash.
    added : bool
        Whether its default leaves the settings hash as it was before there was this setting.
    """
    metadata = {
        "doc": doc,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
        "changes_geometry": changes_geometry,
        "added": added,
    }
    return dataclasses.field(default=default, metadata=metadata)


def read_toml(path: str | Path, what: str) -> dict[str, Any]:
    """The tables of a TOML file; `what` names the file in messages, such as `settings file`.

    Raises SettingsError if it cannot be read, is not TOML, or is nested or has a number beyond what can be read.
    """
    import tomllib  # most commands read no such file

    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError([f"{what} {path} cannot be read: {error.strerror or error}"]) from error
    except UnicodeDecodeError as error:
        fault = f"byte {error.start} is not UTF-8: save it as UTF-8"
        raise SettingsError([f"{what} {path} is not TOML: {fault}"]) from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsError([f"{what} {path} is not TOML: {error}"]) from error
    except ValueError as error:
        raise SettingsError([f"{what} {path} cannot be read: a number has thousands of digits"]) from error
    except RecursionError as error:
        raise SettingsError([f"{what} {path} is not TOML: its brackets are nested too deeply"]) from error


def is_finite_number(value: Any) -> bool:
    """Whether a value of a file is a number that a float can hold; true and false are not.

    Whole numbers of a file have any number of digits, and `math.isfinite` raises for large ones.

    >>> [is_finite_number(value) for value in (2, -0.5, float("nan"), 10**400, True, "2")]
    [True, True, False, False, False, False]
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


_QUOTING = reprlib.Repr()
_QUOTING.maxstring = _QUOTING.maxother = 200
_QUOTING.maxlong = 40
_QUOTING.maxlist = _QUOTING.maxtuple = _QUOTING.maxdict = 20


def quoted(value: Any) -> str:
    """A value of a file for a message, as Python writes it; long ones are shortened.

    >>> quoted("a"), quoted(10**400)
    ("'a'", '100000000000000000...0000000000000000000')
    """
    return _QUOTING.repr(value)


def _fault(name: str, value: Any, field: dataclasses.Field[Any]) -> str | None:
    """The fault of a value that its field does not allow, or None."""
    meta = field.metadata
    if not meta or value is None:
        return None
    default, choices = field.default, meta["choices"]
    if choices is not None:
        return None if value in choices else f"{name} is {quoted(value)}: use one of {', '.join(choices)}"
    if isinstance(default, tuple):
        low, high = meta["minimum"], meta["maximum"]
        if isinstance(value, tuple) and all(type(v) is int and low <= v <= high for v in value):
            return None
        return f"{name} is {quoted(value)}: use a list of whole numbers from {low:g} to {high:g}"
    if isinstance(default, bool):
        return None if isinstance(value, bool) else f"{name} is {quoted(value)}: use true or false"
    if isinstance(default, int | float):
        if not is_finite_number(value):
            return f"{name} is {quoted(value)}: use a finite number"
        if isinstance(default, int) and not isinstance(value, int):
            return f"{name} is {quoted(value)}: use a whole number"
        low, high, unit = meta["minimum"], meta["maximum"], meta["unit"]
        if (low is not None and value < low) or (high is not None and value > high):
            low_text = "any" if low is None else f"{low:g}"
            high_text = "any" if high is None else f"{high:g}"
            return f"{name} is {value:g}: use {low_text} to {high_text} {unit}".rstrip()
    if isinstance(default, str) and meta["minimum"] is not None:
        low, high = meta["minimum"], meta["maximum"]
        if value == default or (type(value) is int and low <= value <= high):
            return None
        return f"{name} is {quoted(value)}: use {default!r} or a whole number from {low:g} to {high:g}"
    if isinstance(default, str) and not isinstance(value, str):
        return f"{name} is {quoted(value)}: use a text in quotes"
    return None


_collect_fields = dataclasses.dataclass(init=False, repr=False, eq=False)


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Parameters:
    """Base of all settings classes: frozen dataclasses that check every field once, at construction.

    A derived class is a dataclass without the decorator. The methods are here and not generated: generating them for
    each class took a tenth of the start-up.

    Raises
    ------
    SettingsError
        Listing all faults at once.
    """

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls) -> None:
        """Collect the fields."""
        _collect_fields(cls)

    def __init__(self, **values: Any) -> None:
        """Take values by name, defaults for the others, and check every field."""
        fields = dataclasses.fields(self)
        vars(self).update({field.name: field.default for field in fields} | values)
        if len(vars(self)) > len(fields):
            unknown = ", ".join(sorted(vars(self).keys() - {field.name for field in fields}))
            raise TypeError(f"{type(self).__name__} has no field {unknown}")
        faults = [fault for field in fields if (fault := _fault(field.name, getattr(self, field.name), field))]
        faults.extend(self.cross_faults())
        if faults:
            raise SettingsError(faults)

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse: settings are frozen."""
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> None:
        """Refuse: settings are frozen."""
        raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")

    def __eq__(self, other: object) -> bool:
        """Whether class and values are equal."""
        return vars(self) == vars(other) if type(self) is type(other) else NotImplemented

    def __hash__(self) -> int:
        """The hash of the values."""
        return hash((type(self), *vars(self).items()))

    def __repr__(self) -> str:
        """As written in Python."""
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in vars(self).items())})"

    def cross_faults(self) -> list[str]:
        """Faults that concern more than one field; none by default."""
        return []

    def range_faults(self, low: str, high: str) -> list[str]:
        """The fault of two fields that bound a range, or none."""
        low_value, high_value = getattr(self, low), getattr(self, high)
        return [f"{low} is {low_value:g}: use at most {high}, {high_value:g}"] if low_value > high_value else []


_collect_fields(Parameters)


def build(
    kind: type[Parameters],
    section: str,
    values: Mapping[str, Any],
    faults: list[str],
    base: Parameters | None = None,
) -> Any:
    """One settings object, or None with its faults appended, each under the name of its table.

    Fields that `values` does not name come from `base`, or from the defaults.
    """
    names = {field.name: field for field in dataclasses.fields(kind)}
    prefix = f"[{section}] " if section else ""
    unknown = [name for name in values if name not in names]
    for name in unknown:
        from pipeline.renamed_settings import RENAMED  # only for a fault

        renamed = RENAMED.get(name)
        fix = f"it is called {renamed} now" if renamed in names else f"use one of {', '.join(names)}"
        faults.append(f"{prefix}{name} is not a setting: {fix}")
    given = {}
    for name, value in values.items():
        if name in names:
            # TOML writes 2 where a float is meant
            wants_float = isinstance(names[name].default, float) and is_finite_number(value)
            given[name] = float(value) if wants_float else value
            if isinstance(names[name].default, tuple) and isinstance(value, list):
                given[name] = tuple(value)
    try:
        return kind(**given) if base is None else dataclasses.replace(base, **given)
    except SettingsError as error:
        faults.extend(f"{prefix}{fault}" for fault in error.faults)
        return None
