"""Collections of features. Pages of features are made from prepared texts, so their models only describe them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.wire.base import Answer, Link, Time


class SpatialExtent(Answer):
    """Where the features lie."""

    bbox: list[list[float]] = Field(description="West, south, east, north in degrees.")
    crs: str | None = None


class TemporalExtent(Answer):
    """When the points were acquired."""

    interval: list[list[Time | None]]


class Extent(Answer):
    """Where and when."""

    spatial: SpatialExtent | None = None
    temporal: TemporalExtent | None = None


class Collection(Answer):
    """A table of a run."""

    id: str
    title: str
    description: str
    itemType: Literal["feature"] = Field()
    extent: Extent | None = None
    crs: list[str] = Field(description="URIs that `crs`, `bbox-crs` and `filter-crs` accept, the default first.")
    storageCrs: str | None = Field(None, description="The horizontal CRS of the run; absent without an EPSG code.")
    links: list[Link]


class Collections(Answer):
    """Collections that the caller may read."""

    links: list[Link]
    collections: list[Collection]


class JsonSchema(Answer):
    """A JSON schema of properties."""

    schema_: str = Field(alias="$schema")
    id_: str = Field(alias="$id")
    type: Literal["object"]
    title: str
    additionalProperties: bool
    properties: dict[str, Any]


class Shape(Answer):
    """A footprint, the faces of a roof plane or a box."""

    type: Literal["Polygon", "MultiPolygon"]
    coordinates: list[Any]


class CollectionFeature(Answer):
    """A feature of a collection."""

    type: Literal["Feature"]
    id: str
    geometry: Shape | None = Field(json_schema_extra={"nullable": True})
    properties: dict[str, Any] = Field(description="The columns of the table, and `tile`.")
    links: list[Link] | None = None


class CollectionPage(Answer):
    """A page of features."""

    type: Literal["FeatureCollection"]
    timeStamp: Time
    numberMatched: int | None = Field(None, ge=0, description="Absent where counting would take too long.")
    numberReturned: int = Field(ge=0)
    links: list[Link]
    features: list[CollectionFeature]
