"""The methods by name: each a recipe from a candidate to its roof planes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from pipeline.errors import SettingsError
from pipeline.methods.settings import (
    FuzzySartSettings,
    KMeansSettings,
    ParameterSpace2dSettings,
    ParameterSpace3dSettings,
    RoofFaceSettings,
)
from pipeline.parameters import Parameters
from pipeline.quality.settings import SupportSettings
from pipeline.roof.settings import ArrangementSettings, GuideSettings, RoofSettings, RoofTypeSettings
from pipeline.segmentation.plane_settings import AdaptivePlaneSettings

if TYPE_CHECKING:
    from pipeline.model import PreparedCloud, Segmentation

LODS = ("1.2", "1.3", "2.2")
"""Levels of detail (Biljecki, Ledoux and Stoter 2016): one block, level parts, the roof faces themselves."""
OVERHANGS = "2.3"
"""The level of detail with overhangs, always beside 2.2: where there are none, or they cannot be drawn, it is empty."""
PRESETS = ("robust", "faithful")
"""Named settings: those that measured better, the default, which every method has, and those that keep to its paper."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A segmentation method."""

    name: str
    """As on the command line and in the records."""
    settings_type: type[Parameters]
    """Its settings class."""
    segment: Callable[[PreparedCloud, Any], Segmentation]
    """From a prepared cloud and an instance of `settings_type` to planes and labels."""
    faithful: Parameters | None = None
    """The settings that keep to the paper's words, None for a method of our own; the defaults of `settings_type` are
    those that measured better."""

    @property
    def presets(self) -> tuple[str, ...]:
        """Names of the presets that it has."""
        return PRESETS[: 1 if self.faithful is None else 2]

    def preset(self, name: str) -> Parameters:
        """The settings ``robust``, the defaults, or ``faithful``, the paper to the letter as far as it is printed.

        Raises
        ------
        SettingsError
            For another name, or where the method follows no paper.
        """
        if name not in PRESETS:
            raise SettingsError([f"preset is {name!r}: use one of {', '.join(PRESETS)}"])
        if name == "robust":
            return self.settings_type()
        if self.faithful is None:
            raise SettingsError([f"preset is {name!r}, and {self.name} follows no paper: use {self.presets[0]}"])
        return self.faithful


def _arrangement(cloud: PreparedCloud, settings: AdaptivePlaneSettings) -> Segmentation:
    from pipeline.methods import arrangement

    return arrangement.segment(cloud, settings)


def _fuzzy_sart(cloud: PreparedCloud, settings: FuzzySartSettings) -> Segmentation:
    from pipeline.methods import fuzzy_sart

    return fuzzy_sart.segment(cloud, settings)


def _parameter_space_2d(cloud: PreparedCloud, settings: ParameterSpace2dSettings) -> Segmentation:
    from pipeline.methods import parameter_space

    return parameter_space.segment_2d(cloud, settings)


def _parameter_space_3d(cloud: PreparedCloud, settings: ParameterSpace3dSettings) -> Segmentation:
    from pipeline.methods import parameter_space

    return parameter_space.segment_3d(cloud, settings)


def _kmeans(cloud: PreparedCloud, settings: KMeansSettings) -> Segmentation:
    from pipeline.methods import kmeans

    return kmeans.segment(cloud, settings)


METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method("arrangement", AdaptivePlaneSettings, _arrangement),
        Method("fuzzy-sart", FuzzySartSettings, _fuzzy_sart, FuzzySartSettings.faithful()),
        Method(
            "parameter-space-2d", ParameterSpace2dSettings, _parameter_space_2d, ParameterSpace2dSettings.faithful()
        ),
        Method(
            "parameter-space-3d", ParameterSpace3dSettings, _parameter_space_3d, ParameterSpace3dSettings.faithful()
        ),
        Method("kmeans", KMeansSettings, _kmeans, KMeansSettings.faithful()),
    )
}
"""All methods by name. A recipe and its kernels load when a building is first segmented by it."""


def method_named(name: str) -> Method:
    """The method of a name, one of `METHODS`; raises SettingsError, naming all methods, for another one.

    Examples
    --------
    >>> method_named("fuzzy-sart").settings_type.__name__
    'FuzzySartSettings'
    """
    if name not in METHODS:
        raise SettingsError([f"method is {name!r}: use one of {', '.join(sorted(METHODS))}"])
    return METHODS[name]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructSettings:
    """Settings for modelling one building: of the method, of the roof and of the roof type."""

    method: Parameters | None = None
    """An instance of the method's settings class; None for its defaults."""
    roof: RoofSettings = dataclasses.field(default_factory=RoofSettings)
    """From planes to solids."""
    plan: ArrangementSettings = dataclasses.field(default_factory=ArrangementSettings)
    """Costs of roof faces, where they are arranged."""
    roof_type: RoofTypeSettings = dataclasses.field(default_factory=RoofTypeSettings)
    """Thresholds of the roof types."""
    guides: GuideSettings = dataclasses.field(default_factory=GuideSettings)
    """Given lines of the roof."""
    support: SupportSettings = dataclasses.field(default_factory=SupportSettings)
    """From which figures on a model is doubtful."""
    lods: tuple[str, ...] = LODS[-1:]
    """Levels of detail to be modelled, of `LODS` and in their order, then `OVERHANGS` if it is asked for."""

    def __post_init__(self) -> None:
        """Overhangs take LoD2.2 and the walls beneath the eaves; raises SettingsError if no walls are looked for."""
        if OVERHANGS not in self.lods:
            return
        faults = [
            f"lods has {OVERHANGS}, and {name} is {value}: use {wanted}, or leave {OVERHANGS} out"
            for name, value, wanted in (
                ("outline", repr(self.roof.outline), "'eaves'"),
                ("straight_eaves", str(self.roof.straight_eaves).lower(), "true"),
            )
            if str(value).strip("'") != wanted.strip("'")
        ]
        if faults:
            raise SettingsError(faults)
        object.__setattr__(self, "lods", (*sorted({*self.lods, LODS[-1]} - {OVERHANGS}), OVERHANGS))
        object.__setattr__(self, "roof", dataclasses.replace(self.roof, wall_outline=True))

    @property
    def record_lods(self) -> tuple[str, ...]:
        """The levels of which the finest is that of the record."""
        return tuple(lod for lod in self.lods if lod != OVERHANGS)

    @property
    def further_lods(self) -> tuple[str, ...]:
        """The levels beside that of the record."""
        return tuple(lod for lod in self.lods if lod != self.record_lods[-1])

    def segmentation(self, method: Method) -> Callable[[PreparedCloud], Segmentation]:
        """The method with its settings bound; raises SettingsError where the settings belong to another method."""
        settings = self._of(method)
        return lambda cloud: method.segment(cloud, settings)

    def arranges(self, method: Method) -> bool:
        """Whether the plan is cut into roof faces along the lines in which planes meet.

        True unless the settings say to trace them from the labels (`RoofFaceSettings.faces`). Raises SettingsError
        where the settings belong to another method.

        Examples
        --------
        >>> kmeans = method_named("kmeans")
        >>> ReconstructSettings().arranges(kmeans), ReconstructSettings(method=kmeans.faithful).arranges(kmeans)
        (True, False)
        """
        settings = self._of(method)
        return not isinstance(settings, RoofFaceSettings) or settings.faces == "arranged"

    def _of(self, method: Method) -> Parameters:
        """The settings of a method, its defaults where there are none."""
        settings = method.settings_type() if self.method is None else self.method
        if not isinstance(settings, method.settings_type):
            wanted, got = method.settings_type.__name__, type(settings).__name__
            raise SettingsError([f"the settings of {method.name} are {got}: use {wanted}"])
        return settings
