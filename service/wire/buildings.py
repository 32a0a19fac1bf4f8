"""Buildings: GeoJSON and CityJSON. Results are streamed, so these models only describe them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.outputs.single_building import ID_PATTERN
from service.wire.base import Answer, Link


class Outline(Answer):
    """A footprint."""

    type: Literal["Polygon", "MultiPolygon"]
    coordinates: list[Any]


class Feature(Answer):
    """A building."""

    type: Literal["Feature"]
    id: str = Field(pattern=ID_PATTERN)
    geometry: Outline | None
    properties: dict[str, Any] = Field(description="The columns of the table buildings, and `tile`.")
    links: list[Link] | None = None


class FeaturePage(Answer):
    """A page of buildings."""

    type: Literal["FeatureCollection"]
    numberMatched: int = Field(ge=0)
    numberReturned: int = Field(ge=0)
    coordRefSys: str | None = Field(
        None,
        description="Present if the coordinates are not CRS84; null if their CRS is unknown.",
        json_schema_extra={"nullable": True},
    )
    links: list[Link]
    features: list[Feature]


class CityJson(Answer):
    """A CityJSON document of one building."""

    type: Literal["CityJSON"]
    version: Literal["2.0"]
    transform: dict[str, Any]
    metadata: dict[str, Any] | None = None
    CityObjects: dict[str, Any]
    vertices: list[Any]
