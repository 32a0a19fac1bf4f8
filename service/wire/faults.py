"""Turns pydantic's errors into sentences with the path, the value and the fix."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from service.errors import RequestError

FIXES: Mapping[str, str] = {
    "string_type": "use a text",
    "string_too_long": "use at most {max_length} characters",
    "bool_type": "use true or false",
    "int_type": "use a whole number",
    "int_parsing": "use a whole number",
    "float_type": "use a number",
    "float_parsing": "use a number",
    "finite_number": "use a finite number",
    "greater_than": "use more than {gt}",
    "greater_than_equal": "use {ge} or more",
    "less_than": "use less than {lt}",
    "less_than_equal": "use at most {le}",
    "too_short": "use at least {min_length} entries",
    "too_long": "use at most {max_length} entries",
    "list_type": "use a list",
    "dict_type": "use an object",
    "model_type": "use an object",
    "model_attributes_type": "use an object",
}
"""The fix by pydantic's type of fault; the bounds come from its context."""


class FaultsError(ValueError):
    """Raised by validators for several faults, each a sentence with its path, instead of a fix for one value."""

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = tuple(faults)
        super().__init__("; ".join(self.faults))


def sentences(errors: Sequence[Mapping[str, Any]]) -> list[str]:
    """One sentence per fault."""
    found: list[str] = []
    for error in errors:
        context = error.get("ctx") or {}
        cause, kind = context.get("error"), error["type"]
        if isinstance(cause, FaultsError):
            found += cause.faults
        elif kind == "json_invalid":
            found.append(f"the body is not JSON: {cause or error['msg']}")
        elif kind == "missing":
            found.append(f"{_path(error['loc'])} is missing: {context.get('fix', 'give a value')}")
        elif kind == "unknown":
            found.append(f"{shortened(error['loc'][-1])} {error['msg']}")
        else:
            found.append(f"{_path(error['loc'])} is {shortened(error['input'])}: {_fix(kind, context, error['msg'])}")
    return found


def _fix(kind: str, context: Mapping[str, Any], message: str) -> str:
    if kind == "value_error":
        return str(context["error"])
    if kind == "literal_error":
        return f"use one of {context['expected'].replace(chr(39), '').replace(' or ', ', ')}"
    if "fix" in context:
        return str(context["fix"])
    limits = {name: f"{value:g}" if isinstance(value, float) else value for name, value in context.items()}
    return FIXES.get(kind, message).format_map(limits)


def _path(place: Sequence[int | str]) -> str:
    """A path as clients write it.

    >>> _path(("body", "inputs", "tiles", 0, "href")), _path(("query", "limit")), _path(("body",))
    ('inputs.tiles[0].href', 'query limit', 'the body')
    """
    words, text = list(place), ""
    part = words.pop(0) if words and words[0] in {"body", "query", "path", "header"} else ""
    for word in words:
        text += f"[{word}]" if isinstance(word, int) else f".{word}"
    text = text.removeprefix(".")
    if part in {"", "body"}:
        return text or "the body"
    return f"{part} {text}"


def json_bytes(value: Any) -> bytes:
    """A part of a request as JSON again.

    Raises
    ------
    RequestError
        It is nested too deeply to be written.
    """
    try:
        return json.dumps(value, ensure_ascii=False, default=repr).encode("utf-8", "replace")
    except RecursionError:
        raise RequestError(["the request is nested hundreds of levels deep: no input needs that"]) from None


def shortened(value: Any) -> str:
    """A value as JSON, cut if it is long."""
    text = json_bytes(value).decode("utf-8")
    return text if len(text) <= 80 else f"{text[:77]}..."
