"""The methods by name: each a recipe from a candidate to its roof planes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from pipeline.errors import SettingsError
from pipeline.parameters import Parameters
from pipeline.quality.support_settings import SupportSettings
from pipeline.registry import loaded
from pipeline.roof.roof_settings import ArrangementSettings, GuideSettings, RoofSettings, RoofTypeSettings

if TYPE_CHECKING:
    from pipeline.model import PreparedCloud, Segmentation

MAIN_ROOF = "2.0"
LODS = ("1.2", "1.3", MAIN_ROOF, "2.2")
"""Levels of detail (Biljecki, Ledoux and Stoter 2016): one block, level parts, the main roof, all roof faces."""
OVERHANGS = "2.3"
"""The level of detail with overhangs, always beside 2.2: where there are none, or they cannot be drawn, it is empty."""
PRESETS = ("robust", "faithful")
"""Named settings: those that measured better, the default, which every method has, and those that keep to its paper."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A segmentation method, which loads when it is used."""

    name: str
    """As on the command line and in the records."""
    recipe: str
    """Its module and function, as "module:function"; see `segment`."""
    settings: str
    """Its settings class, as "module:class". The defaults are those that measured better."""
    follows_paper: bool = True
    """Whether its settings class has `faithful` ones, which keep to the paper's words; else it is a method of ours."""

    @property
    def settings_type(self) -> type[Parameters]:
        """Its settings class."""
        kind: type[Parameters] = loaded(self.settings)
        return kind

    def segment(self, cloud: PreparedCloud, settings: Parameters) -> Segmentation:
        """From a prepared cloud and an instance of `settings_type` to planes and labels."""
        found: Segmentation = loaded(self.recipe)(cloud, settings)
        return found

    @property
    def presets(self) -> tuple[str, ...]:
        """Names of the presets that it has."""
        return PRESETS if self.follows_paper else PRESETS[:1]

    def preset(self, name: str) -> Parameters:
        """The settings ``robust``, the defaults, or ``faithful``, the paper to the letter as far as it is printed.

        Raises
        ------
        SettingsError
            For another name, or where the method follows no paper.
        """
        if name not in PRESETS:
            raise SettingsError([f"preset is {name!r}: use one of {', '.join(PRESETS)}"])
        if name not in self.presets:
            raise SettingsError([f"preset is {name!r}, and {self.name} follows no paper: use {self.presets[0]}"])
        kind: Any = self.settings_type
        settings: Parameters = kind() if name == "robust" else kind.faithful()
        return settings


_PAPERS = "pipeline.extras.papers."
METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method(
            "arrangement",
            "pipeline.methods.arrangement:segment",
            "pipeline.segmentation.plane_settings:AdaptivePlaneSettings",
            follows_paper=False,
        ),
        Method("fuzzy-sart", f"{_PAPERS}fuzzy_sart:segment", f"{_PAPERS}paper_settings:FuzzySartSettings"),
        Method(
            "parameter-space-2d",
            f"{_PAPERS}parameter_space:segment_2d",
            f"{_PAPERS}paper_settings:ParameterSpace2dSettings",
        ),
        Method(
            "parameter-space-3d",
            f"{_PAPERS}parameter_space:segment_3d",
            f"{_PAPERS}paper_settings:ParameterSpace3dSettings",
        ),
        Method("kmeans", f"{_PAPERS}kmeans:segment", f"{_PAPERS}paper_settings:KMeansSettings"),
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
        """Overhangs take LoD2.2 and the walls beneath the eaves; raises SettingsError if no walls are looked for.

        So it does where boxes are asked for, but no level of detail has them.
        """
        faults = []
        if self.roof.superstructures and not {LODS[-1], OVERHANGS} & set(self.lods):
            faults.append(f"superstructures is true, and lods has no {LODS[-1]}, which shows them: add it")
        if OVERHANGS in self.lods:
            faults += [
                f"lods has {OVERHANGS}, and {name} is {value}: use {wanted}, or leave {OVERHANGS} out"
                for name, value, wanted in (
                    ("outline", repr(self.roof.outline), "'eaves'"),
                    ("straight_eaves", str(self.roof.straight_eaves).lower(), "true"),
                )
                if str(value).strip("'") != wanted.strip("'")
            ]
        if faults:
            raise SettingsError(faults)
        if OVERHANGS in self.lods:
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
        >>> [ReconstructSettings(method=kmeans.preset(name)).arranges(kmeans) for name in PRESETS]
        [True, False]
        """
        return getattr(self._of(method), "faces", "arranged") == "arranged"

    def _of(self, method: Method) -> Parameters:
        """The settings of a method, its defaults where there are none."""
        settings = method.settings_type() if self.method is None else self.method
        if not isinstance(settings, method.settings_type):
            wanted, got = method.settings_type.__name__, type(settings).__name__
            raise SettingsError([f"the settings of {method.name} are {got}: use {wanted}"])
        return settings
