"""The base classes and helpers of all models."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self
from urllib.parse import urlencode

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ModelWrapValidatorHandler,
    PlainSerializer,
    ValidationError,
    model_validator,
)
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema
from starlette.responses import Response

from service.errors import MOST_FAULTS
from service.wire.faults import FURTHER

RELATIONS = "http://www.opengis.net/def/rel/ogc/1.0/"
"""Prefix of the standard's link relations."""


def timestamp(at: dt.datetime) -> str:
    """A time as RFC 3339 in UTC, to the millisecond."""
    return at.astimezone(dt.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


Time = Annotated[dt.datetime, PlainSerializer(timestamp)]
"""A time in UTC."""

ZonedTime = Annotated[dt.datetime, PlainSerializer(dt.datetime.isoformat)]
"""A time with the offset of its time zone."""


def optional_members(schema: dict[str, Any]) -> None:
    """Describe an optional member as one that may be absent; null is accepted only if the member is `nullable`."""
    for name, found in schema.get("properties", {}).items():
        found.pop("title", None)
        if name in schema.get("required", ()):
            continue
        if found.get("default", 0) is None:
            del found["default"]
        if {"type": "null"} in found.get("anyOf", ()) and not found.pop("nullable", False):
            rest = [option for option in found.pop("anyOf") if option != {"type": "null"}]
            found.update(rest[0] if len(rest) == 1 else {"anyOf": rest})
    schema.pop("title", None)


class Answer(BaseModel):
    """A document that the service sends. Members that are None by default are left out."""

    model_config = ConfigDict(json_schema_extra=optional_members)


class Link(Answer):
    """A link."""

    href: str
    rel: str
    type: str | None = None
    title: str | None = None


def link(href: str, rel: str, title: str, media_type: str = "application/json") -> Link:
    """A link to a document."""
    return Link(href=href, rel=rel, type=media_type, title=title)


def page_links(
    place: str,
    given: Sequence[tuple[str, object]],
    found: int,
    limit: int,
    offset: int,
    media_type: str = "application/json",
) -> list[Link]:
    """Links from a page of a list to itself and its neighbours; `found` may be `limit` + 1."""
    query = [(name, value) for name, value in given if value is not None]

    def page(start: int, rel: str, title: str) -> Link:
        asked = urlencode([*query, ("limit", limit), ("offset", start)], errors="replace")
        return link(f"{place}?{asked}", rel, title, media_type)

    links = [page(offset, "self", "This page")]
    if found > limit:
        links.append(page(offset + limit, "next", "The next page"))
    if offset > 0:
        links.append(page(max(0, offset - limit), "prev", "The page before"))
    return links


def respond(
    document: BaseModel,
    *,
    status_code: int = 200,
    headers: Mapping[str, str] | None = None,
    media_type: str = "application/json",
) -> Response:
    """The response that carries a document."""
    content = document.model_dump_json(by_alias=True, exclude_defaults=True)
    return Response(content, status_code, dict(headers or {}), media_type)


class Request(BaseModel):
    """A document that clients send. All its faults are reported together, unknown and missing members included."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra=optional_members)

    NOUN: ClassVar[str] = "a member"
    """The word for its members in faults."""
    HINTS: ClassVar[Mapping[str, str]] = {}
    """The fix for a member that is missing, has too few or too many entries, or belongs elsewhere."""

    @classmethod
    def prepared(cls, given: Any) -> Any:
        """Turn the sent document into the one that is validated."""
        return given

    @model_validator(mode="wrap")
    @classmethod
    def _explained(cls, given: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        known, further = cls._without_most_unknown(cls.prepared(given))
        try:
            return handler(known)
        except ValidationError as error:
            faults = [cls._explanation(fault) for fault in error.errors(include_url=False)]
            if further:
                count = PydanticCustomError(FURTHER, "further unknown members", {"number": further})
                faults.append(InitErrorDetails(type=count, loc=(), input=None))
            raise ValidationError.from_exception_data(cls.__name__, faults) from None

    @classmethod
    def _without_most_unknown(cls, given: Any) -> tuple[Any, int]:
        """The document with the first unknown members only, and the number of the others: each costs an error."""
        if not isinstance(given, dict) or len(given) <= len(cls.model_fields) + MOST_FAULTS:
            return given, 0
        left = set([name for name in given if name not in cls.model_fields][MOST_FAULTS:])
        return {name: value for name, value in given.items() if name not in left}, len(left)

    @classmethod
    def _explanation(cls, fault: Any) -> InitErrorDetails:
        kind, context, message = fault["type"], fault.get("ctx", {}), fault["msg"]
        if kind == "extra_forbidden":
            fix = f"use {', '.join(cls.model_fields)}"
            if len(fault["loc"]) == 1:
                fix = cls.HINTS.get(fault["loc"][0], fix)
            kind, message = "unknown", f"is not {cls.NOUN}: {fix}"
        elif kind in {"missing", "too_short", "too_long"} and len(fault["loc"]) == 1:
            context = context | {"fix": hint} if (hint := cls.HINTS.get(fault["loc"][0])) else context
        return raised_again({**fault, "type": kind, "msg": message, "ctx": context})


def raised_again(fault: Any, *place: int | str) -> InitErrorDetails:
    """A fault of pydantic's or of ours as one of an error that is raised in its place, below `place`."""
    kind, context = fault["type"], fault.get("ctx", {})
    if kind in {"unknown", FURTHER} or "fix" in context:
        kind = PydanticCustomError(kind, fault["msg"], context)
    return InitErrorDetails(type=kind, loc=(*place, *fault["loc"]), input=fault["input"], ctx=context)


def at_most(number: int) -> BeforeValidator:
    """Refuses longer lists and objects before their entries are looked at: each bad one would cost an error."""

    def check(given: Any) -> Any:
        if isinstance(given, list | dict) and len(given) > number:
            raise ValueError(f"use at most {number} entries")
        return given

    return BeforeValidator(check)


class OneOf:
    """Annotates a text as one of some words that are known when the module is loaded."""

    def __init__(self, *words: str) -> None:
        self._words = words

    def __get_pydantic_core_schema__(self, *_: Any) -> CoreSchema:
        """A literal."""
        return core_schema.literal_schema(list(self._words))
