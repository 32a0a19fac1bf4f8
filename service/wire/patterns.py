"""Patterns of texts that clients send: stated in the OpenAPI document, and checked.

A pattern takes what can be right by its form. Whether there is such a day, zone, collection or file, no pattern says.
They are written for JSON Schema and for Python alike: without flags, and anchored at both ends.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

_DATE = "[0-9]{4}-((0[13578]|1[02])-(0[1-9]|[12][0-9]|3[01])|(0[469]|11)-(0[1-9]|[12][0-9]|30)|02-(0[1-9]|[12][0-9]))"
_CLOCK = "([01][0-9]|2[0-3]):[0-5][0-9](:[0-5][0-9]([.][0-9]{1,9})?)?"
# an unescaped plus in a query is a space
TIME = f"{_DATE}(T{_CLOCK}(Z|[+ -]([01][0-9]|2[0-3]):[0-5][0-9])?)?"
"""A day, or a time of a day, as in RFC 3339; seconds and zone may be left out."""
INTERVAL = f"^({TIME}|({TIME}|[.][.])?/({TIME}|[.][.])?)$"
"""A time, or two with a slash between them; an end that is empty or two dots is open."""

_NUMBER = "[+-]?([0-9]{1,20}([.][0-9]{0,20})?|[.][0-9]{1,20})([eE][+-]?[0-9]{1,2})?"
WINDOW = f"^ *{_NUMBER} *(, *{_NUMBER} *){{3}}$"
"""Four numbers with commas between them."""

CRS_URI = "^\\[?http://www[.]opengis[.]net/def/crs/(OGC/1[.]3/CRS84|EPSG/0/[0-9]{4,6})\\]?$"
"""The URI of a coordinate reference system; a collection has some of them."""

KEY = '^("([ !#-\\[\\]-~]|\\\\["\\\\]){1,255}"|[!#-+.-:<-\\[\\]-~-]{1,255})$'
"""An Idempotency-Key: a text in quotes, or one without blanks, quotes, commas, semicolons and backslashes."""

_END = "[A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}="
_BASE64 = f"(([A-Za-z0-9+/]{{4}})+({_END})?|{_END})"
_PAIR = f"[!#-+.-~-]+( {_BASE64})?"
METADATA = f"^({_PAIR},)*filename {_BASE64}(,{_PAIR})*$"
"""The header Upload-Metadata."""
CHECKSUM = "^(sha1 [A-Za-z0-9+/]{27}=|sha256 [A-Za-z0-9+/]{43}=)$"
"""The header Upload-Checksum."""

TEXT = (
    "^[^\\u0000-\\u0008\\u000b\\u000c\\u000e-\\u001f\\u007f-\\u009f]*"
    "[^\\s\\u0000-\\u001f\\u007f-\\u009f]"
    "[^\\u0000-\\u0008\\u000b\\u000c\\u000e-\\u001f\\u007f-\\u009f]*$"
)
"""A text that is not blank and has no control characters except tabs and ends of lines."""


def _field(value: str, alone: str = "") -> str:
    """A field of cron: values, ranges and steps with commas between them, or what has no place in a list."""
    item = f"([*](/[1-9][0-9]?)?|{value}(-{value}(/[1-9][0-9]?)?)?)"
    return f"({item}(,{item})*{alone})"


_MONTHS = "JAN|FEB|MAR|APR|MAY|JUN|JUL|AUG|SEP|OCT|NOV|DEC"
_DAYS = "SUN|MON|TUE|WED|THU|FRI|SAT"
_FIELDS = (
    _field("[0-5]?[0-9]"),
    _field("([01]?[0-9]|2[0-3])"),
    _field("(0?[1-9]|[12][0-9]|3[01])", "|L|LW"),
    _field(f"(0?[1-9]|1[0-2]|{_MONTHS}|{_MONTHS.lower()})"),
    _field(f"([0-7]|{_DAYS}|{_DAYS.lower()})", "|[0-7](L|#[1-5])"),
)
CRON = f"^ *(@(hourly|daily|midnight|weekly|monthly|yearly|annually)|{' +'.join(_FIELDS)}) *$"
"""An expression of cron; that ranges go up, it does not say."""
ZONE = "^[A-Za-z][A-Za-z0-9_+/-]*$"
"""The name of a time zone."""


def any_of(words: Iterable[str]) -> str:
    """Some of these words with commas between them.

    >>> bool(re.match(any_of(["ok", "failed"]), "ok, failed,")), bool(re.match(any_of(["ok"]), "okay"))
    (True, False)
    """
    word = f" *({'|'.join(map(re.escape, words))})? *"
    return f"^{word}(,{word})*$"


def stated(pattern: str) -> dict[str, Any]:
    """Adds a pattern to the schema of a field whose own validator checks it."""
    return {"pattern": pattern}


def fits(pattern: str, text: str) -> bool:
    """Whether a whole text has a form; the end of a line after it does not count as one in Python only.

    >>> fits(INTERVAL, "2026-03-01T09:30:00Z/.."), fits(INTERVAL, ""), fits(INTERVAL, "2026-02-30")
    (True, False, False)
    """
    return re.fullmatch(pattern.removesuffix("$"), text) is not None
