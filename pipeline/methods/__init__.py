"""The methods by name: each a recipe from a candidate to its roof planes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from pipeline.errors import SettingsError
from pipeline.methods import arrangement, fuzzy_sart, kmeans, parameter_space
from pipeline.model import Candidate, Segmentation
from pipeline.parameters import Parameters
from pipeline.roof.arrangement import ArrangementSettings
from pipeline.roof.roof_type import RoofTypeSettings
from pipeline.roof.settings import RoofSettings
from pipeline.segmentation.adaptive_planes import AdaptivePlaneSettings

PRESETS = ("robust", "faithful")
"""Named settings that every method has: those that measured better, the default, and those that keep to the paper."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """A segmentation method."""

    name: str
    """As on the command line and in the records."""
    settings_type: type[Parameters]
    """Its settings class."""
    segment: Callable[[Candidate, Any], Segmentation]
    """From a candidate and an instance of `settings_type` to planes and labels."""
    faithful: Parameters
    """The settings that keep to the paper's words; the defaults of `settings_type` are those that measured better."""
    arranged: bool = False
    """Whether its roof faces are cells of an arrangement of lines; else they are traced from the labels."""

    def preset(self, name: str) -> Parameters:
        """The settings of a named preset.

        Parameters
        ----------
        name : str
            ``robust``, the defaults, or ``faithful``, the paper to the letter as far as it is printed.

        Raises
        ------
        SettingsError
            For another name.
        """
        if name not in PRESETS:
            raise SettingsError([f"preset is {name!r}: use one of {', '.join(PRESETS)}"])
        return self.faithful if name == "faithful" else self.settings_type()


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        method.name: method
        for method in (
            Method(
                name="arrangement",
                settings_type=AdaptivePlaneSettings,
                segment=arrangement.segment,
                faithful=AdaptivePlaneSettings(),
                arranged=True,
            ),
            Method(
                name="fuzzy-sart",
                settings_type=fuzzy_sart.FuzzySartSettings,
                segment=fuzzy_sart.segment,
                faithful=fuzzy_sart.FuzzySartSettings.faithful(),
            ),
            Method(
                name="parameter-space-2d",
                settings_type=parameter_space.ParameterSpace2dSettings,
                segment=parameter_space.segment_2d,
                faithful=parameter_space.ParameterSpace2dSettings.faithful(),
            ),
            Method(
                name="parameter-space-3d",
                settings_type=parameter_space.ParameterSpace3dSettings,
                segment=parameter_space.segment_3d,
                faithful=parameter_space.ParameterSpace3dSettings.faithful(),
            ),
            Method(
                name="kmeans",
                settings_type=kmeans.KMeansSettings,
                segment=kmeans.segment,
                faithful=kmeans.KMeansSettings.faithful(),
            ),
        )
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

    def segmentation(self, method: Method) -> Callable[[Candidate], Segmentation]:
        """The method with its settings bound.

        Raises
        ------
        SettingsError
            Where the settings belong to another method.
        """
        settings = method.settings_type() if self.method is None else self.method
        if not isinstance(settings, method.settings_type):
            wanted, got = method.settings_type.__name__, type(settings).__name__
            raise SettingsError([f"the settings of {method.name} are {got}: use {wanted}"])
        return lambda candidate: method.segment(candidate, settings)
