"""The inputs of the processes."""

from __future__ import annotations

import dataclasses
import importlib.util
import unicodedata
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationInfo,
    WithJsonSchema,
    create_model,
    field_validator,
)

from pipeline.errors import CrsError
from pipeline.io.crs import LARGEST_COORDINATE, horizontal_unit_of
from pipeline.io.crs_given import UNITS_M, with_authority
from pipeline.options import Option, chosen_settings, served
from service.drafts import Draft, Inline
from service.errors import RequestError, within
from service.input_policy import checked_crs
from service.outputs.kinds import FORMATS
from service.outputs.published_forms import formats_of
from service.run_settings import DEFAULTS, VARIANTS, choices, settings_faults, settings_schema
from service.wire import patterns
from service.wire.base import OneOf, Request, at_most
from service.wire.faults import FaultsError, shortened
from service.wire.files import Lines, Outlines, PointClouds

MAX_METHODS = 8
"""Maximum number of methods of one comparison."""

GIVEN_BY = (
    "By reference (href): an upload of this service, a path below one of its input folders, or a URL at one of its "
    "allowed hosts. By value: base64, within the limit of a request's size."
)
FILES = ("tiles", "footprints", "guides")
"""Inputs that are files."""


def _printable(text: str) -> str:
    if not text.strip():
        raise ValueError("use a text")
    if any(unicodedata.category(sign) in {"Cs", "Cc"} for sign in text if sign not in "\t\r\n"):
        raise ValueError("use no control characters")
    return text


Text = Annotated[
    str, Field(max_length=500, json_schema_extra=patterns.stated(patterns.TEXT)), AfterValidator(_printable)
]
"""A text of the user."""


def _projected(text: str) -> str:
    try:
        horizontal_unit_of(checked_crs(text, path="crs"), path="crs")
    except CrsError as error:
        raise FaultsError([f"crs: {error.problem}. Give a projected CRS, such as EPSG:28992"]) from error
    return with_authority(text)


Crs = Annotated[str, Field(max_length=20_000), AfterValidator(_printable), AfterValidator(_projected)]
"""A projected CRS that PROJ understands; WKT is long."""


def _in_crs_of_tiles(given: Any, info: ValidationInfo) -> Any:
    """The four numbers of a rectangle that states its CRS."""
    if isinstance(given, list) and len(given) > 4:
        return _has_area(given)
    if not isinstance(given, Mapping):
        return given
    crs, of_tiles = given.get("crs"), info.data.get("crs")
    if crs is None or of_tiles is None or not _same_crs(str(crs), of_tiles):
        raise ValueError("the rectangle is read in the tiles' CRS: give the same crs here and as the input crs")
    return given.get("bbox")


def _same_crs(one: str, other: str) -> bool:
    try:
        return checked_crs(one, path="bbox") == checked_crs(other, path="crs")
    except CrsError:
        return False


def _has_area(box: list[float]) -> tuple[float, ...]:
    if len(box) != 4 or not (box[0] < box[2] and box[1] < box[3]):
        raise ValueError("use x_min, y_min, x_max, y_max with a positive width and depth")
    return tuple(map(float, box))


_FOUR_NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4}
Coordinate = Annotated[float, Field(gt=-LARGEST_COORDINATE, lt=LARGEST_COORDINATE, allow_inf_nan=False)]
Box = Annotated[
    list[Coordinate],
    AfterValidator(_has_area),
    BeforeValidator(_in_crs_of_tiles),
    WithJsonSchema(
        {
            "oneOf": [
                _FOUR_NUMBERS,
                {
                    "type": "object",
                    "format": "ogc-bbox",
                    "required": ["bbox", "crs"],
                    "properties": {"bbox": _FOUR_NUMBERS, "crs": {"type": "string"}},
                },
            ]
        }
    ),
]
"""A rectangle: x_min, y_min, x_max, y_max."""

RunSettings = Annotated[dict[str, Any], WithJsonSchema(settings_schema())]
"""Tables of settings."""

_LISTS = ("tiles", "methods")
"""Inputs that are missing if they are empty."""


def _unwrapped(name: str, value: Any) -> Any:
    if isinstance(value, list) and len(value) == 1 and name not in {"methods", "bbox", "publish"}:
        value = value[0]
    if isinstance(value, Mapping) and set(value) <= {"value", "mediaType"} and "value" in value:
        return value["value"]
    return value


def _completed(settings: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    """Settings with the general ones that are inputs of their own; raises all their faults and contradictions."""
    given = chosen_settings(info.data)
    faults = [
        f"{name} is {word} and settings.{name} is {shortened(settings[name])}: give one of them"
        for name, word in given.items()
        if settings.get(name, word) != word
    ]
    completed = settings | given
    faults += within("settings", settings_faults(completed))
    if faults:
        raise FaultsError(faults)
    return completed


class JobInputs(Request):
    """The inputs of all processes."""

    NOUN: ClassVar[str] = "an input"

    title: Text | None = Field(None, title="Title", description="Your own title for the job.")
    priority: int = Field(
        0,
        ge=-10,
        le=10,
        title="Priority",
        description="Higher runs first; more than 0 needs a key with the scope admin, if keys are used.",
    )

    @classmethod
    def prepared(cls, given: Any) -> Any:
        """Inputs without wrappings: a client may send each value in a list, or with its media type; null is absent."""
        if not isinstance(given, Mapping):
            return given
        plain = {name: value if name in FILES else _unwrapped(name, value) for name, value in given.items()}
        return {name: value for name, value in plain.items() if value is not None and (value or name not in _LISTS)}

    def draft(self, process_id: str, outputs: tuple[str, ...] | None) -> Draft:
        """The draft of a job; outputs are None for all."""
        values = {"process_id": process_id, "title": self.title, "outputs": outputs, **self.of_process()}
        return Draft(tiles=(), footprints=None, priority=self.priority, values=values)

    def of_process(self) -> dict[str, Any]:
        """Further fields of a `JobRequest` that this process has."""
        return {}


TYPES: Mapping[str, Any] = {
    "footprints_layer": Text,
    "crs": Crs,
    "vertical_unit": Annotated[str, OneOf(*UNITS_M)],
    "bbox": Box,
    "licence": Text,
}
"""Types of options that check more than their own type and words."""
_EXAMPLES: Mapping[str, Any] = {"crs": ["EPSG:28992"]}


def type_of(option: Option) -> Any:
    """The type of an option as an input."""
    choices = option.meta["choices"]
    return TYPES.get(option.name) or (Annotated[str, OneOf(*choices)] if choices else option.type)


Model = TypeVar("Model", bound=JobInputs)


def _with_options(process_id: str) -> Callable[[type[Model]], type[Model]]:
    """Add the options that a process takes, then the settings, which are checked with them."""

    def extended(model: type[Model]) -> type[Model]:
        fields: dict[str, Any] = {}
        for one in served(process_id):
            meta, kind = one.meta, type_of(one)
            # a setting that is absent comes from `settings` or is the default
            shown = {"default": getattr(DEFAULTS, one.name)} if one.is_setting else None
            words = {"title": meta["label"], "description": meta["doc"], "examples": _EXAMPLES.get(one.name)}
            described = Field(one.default, **words, json_schema_extra=shown)
            fields[one.input] = (kind if one.default is not None else kind | None, described)
        fields["settings"] = (
            RunSettings,
            Field(
                default_factory=dict,
                title="Settings",
                description="The settings that differ from the defaults, as the tables of a settings file.",
                validate_default=True,
            ),
        )
        return create_model(model.__name__, __base__=model, __doc__=model.__doc__, **fields)

    return extended


class EchoInputs(JobInputs):
    """The inputs of `echo`."""

    HINTS: ClassVar[Mapping[str, str]] = {"message": "give a text"}

    message: Annotated[str, Field(max_length=10_000), AfterValidator(_printable)] = Field(
        title="Message", description="The text to answer with."
    )
    delay: float = Field(
        0.0, ge=0.0, le=60.0, allow_inf_nan=False, title="Delay", description="Seconds that the job takes."
    )

    def of_process(self) -> dict[str, Any]:
        """Message and delay."""
        return {"echo": {"message": self.message, "delay": self.delay}}


class Inputs(JobInputs):
    """The inputs of processes that read tiles: files here, options and settings by `_with_options`."""

    HINTS: ClassVar[Mapping[str, str]] = {"tiles": "give one point cloud or more"}

    tiles: PointClouds = Field(title="Tiles", description=f"Point clouds. {GIVEN_BY}")
    footprints: Outlines | None = Field(
        None,
        title="Footprints",
        description="Building outlines to be modelled, as GeoJSON, GeoPackage, GeoParquet, FlatGeobuf, GML, KML or a "
        f"zip archive with one of them or a Shapefile. {GIVEN_BY}",
    )

    @field_validator("footprintsLayer", check_fields=False)
    @classmethod
    def _of_footprints(cls, layer: str | None, info: ValidationInfo) -> str | None:
        if layer is not None and info.data.get("footprints", layer) is None:
            raise ValueError("it is a layer of footprints, and none are given: give footprints, or leave it out")
        return layer

    @field_validator("settings", check_fields=False)
    @classmethod
    def _complete(cls, settings: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        return _completed(settings, info)

    def draft(self, process_id: str, outputs: tuple[str, ...] | None) -> Draft:
        """The draft of a job; outputs are None for all."""
        tiles = tuple(
            dataclasses.replace(tile, filename=tile.filename.replace("tiles", f"tiles-{n}", 1))
            if isinstance(tile, Inline) and len(self.tiles) > 1
            else tile
            for n, tile in enumerate(self.tiles)
        )
        given = dict(self)
        values = {one.name: given[one.input] for one in served(process_id) if not one.is_setting}
        values["settings"] = given["settings"]
        plain = super().draft(process_id, outputs)
        return dataclasses.replace(plain, tiles=tiles, footprints=self.footprints, values={**values, **plain.values})


class BuildingInputs(Inputs):
    """The inputs of the processes that model buildings."""

    guides: Lines | None = Field(
        None,
        title="Guides",
        description="Lines of roofs that models follow, such as ridges and eaves, as GeoJSON, GeoPackage or "
        f"GeoParquet; their column kind says what they are. {GIVEN_BY}",
    )

    def draft(self, process_id: str, outputs: tuple[str, ...] | None) -> Draft:
        """The draft of a job; outputs are None for all."""
        return dataclasses.replace(super().draft(process_id, outputs), guides=self.guides)


def _as_list(given: Any) -> Any:
    return given if isinstance(given, list) else [given]


def _makeable(formats: list[str]) -> list[str]:
    """Formats, each once; the service must have what they take."""
    if "solar" in formats and importlib.util.find_spec("pvlib") is None:
        raise FaultsError(["publish holds solar, which needs pvlib, and this service lacks it: leave solar out"])
    return list(dict.fromkeys(formats))


@_with_options("reconstruct")
class ReconstructInputs(BuildingInputs):
    """The inputs of `reconstruct`."""

    publish: Annotated[
        list[Annotated[str, OneOf(*FORMATS)]], BeforeValidator(_as_list), AfterValidator(_makeable), at_most(100)
    ] = Field(
        default_factory=list,
        title="Publish",
        description="Also deliver the models in these formats: 3D Tiles, GeoPackage, PMTiles, CityJSON files, a "
        "STAC catalogue, solar energy per roof plane, party walls. Naming one of their outputs does the same.",
        json_schema_extra={"uniqueItems": True},
    )
    geoidHeight: float | None = Field(
        None,
        ge=-200.0,
        le=200.0,
        allow_inf_nan=False,
        title="Height of the geoid",
        description="Metres of the geoid above the ellipsoid of WGS 84, added to the elevations of 3D Tiles. Default: "
        "by PROJ, if it has the grid, else nothing.",
    )

    def draft(self, process_id: str, outputs: tuple[str, ...] | None) -> Draft:
        """The draft of a job; outputs are None for all. A format is made if its output is named, and the reverse."""
        asked = {*self.publish, *formats_of(outputs or ())}
        if self.geoidHeight is not None and "3dtiles" not in asked:
            raise RequestError([f"geoidHeight is {self.geoidHeight:g}, which is for 3D Tiles: add 3dtiles to publish"])
        if outputs is not None:
            outputs = (*outputs, *(i for form in self.publish for i in FORMATS[form] if i not in outputs))
        plain = super().draft(process_id, outputs)
        values = {"publish": tuple(form for form in FORMATS if form in asked), "geoid_height": self.geoidHeight}
        return dataclasses.replace(plain, values={**plain.values, **values})


Variant = Annotated[str, OneOf(*VARIANTS)]
"""METHOD or METHOD:PRESET."""


def _distinct(words: list[str]) -> list[str]:
    """Methods without the default preset."""
    found = [word.removesuffix(f":{DEFAULTS.preset}") for word in words]
    twice = sorted({word for word in found if found.count(word) > 1})
    if twice:
        raise FaultsError([f"methods holds {', '.join(twice)} twice: give each once"])
    return found


@_with_options("compare")
class CompareInputs(BuildingInputs):
    """The inputs of `compare`."""

    HINTS: ClassVar[Mapping[str, str]] = {
        **BuildingInputs.HINTS,
        "methods": f"give 2 to {MAX_METHODS} of {', '.join(VARIANTS)}",
        "publish": "it is about the models of one method; submit reconstruct once per method",
        "points": "they show the distances to the models of one method; submit reconstruct with points once per method",
    }

    methods: Annotated[list[Variant], BeforeValidator(_as_list), AfterValidator(_distinct), at_most(100)] = Field(
        min_length=2,
        max_length=MAX_METHODS,
        title="Methods",
        description="The methods that run on the same candidates, each METHOD or METHOD:PRESET; the default preset is "
        "robust.",
        json_schema_extra={"uniqueItems": True},
    )

    @field_validator("settings", check_fields=False)
    @classmethod
    def _complete(cls, settings: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        faults = [
            f"settings.{name} is {shortened(settings[name])}: name the methods that are compared in methods"
            for name in ("method", "preset")
            if name in settings
        ]
        compared = {word.partition(":")[0] for word in info.data.get("methods", ())}
        faults += [
            f"settings has the table {name}, which is not compared: leave it out, or compare {name}"
            for name in choices("method")
            if name in settings and compared and name not in compared
        ]
        try:
            completed = _completed(settings, info)
        except FaultsError as error:
            faults += error.faults
        if faults:
            raise FaultsError(faults)
        return completed

    def of_process(self) -> dict[str, Any]:
        """The methods."""
        return {"methods": tuple(self.methods)}


@_with_options("classify")
class ClassifyInputs(Inputs):
    """The inputs of `classify`."""

    rasterCell: float | None = Field(
        None,
        gt=0.0,
        le=1000.0,
        allow_inf_nan=False,
        title="Cell of the rasters",
        description="Side of the rasters' cells in units of the tiles' CRS; default half a metre or two feet.",
    )

    def of_process(self) -> dict[str, Any]:
        """The cell."""
        return {"raster_cell": self.rasterCell}
