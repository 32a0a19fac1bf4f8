"""Turns pydantic's errors into sentences with the path, the value and the fix."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from service.errors import MOST_FAULTS, Further, RequestError, few

FURTHER = "further"
"""Type of a fault that stands for as many as its context says."""

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
        self.faults = few(faults)
        super().__init__("; ".join(self.faults))


def sentences(errors: Sequence[Mapping[str, Any]]) -> list[str]:
    """One sentence per fault, for the first ones; the others are counted."""
    found: list[str] = []
    for number, error in enumerate(errors):
        if len(found) >= MOST_FAULTS:
            found += [*(_numbers(errors[number:]))]
            break
        found += _sentences(error)
    return [*few(found)]


def _numbers(errors: Sequence[Mapping[str, Any]]) -> Iterator[Further]:
    """How many faults there are, without their sentences, which take time."""
    for error in errors:
        cause, number = (error.get("ctx") or {}).get("error"), 1
        if isinstance(cause, FaultsError):
            number = sum(fault.number if isinstance(fault, Further) else 1 for fault in cause.faults)
        elif error["type"] == FURTHER:
            number = error["ctx"]["number"]
        yield Further(number)


def _sentences(error: Mapping[str, Any]) -> Sequence[str]:
    context = error.get("ctx") or {}
    cause, kind = context.get("error"), error["type"]
    if isinstance(cause, FaultsError):
        return cause.faults
    if kind == FURTHER:
        return [Further(context["number"])]
    if kind == "json_invalid":
        return [f"the body is not JSON: {cause or error['msg']}"]
    if kind == "missing":
        return [f"{_path(error['loc'])} is missing: {context.get('fix', 'give a value')}"]
    if kind == "unknown":
        return [f"{shortened(error['loc'][-1])} {error['msg']}"]
    return [f"{_path(error['loc'])} is {shortened(error['input'])}: {_fix(kind, context, error['msg'])}"]


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
        text += f"[{word}]" if isinstance(word, int) else f".{word if len(word) <= LONGEST_VALUE else shortened(word)}"
    text = text.removeprefix(".")
    if part in {"", "body"}:
        return text or "the body"
    return f"{part} {text}"


LONGEST_VALUE = 80
"""Characters of a value, or of the name of a member, in a sentence."""


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
    text = ""
    # piece by piece, since a large value is not written whole only to be cut
    for piece in _encoder.iterencode(value[: LONGEST_VALUE + 1] if isinstance(value, str) else value):
        text += piece[: LONGEST_VALUE + 1]
        if len(text) > LONGEST_VALUE:
            text = f"{text[: LONGEST_VALUE - 3]}..."
            break
    return text.encode("utf-8", "replace").decode("utf-8")


_encoder = json.JSONEncoder(ensure_ascii=False, default=repr)
