"""The options of a run, each described once: name, type, default, unit, range, meaning, and who takes it.

Made from these classes: the options of commands (`cli/command_options.py`), the keys of the batch file, the inputs of
the service's processes and of its form, the options of its client, the fields of its page, and their names in messages.
A new option is a field of one of the classes, and the place that reads it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import re
import typing
from collections.abc import Mapping
from typing import Any, ClassVar

from pipeline.methods import LODS, METHODS, OVERHANGS, PRESETS
from pipeline.parameters import Parameters, parameter

AUTO = "auto"
"""The word for as many workers as the job needs and the machine has."""
MESHES = ("building", "tile", "glb", "none")
"""Meshes that a run can write: one OBJ per building, one OBJ per tile, one GLB per tile, none."""

_MODELS = ("reconstruct", "compare")
_TILES = (*_MODELS, "classify")
_RUNS = (*_TILES, "rerun")
_CLUSTERS = (*_RUNS, "serve", "driver")


def option(
    doc: str,
    default: Any = None,
    *,
    metavar: str = "",
    label: str = "",
    takers: tuple[str, ...] = (),
    table: str | None = None,
    flag: str = "",
    **limits: Any,
) -> Any:
    """Describe one option.

    Parameters
    ----------
    doc : str
        One sentence.
    default : bool, int, float, str, tuple or None
        The default; None if the option need not be given.
    metavar : str
        Stands for its value in the help. FILE and DIR are paths, which a batch file states relative to itself.
    label : str
        Its label on the page; empty if the service does not offer it.
    takers : tuple of str
        The commands that take it, and the processes of the same names if it has a label; by default those of its class.
    table : str, optional
        Its table in a batch file, empty if it is not there; by default that of its class.
    flag : str
        On the command line; by default its name with dashes.
    **limits
        As for `pipeline.parameters.parameter`: unit, minimum, maximum, choices, and others of settings.
    """
    further = {"metavar": metavar, "label": label, "takers": takers, "table": table, "flag": flag}
    return dataclasses.field(default=default, metadata={**parameter(default, doc, **limits).metadata, **further})


class ChosenSettings(Parameters):
    """General settings that are options, too. As options they have no default: they override a settings file."""

    TAKERS: ClassVar[tuple[str, ...]] = ("reconstruct",)
    TABLE: ClassVar[str] = ""

    method: str = option(
        "The method that models the buildings.",
        "arrangement",
        choices=tuple(METHODS),
        metavar="METHOD",
        label="Method",
    )
    preset: str = option(
        "Defaults of the method's settings: the ones that measured better, or the paper's.",
        "robust",
        choices=PRESETS,
        changes_geometry=False,
        label="Preset",
    )
    lods: str = option(
        f"Levels of detail of the models: {', '.join((*LODS, OVERHANGS))}, or several with commas; records describe "
        "the finest up to 2.2, which 2.3 brings with it.",
        LODS[-1],
        choices=tuple(
            ",".join(chosen)
            for n in range(1, len(LODS) + 2)
            for chosen in itertools.combinations((*LODS, OVERHANGS), n)
        ),
        metavar="L1,L2,…",
        label="Levels of detail",
    )
    classes: str = option(
        "Use of the classes in the file: trusted, only compared with the result, or ignored.",
        "trust",
        choices=("trust", "audit", "ignore"),
        label="Classes of the file",
        takers=_TILES,
    )
    terrain: str = option(
        "Terrain that is written beside the buildings: none, or triangles with their outlines cut out.",
        "none",
        choices=("none", "tin"),
        changes_geometry=False,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputFiles:
    """Files beside the tiles."""

    TAKERS: ClassVar[tuple[str, ...]] = _MODELS
    TABLE: ClassVar[str] = "inputs"

    footprints: str | None = option(
        "Building outlines to model: GeoPackage, GeoJSON, Shapefile and others; docs/reference/formats.md.",
        metavar="FILE",
        label="Footprints",
        takers=_TILES,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelFiles(InputFiles):
    """Files beside the tiles, where buildings are modelled."""

    guides: str | None = option(
        "Lines of roofs (ridges, eaves, ...) that models follow; docs/how_to/guides.md.", metavar="FILE", label="Guides"
    )
    overrides: str | None = option(
        "Corrections of single buildings, as TOML; docs/how_to/overrides.md.", metavar="FILE", takers=("reconstruct",)
    )
    aoi: str | None = option("Only the area inside the polygons of this vector file.", metavar="FILE")


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputOptions:
    """How tiles are read."""

    TAKERS: ClassVar[tuple[str, ...]] = _TILES
    TABLE: ClassVar[str] = "inputs"

    footprints_layer: str | None = option(
        "Layer of the footprints, where their file has several.",
        flag="--layer",
        metavar="NAME",
        label="Layer of the footprints",
        takers=(*_TILES, "evaluate"),
    )
    crs: str | None = option(
        "CRS of the tiles, if their header has none or a wrong one: EPSG code or WKT.",
        metavar="EPSG:n",
        label="CRS",
        takers=(*_TILES, "inspect", "evaluate"),
    )
    vertical_unit: str | None = option(
        "Unit of elevations, if the header has none or a wrong one: m, ft or us-ft.",
        metavar="UNIT",
        label="Vertical unit",
        takers=(*_TILES, "inspect", "evaluate"),
    )
    allow_outside_area_of_use: bool = option(
        "Accept tiles that lie far outside the area of use of their CRS, which mostly means a wrong CRS.",
        False,
        label="Use the tiles where they lie",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelOptions(InputOptions):
    """How buildings are modelled and written."""

    TAKERS: ClassVar[tuple[str, ...]] = _MODELS

    bbox: tuple[float, float, float, float] | None = option(
        "Only this rectangle: x_min, y_min, x_max, y_max in the tiles' CRS and its units.",
        metavar="XMIN YMIN XMAX YMAX",
        label="Rectangle",
    )
    licence: str | None = option(
        "Licence of the source data, written into the results.", metavar="TEXT", label="Licence"
    )
    meshes: str = option(
        "One OBJ file per building (building) or per tile (tile), one GLB file per tile (glb), or none.",
        "building",
        choices=MESHES,
        table="output",
        label="Meshes",
    )
    points: bool = option(
        "Also write the points as 3D Tiles, with their classes and their distances to the models.",
        False,
        table="output",
        label="Keep the points",
        takers=("reconstruct",),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResourceOptions:
    """What a run runs with (`pipeline.runtime.resources`)."""

    TAKERS: ClassVar[tuple[str, ...]] = (*_MODELS, "rerun", "replay")
    TABLE: ClassVar[str] = "cluster"

    workers: int | None = option(
        "Processes of the embedded cluster; 0 runs serially in this process, auto starts one for large jobs only.",
        metavar=f"N|{AUTO}",
        minimum=0,
        maximum=1024,
        takers=(*_RUNS, "demo"),
    )
    scheduler: str | None = option(
        "A Dask scheduler to use in place of the embedded cluster; not together with workers.",
        metavar="ADDRESS",
        takers=_CLUSTERS,
    )
    tls_ca: str | None = option(
        "CA of the cluster's certificates, PEM; default GABLEWORK_TLS_CA.",
        metavar="FILE",
        takers=(*_CLUSTERS, "worker"),
    )
    tls_cert: str | None = option(
        "This process's certificate for the cluster; default GABLEWORK_TLS_CERT.",
        metavar="FILE",
        takers=(*_CLUSTERS, "worker"),
    )
    tls_key: str | None = option(
        "Its key, unless in the same file; default GABLEWORK_TLS_KEY.", metavar="FILE", takers=(*_CLUSTERS, "worker")
    )
    scratch: str | None = option(
        "Folder for intermediate results, the same for all workers; default beside the results.",
        metavar="DIR",
        table="",
        takers=("reconstruct",),
    )
    performance_report: str | None = option(
        "Write a page (HTML) about the workers' time.", metavar="FILE", takers=("reconstruct",)
    )
    isolate: bool | None = option("Model buildings in a supervised child process, so a bad one harms no other.")
    input_timeout_s: float = option(
        "Seconds within which some more of an input must be read.",
        600.0,
        flag="--input-timeout",
        metavar="S",
        unit="s",
        minimum=1.0,
        maximum=86_400.0,
        takers=_RUNS,
    )
    building_timeout_s: float = option(
        "Seconds that a building may take in its child process.",
        600.0,
        flag="--building-timeout",
        metavar="S",
        unit="s",
        minimum=1.0,
        maximum=86_400.0,
    )
    building_memory_gib: float = option(
        "Memory that a building's child process may take, in GiB.",
        4.0,
        flag="--building-memory",
        metavar="GIB",
        unit="GiB",
        minimum=0.5,
        maximum=4096.0,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Option:
    """One option, as `option` describes it."""

    name: str
    """The name of its field."""
    type: Any
    """The type of its value, without None."""
    default: Any
    """None if it need not be given; so for all settings."""
    is_setting: bool
    """Whether it overrides a setting of the run."""
    meta: Mapping[str, Any]
    """What `option` took."""

    @property
    def flag(self) -> str:
        """On the command line."""
        return self.meta["flag"] or f"--{self.name.replace('_', '-')}"

    @property
    def input(self) -> str:
        """In a request to the service.

        >>> option_named("vertical_unit").input
        'verticalUnit'
        """
        return re.sub("_(.)", lambda found: found[1].upper(), self.name)

    @property
    def is_path(self) -> bool:
        """Whether it names a file or a folder."""
        return self.meta["metavar"] in {"FILE", "DIR"}


@functools.cache
def options_of(*kinds: Any) -> tuple[Option, ...]:
    """The options of classes, in their order."""
    return tuple(
        _row(kind, field) for kind in kinds for field in dataclasses.fields(kind) if "takers" in field.metadata
    )


def _row(kind: Any, field: dataclasses.Field[Any]) -> Option:
    """An option from its field; takers and table that it does not state are those of the class that has the field."""
    owner = next(one for one in reversed(kind.__mro__) if field.name in vars(one).get("__annotations__", {}))
    meta, words = dict(field.metadata), typing.get_type_hints(owner)[field.name]
    meta["takers"] = meta["takers"] or owner.TAKERS
    meta["table"] = owner.TABLE if meta["table"] is None else meta["table"]
    is_setting = issubclass(kind, ChosenSettings)
    given = [one for one in typing.get_args(words) if one is not type(None)]
    return Option(
        name=field.name,
        type=given[0] if len(given) == 1 else words,
        default=None if is_setting else field.default,
        is_setting=is_setting,
        meta=meta,
    )


def all_options() -> tuple[Option, ...]:
    """All of them."""
    return options_of(ModelFiles, ModelOptions, ChosenSettings, ResourceOptions)


def option_named(name: str) -> Option:
    """The option of a name."""
    return next(one for one in all_options() if one.name == name)


def served(process: str | None = None, *, files: bool = False) -> list[Option]:
    """The options that a process of the service takes, or any; files are inputs of another kind there."""
    return [
        one
        for one in all_options()
        if one.meta["label"] and (process is None or process in one.meta["takers"]) and (files or not one.is_path)
    ]


def values_of(kind: Any, source: Any) -> dict[str, Any]:
    """The options of a class, of an object or a mapping that has them all or some."""
    given = source if isinstance(source, Mapping) else vars(source)
    return {one.name: given[one.name] for one in options_of(kind) if one.name in given}


def chosen_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that are given as options."""
    return {name: value for name, value in values_of(ChosenSettings, given).items() if value is not None}
