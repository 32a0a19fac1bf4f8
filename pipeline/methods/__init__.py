"""The methods by name: each a recipe from a candidate to its roof planes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from pipeline.errors import SettingsError
from pipeline.methods.roof_faces import RoofFaceSettings
from pipeline.model import Candidate, Segmentation
from pipeline.parameters import Parameters
from pipeline.roof.settings import ArrangementSettings, RoofSettings, RoofTypeSettings

LODS = ("1.2", "1.3", "2.2")
"""Levels of detail (Biljecki, Ledoux and Stoter 2016): one block, level parts, the roof faces themselves."""
PRESETS = ("robust", "faithful")
"""Named settings: those that measured better, the default, which every method has, and those that keep to its paper."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """A segmentation method."""

    name: str
    """As on the command line and in the records."""
    settings_type: type[Parameters]
    """Its settings class."""
    segment: Callable[[Candidate, Any], Segmentation]
    """From a candidate and an instance of `settings_type` to planes and labels."""
    faithful: Parameters | None = None
    """The settings that keep to the paper's words, None for a method of our own; the defaults of `settings_type` are
    those that measured better."""

    @property
    def presets(self) -> tuple[str, ...]:
        """Names of the presets that it has."""
        return PRESETS[: 1 if self.faithful is None else 2]

    def preset(self, name: str) -> Parameters:
        """The settings of a named preset.

        Parameters
        ----------
        name : str
            ``robust``, the defaults, or ``faithful``, the paper to the letter as far as it is printed.

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


def _arrangement() -> Method:
    from pipeline.methods import arrangement
    from pipeline.segmentation.adaptive_planes import AdaptivePlaneSettings

    return Method(
        name="arrangement",
        settings_type=AdaptivePlaneSettings,
        segment=arrangement.segment,
    )


def _fuzzy_sart() -> Method:
    from pipeline.methods import fuzzy_sart

    return Method(
        name="fuzzy-sart",
        settings_type=fuzzy_sart.FuzzySartSettings,
        segment=fuzzy_sart.segment,
        faithful=fuzzy_sart.FuzzySartSettings.faithful(),
    )


def _parameter_space_2d() -> Method:
    from pipeline.methods import parameter_space

    return Method(
        name="parameter-space-2d",
        settings_type=parameter_space.ParameterSpace2dSettings,
        segment=parameter_space.segment_2d,
        faithful=parameter_space.ParameterSpace2dSettings.faithful(),
    )


def _parameter_space_3d() -> Method:
    from pipeline.methods import parameter_space

    return Method(
        name="parameter-space-3d",
        settings_type=parameter_space.ParameterSpace3dSettings,
        segment=parameter_space.segment_3d,
        faithful=parameter_space.ParameterSpace3dSettings.faithful(),
    )


def _kmeans() -> Method:
    from pipeline.methods import kmeans

    return Method(
        name="kmeans",
        settings_type=kmeans.KMeansSettings,
        segment=kmeans.segment,
        faithful=kmeans.KMeansSettings.faithful(),
    )


class _Table(Mapping[str, Method]):
    """Methods by name, each imported when it is first asked for: a run needs one, and start-up counts."""

    def __init__(self, entries: Mapping[str, Callable[[], Method]]) -> None:
        self._entries = {name: functools.cache(entry) for name, entry in entries.items()}

    def __getitem__(self, name: str) -> Method:
        return self._entries[name]()

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


METHODS: Mapping[str, Method] = _Table(
    {
        "arrangement": _arrangement,
        "fuzzy-sart": _fuzzy_sart,
        "parameter-space-2d": _parameter_space_2d,
        "parameter-space-3d": _parameter_space_3d,
        "kmeans": _kmeans,
    }
)
"""All methods by name."""


def method_named(name: str) -> Method:
    """The method of a name.

    Parameters
    ----------
    name : str
        One of `METHODS`.

    Returns
    -------
    Method
        Its entry.

    Raises
    ------
    SettingsError
        Naming all methods.

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
    """What modelling one building needs: settings of the method, of the roof and of the roof type."""

    method: Parameters | None = None
    """An instance of the method's settings class; None for its defaults."""
    roof: RoofSettings = dataclasses.field(default_factory=RoofSettings)
    """From planes to solids."""
    plan: ArrangementSettings = dataclasses.field(default_factory=ArrangementSettings)
    """Costs of roof faces, where they are arranged."""
    roof_type: RoofTypeSettings = dataclasses.field(default_factory=RoofTypeSettings)
    """Thresholds of the roof types."""
    lods: tuple[str, ...] = LODS[-1:]
    """Levels of detail to be modelled, of `LODS` and in their order."""

    def segmentation(self, method: Method) -> Callable[[Candidate], Segmentation]:
        """The method with its settings bound.

        Raises
        ------
        SettingsError
            Where the settings belong to another method.
        """
        settings = self._of(method)
        return lambda candidate: method.segment(candidate, settings)

    def arranges(self, method: Method) -> bool:
        """Whether the plan is cut into roof faces along the lines in which planes meet.

        It is for every method but those that are told to trace them from the labels (`RoofFaceSettings.faces`).

        Raises
        ------
        SettingsError
            Where the settings belong to another method.

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
