"""Files among the inputs: by reference, or by value within the request."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, PlainValidator, ValidationError, WithJsonSchema, WrapValidator
from pydantic_core import InitErrorDetails, PydanticCustomError

from pipeline.io.formats import ASCII, FORMATS, LAS
from service.drafts import Inline, reference_of
from service.errors import MOST_FAULTS
from service.jobs import InputReference
from service.wire.base import OneOf, Request, raised_again
from service.wire.faults import FURTHER, json_bytes

ENDINGS: Mapping[str, str] = {media: suffix for form in FORMATS for suffix, media in form.media_types.items() if media}
"""Media types of point clouds sent by value, and the endings of their files."""

_OUTLINE_ENDINGS = {
    b"SQLite format 3": ".gpkg",
    b"PAR1": ".parquet",
    b"fgb": ".fgb",
    b"PK": ".zip",
    b"<": ".gml",
}
"""Endings of footprints and guides that are sent by value, by their first bytes; others are GeoJSON."""

Source = InputReference | Inline
"""An input: stored already, or within the request."""


def _placed(href: Any) -> InputReference:
    if not isinstance(href, str) or not href.strip() or not href.isprintable() or len(href) > 4096:
        raise ValueError("use an upload, a URL or a path")
    reference = reference_of(href)
    if reference is None:
        raise ValueError("use /uploads/{id}, an https URL, or an absolute path below an input folder")
    return reference


def _decoded(value: Any) -> bytes:
    try:
        content = base64.b64decode("".join(value.split()), validate=True) if isinstance(value, str) else b""
    except (ValueError, binascii.Error):
        content = b""
    if not content:
        raise ValueError("use an href, or a value with base64 content")
    return content


Content = Annotated[bytes, BeforeValidator(_decoded)]
"""The bytes of a file, sent as base64."""


class ByReference(Request):
    """A file elsewhere: a link, of which only the `href` matters."""

    href: Annotated[InputReference, PlainValidator(_placed)]
    rel: str | None = None
    type: str | None = None
    hreflang: str | None = None
    title: str | None = None
    length: int | None = None


class PointsByValue(Request):
    """A point cloud within the request."""

    HINTS: ClassVar[Mapping[str, str]] = {"value": "use an href, or a value with base64 content"}

    value: Content
    encoding: Literal["base64"] = "base64"
    mediaType: Annotated[str, OneOf(*ENDINGS)] | None = None


class OutlinesByValue(Request):
    """A file of footprints or guides within the request; its first bytes say its format."""

    value: Content
    encoding: Literal["base64"]
    mediaType: str | None = None


def _referenced(given: Mapping[str, Any]) -> InputReference:
    if "value" in given:
        raise ValueError("use an href or a value, not both")
    return ByReference.model_validate(given).href


def points(given: Any) -> Source:
    """A point cloud by reference or by value."""
    if not isinstance(given, Mapping):
        return _points(_decoded(given), None)
    if "href" in given:
        return _referenced(given)
    sent = PointsByValue.model_validate(given)
    return _points(sent.value, sent.mediaType)


def _points(content: bytes, media_type: str | None) -> Inline:
    return Inline(content=content, filename=f"tiles{ENDINGS[media_type] if media_type else _ending_of(content)}")


def _ending_of(content: bytes) -> str:
    """Ending of a point cloud's file, by its first bytes."""
    form = next((form for form in FORMATS if content.startswith(form.magic)), ASCII)
    # the highest bit of the point format marks compression
    is_laz = form is LAS and len(content) > 104 and content[104] & 0x80
    return ".laz" if is_laz else form.suffixes[0]


def outlines(given: Any) -> Source:
    """Footprints by reference or by value."""
    return _vectors(given, "footprints")


def guides(given: Any) -> Source:
    """Guides by reference or by value."""
    return _vectors(given, "guides")


def _vectors(given: Any, name: str) -> Source:
    """A vector file by reference or by value; a name of an input."""
    if isinstance(given, list):
        if len(given) != 1:
            raise ValueError("use one file")
        given = given[0]
    if isinstance(given, Mapping) and "href" in given:
        return _referenced(given)
    if isinstance(given, Mapping) and "value" in given:
        if given.get("encoding") == "base64":
            content = OutlinesByValue.model_validate(given).value
            ending = next((end for magic, end in _OUTLINE_ENDINGS.items() if content.startswith(magic)), ".geojson")
            return Inline(content=content, filename=f"{name}{ending}")
        given = given["value"]
    if not isinstance(given, Mapping) or given.get("type") != "FeatureCollection":
        raise ValueError("use an href, or a GeoJSON FeatureCollection")
    return Inline(content=json_bytes(given), filename=f"{name}.geojson")


def _one_or_several(given: Any, handler: Any) -> Any:
    """A list, also of a single file that is sent without one. After many faults the rest is not looked at."""
    del handler  # it would look at all
    if not isinstance(given, list):
        return [points(given)]
    faults: list[InitErrorDetails] = []
    found: list[Source] = []
    for number, one in enumerate(given):
        if len(faults) >= MOST_FAULTS:
            rest = PydanticCustomError(FURTHER, "further entries", {"number": len(given) - number})
            faults.append(InitErrorDetails(type=rest, loc=(), input=None))
            break
        try:
            found.append(points(one))
        except ValidationError as error:
            faults += [raised_again(fault, number) for fault in error.errors(include_url=False)]
        except ValueError as error:
            faults.append(InitErrorDetails(type="value_error", loc=(number,), input=one, ctx={"error": error}))
    if faults:
        raise ValidationError.from_exception_data("tiles", faults)
    return found


def _encoded(*media_types: str) -> list[dict[str, str]]:
    return [{"type": "string", "contentEncoding": "base64", "contentMediaType": kind} for kind in media_types]


Points = Annotated[Source, PlainValidator(points), WithJsonSchema({"oneOf": _encoded(*ENDINGS)})]
"""A point cloud."""

PointClouds = Annotated[list[Points], WrapValidator(_one_or_several), Field(min_length=1)]
"""One point cloud or several."""

_OF_VECTORS = WithJsonSchema(
    {
        "oneOf": [
            {
                "type": "object",
                "format": "geojson-feature-collection",
                "contentMediaType": "application/geo+json",
            },
            *_encoded(
                "application/geopackage+sqlite3",
                "application/vnd.apache.parquet",
                "application/flatgeobuf",
                "application/gml+xml",
                "application/zip",
            ),
        ]
    }
)

Outlines = Annotated[Source, PlainValidator(outlines), _OF_VECTORS]
"""Footprints."""

Lines = Annotated[Source, PlainValidator(guides), _OF_VECTORS]
"""Guides."""
