"""All settings of a run: the settings classes of the chapters, composed and hashed; nothing here imports a kernel."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pipeline.errors import SettingsError
from pipeline.methods import METHODS, ReconstructSettings, method_named
from pipeline.options import ChosenSettings
from pipeline.parameters import Parameters, build, parameter, read_toml
from pipeline.quality.support_settings import SupportSettings
from pipeline.roof.roof_settings import (
    ArrangementSettings,
    FootprintSettings,
    GuideSettings,
    RoofSettings,
    RoofTypeSettings,
)
from pipeline.terrain.terrain_settings import (
    CandidateSettings,
    ClassCodeSettings,
    GroundSettings,
    OutlierSettings,
    SceneSettings,
    StripSettings,
    SurfaceSettings,
    UnitSettings,
    VegetationSettings,
)


class GeneralSettings(ChosenSettings):
    """Settings of the run as a whole."""

    terrain_tolerance_m: float = parameter(
        0.1,
        "How far the triangles of the terrain may be above or below the middle of a cell of the ground.",
        unit="m",
        minimum=0.01,
        maximum=10.0,
        changes_geometry=False,
    )
    tile_size_m: float = parameter(
        0.0,
        "Side of the tiles; 0 chooses it from the density. Results do not depend on it.",
        unit="m",
        minimum=0.0,
        maximum=2000.0,
        changes_geometry=False,
    )
    halo_m: float = parameter(
        0.0,
        "Width of the ring of points around a tile that it also sees; 0 is the least that the settings need.",
        unit="m",
        minimum=0.0,
        maximum=1000.0,
        changes_geometry=False,
    )
    lattice_x_m: float = parameter(
        0.0, "Easting of the lattice's origin, to test that tiles do not matter.", unit="m", changes_geometry=False
    )
    lattice_y_m: float = parameter(0.0, "Northing of the lattice's origin.", unit="m", changes_geometry=False)


SECTIONS: Mapping[str, type[Parameters]] = {
    "class-codes": ClassCodeSettings,
    "footprints": FootprintSettings,
    "strips": StripSettings,
    "outliers": OutlierSettings,
    "ground": GroundSettings,
    "vegetation": VegetationSettings,
    "surfaces": SurfaceSettings,
    "candidates": CandidateSettings,
    "units": UnitSettings,
    "roof": RoofSettings,
    "plan": ArrangementSettings,
    "roof-type": RoofTypeSettings,
    "guides": GuideSettings,
    "support": SupportSettings,
}
"""Tables of the settings file that every method shares; each method adds one of its own name."""
_OPTIONAL = frozenset({"footprints", "guides"})
"""Tables that count in the settings hash only if they differ from the defaults, with which they do nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Everything that can be set, for one method."""

    general: GeneralSettings = dataclasses.field(default_factory=GeneralSettings)
    """The run as a whole."""
    class_codes: ClassCodeSettings = dataclasses.field(default_factory=ClassCodeSettings)
    """Meaning of the class codes in the file."""
    footprints: FootprintSettings = dataclasses.field(default_factory=FootprintSettings)
    """Heights among the attributes of given footprints."""
    scene: SceneSettings = dataclasses.field(default_factory=SceneSettings)
    """From a tile's points to candidates."""
    building: ReconstructSettings = dataclasses.field(default_factory=ReconstructSettings)
    """From a candidate to its model; `building.method` is never None here."""

    def __post_init__(self) -> None:
        """Fill in the method's defaults and the levels of detail; refuse a halo that is too narrow."""
        entry = method_named(self.general.method)
        start = entry.preset(self.general.preset)
        if self.building.method is None:
            building = dataclasses.replace(self.building, method=start)
            object.__setattr__(self, "building", building)
        lods = tuple(self.general.lods.split(","))
        if self.building.lods != lods:
            object.__setattr__(self, "building", dataclasses.replace(self.building, lods=lods))
        support = self.scene.support_m
        if 0.0 < self.general.halo_m < support:
            raise SettingsError(
                [f"halo_m is {self.general.halo_m:g}: use at least {support:g} m, or 0 for exactly that"]
            )

    @property
    def halo_m(self) -> float:
        """The halo in metres: as set, or the support of all stages."""
        return self.general.halo_m or self.scene.support_m

    def sections(self) -> dict[str, Parameters]:
        """Every settings object by the name of its table; `general` is the top level of the file."""
        method = self.building.method
        if method is None:
            raise AssertionError("filled in at construction")
        owned = {**vars(self), **vars(self.scene), **vars(self.building)}
        found = {name: owned[_field_of(name)] for name in SECTIONS}
        return {"general": self.general, **found, self.general.method: method}

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """All values by section and name."""
        return {name: dataclasses.asdict(section) for name, section in self.sections().items()}

    @property
    def settings_hash(self) -> str:
        """sha256 of the canonical JSON of all values that can change geometry, for the chosen method."""
        content = {
            name: {
                field.name: getattr(section, field.name)
                for field in dataclasses.fields(section)
                if field.metadata.get("changes_geometry", True)
                and not (field.metadata.get("added") and getattr(section, field.name) == field.default)
            }
            for name, section in self.sections().items()
            if name not in _OPTIONAL or section != type(section)()
        }
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @classmethod
    def from_mapping(cls, table: Mapping[str, Any]) -> RunSettings:
        """Settings from the `[settings]` table of a file.

        General settings are at its top level, and there is one table per section: `SECTIONS` and those named after a
        method. Raises SettingsError with all faults at once: unknown names, wrong types, values out of range.
        """
        faults: list[str] = []
        general_values = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
        general = build(GeneralSettings, "", general_values, faults)
        method_name = general_values.get("method", GeneralSettings().method)
        built: dict[str, Any] = {}
        for name, values in table.items():
            if not isinstance(values, Mapping):
                continue
            if name not in SECTIONS and name not in METHODS:
                faults.append(f"[{name}] is not a table of settings: use one of {', '.join((*SECTIONS, *METHODS))}")
            else:
                kind = SECTIONS[name] if name in SECTIONS else METHODS[name].settings_type
                built[name] = build(kind, name, values, faults, _base(name, general))
        if faults:
            raise SettingsError(faults)

        def given(kind: Any) -> dict[str, Any]:
            """The sections of a class that the file has, by the names of their fields."""
            names = {field.name for field in dataclasses.fields(kind)}
            return {_field_of(name): built[name] for name in SECTIONS if name in built and _field_of(name) in names}

        return cls(
            general=general or GeneralSettings(),
            scene=SceneSettings(**given(SceneSettings)),
            building=ReconstructSettings(method=built.get(method_name), **given(ReconstructSettings)),
            **given(cls),
        )

    @classmethod
    def from_toml(cls, path: str | None, overrides: Mapping[str, Any]) -> RunSettings:
        """Settings of a TOML file, or the defaults, under overrides of its top level: `{"method": "fuzzy-sart"}`.

        Raises SettingsError if the file cannot be read or parsed, or holds faults.
        """
        table = read_table(path)
        table.update(overrides)
        return cls.from_mapping(table)


def _field_of(section: str) -> str:
    """The field of a section, of `RunSettings`, `SceneSettings` or `ReconstructSettings`."""
    return section.replace("-", "_")


def _base(name: str, general: GeneralSettings | None) -> Parameters | None:
    """Defaults of the settings of a method, None for other tables; `RunSettings` refuses a preset it does not have."""
    if general is None or name not in METHODS or general.preset not in METHODS[name].presets:
        return None
    return METHODS[name].preset(general.preset)


def read_table(path: str | None) -> dict[str, Any]:
    """The `[settings]` table of a TOML file, as it stands there; empty for None.

    Raises SettingsError if the file cannot be read or parsed, or has no such table.
    """
    if path is None:
        return {}
    document = read_toml(path, "settings file")
    if not isinstance(document.get("settings", {}), Mapping):
        raise SettingsError([f"settings file {path} has settings that are not a table: write [settings]"])
    table = dict(document.get("settings", {}))
    if not table and document:
        raise SettingsError([f"settings file {path} has no [settings] table; it has {', '.join(document)}"])
    return table
