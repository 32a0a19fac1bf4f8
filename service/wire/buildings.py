"""Buildings: GeoJSON and CityJSON. Results are streamed, so these models only describe them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from service.outputs.single_building import ID_PATTERN
from service.wire.base import Answer, Link
from service.wire.features import Shape

_VERTICAL_UNIT = Field(None, description="Metres per unit of the properties that are elevations, such as `ridge_z`.")


class Feature(Answer):
    """A building."""

    type: Literal["Feature"]
    id: str = Field(pattern=ID_PATTERN)
    geometry: Shape | None
    properties: dict[str, Any] = Field(description="The columns of the table buildings, and `tile`.")
    verticalUnitM: float | None = _VERTICAL_UNIT
    links: list[Link] | None = None


class FeaturePage(Answer):
    """A page of buildings."""

    type: Literal["FeatureCollection"]
    numberMatched: int = Field(ge=0)
    numberReturned: int = Field(ge=0)
    complete: bool = Field(description="False while the job runs: more buildings may come.")
    progress: int | None = Field(None, ge=0, le=100, description="Of the job, while it runs.")
    attempt: int | None = Field(
        None,
        ge=1,
        description="Of the job, while it runs. A new attempt begins with an empty list.",
    )
    coordRefSys: str | None = Field(
        None,
        description="Present if the coordinates are not CRS84; null if their CRS is unknown.",
        json_schema_extra={"nullable": True},
    )
    verticalUnitM: float | None = _VERTICAL_UNIT
    links: list[Link]
    features: list[Feature]


class Decision(Answer):
    """A check, a form of the roof or a level of detail. Figures that were not needed are left out."""

    step: int = Field(ge=0)
    kind: Literal["check", "form", "level"]
    name: str = Field(description="Name of the figure, the form or the level of detail.")
    outcome: Literal["met", "missed", "chosen", "outdone", "invalid", "undrawable", "withdrawn"]
    detail: str = Field(description="How the form was drawn, or why it was refused; may be empty.")
    value: float | None = Field(None, description="The figure of a check.")
    limit: float | None = Field(None, description="The least value that meets the check.")
    n_faces: int | None = Field(None, ge=0, description="Roof faces.")
    n_planes: int | None = Field(None, ge=0, description="Roof planes with a face.")
    levelled_share: float | None = Field(None, description="Share of the plan whose faces were made level.")
    explained_share: float | None = Field(None, description="Share of the roof points near the faces.")
    bic_margin: float | None = Field(
        None, description="By how much the information criterion is below that of the form that competed."
    )
    validity_codes: list[int] = Field([], description="Codes of the faults of the solids.")


class Decisions(Answer):
    """What was checked and tried for one building."""

    building_id: str = Field(pattern=ID_PATTERN)
    decisions: list[Decision] = Field(description="In the order of the attempts; empty if the process ended before.")
    links: list[Link]


class CityJson(Answer):
    """A CityJSON document of one building."""

    type: Literal["CityJSON"]
    version: Literal["2.0"]
    transform: dict[str, Any]
    metadata: dict[str, Any] | None = None
    CityObjects: dict[str, Any]
    vertices: list[Any]
