"""Uploads."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_serializer

from pipeline.io.formats import FORMATS
from service.wire.base import Answer, Link, OneOf, ZonedTime


class Crs(Answer):
    """A coordinate reference system."""

    name: str
    epsg: int | None


class Place(Answer):
    """A place on Earth, WGS 84, in degrees."""

    longitude: float
    latitude: float


class AreaOfUse(Answer):
    """The area for which a CRS is made; it crosses the antimeridian if west is larger than east."""

    name: str
    west: float
    south: float
    east: float
    north: float


def _nullable(schema: dict[str, Any]) -> None:
    """Describe members that may be absent or null."""
    for found in schema["properties"].values():
        found.pop("default", None)
        found.pop("title", None)


class Preflight(BaseModel):
    """The content of a file's header; null if unknown. Only one kind of file has counts of points, or of features."""

    model_config = ConfigDict(json_schema_extra=_nullable, extra="allow")

    kind: Literal["points", "footprints", "guides"]
    format: Annotated[
        str,
        OneOf(
            *(name for form in FORMATS for name in form.encodings),
            *("geopackage", "geojson", "geoparquet", "flatgeobuf", "gml", "kml", "shapefile", "zip"),
        ),
    ]
    usable: bool = Field(description="Whether a job can use it without further inputs.")
    problems: list[str] = Field(description="Problems that a job can fix, such as degrees with `crs`.")
    warnings: list[str]
    crs: Crs | None = Field(None, description="Null if the file states none.")
    pointCount: int | None = Field(None, description="Number of lines for text that was not read through.")
    horizontalUnitM: float | None = None
    verticalUnitM: float | None = None
    bounds: list[float] | None = Field(
        None, description="x_min, y_min, z_min, x_max, y_max, z_max in the units of the CRS."
    )
    place: Place | None = Field(None, description="Place of the middle of the bounds.")
    areaOfUse: AreaOfUse | None = Field(None, description="Area of use of the CRS.")
    outsideAreaOfUse: str | None = Field(
        None, description="Why a job needs allowOutsideAreaOfUse; null if it does not. Also one of the problems."
    )
    densityPerM2: float | None = None
    hasReturns: bool | None = None
    hasClasses: bool | None = None
    acquiredFrom: str | None = None
    acquiredTo: str | None = None
    shapes: list[Literal["polygons", "lines"]] | None = Field(
        None, description="What a vector file can hold: polygons can be footprints, lines can be guides."
    )
    featureCount: int | None = None
    layers: list[str] | None = None


class Upload(Answer):
    """A file that was sent."""

    uploadID: str
    filename: Annotated[str, Field(description="Cleaned name.")]
    bytes: Annotated[int, Field(ge=1)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    created: ZonedTime
    expires: ZonedTime
    preflight: Preflight
    links: list[Link]

    @field_serializer("preflight")
    def _as_stored(self, preflight: Preflight) -> dict[str, Any]:
        return preflight.model_dump(exclude_unset=True)


class UploadList(Answer):
    """A page of uploads."""

    uploads: list[Upload]
    links: list[Link]
