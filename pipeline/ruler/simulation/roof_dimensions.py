"""The input and output of parametric roofs: shapes, dimensions, faces.

The frame of a roof: u along the ridge, v to the left of it, origin in the middle of the (main) rectangle, metres;
heights over the eave. Faces run counter-clockwise seen from above and together cover the footprint once: the surface,
the walls and the solid follow from them.
"""

from __future__ import annotations

import dataclasses
from enum import StrEnum

from pipeline.model import FloatArray

FaceRings = tuple[tuple[int, ...], ...]
"""A face: vertex indices of its outline, counter-clockwise seen from above, then of its holes, clockwise."""


class RoofShape(StrEnum):
    """The parametric shapes."""

    FLAT = "flat"
    PENT = "pent"
    GABLE = "gable"
    HIP = "hip"
    L_SHAPE = "l_shape"
    HALF_HIP = "half_hip"
    BENT_HIP = "bent_hip"
    PYRAMID = "pyramid"
    UNEQUAL_GABLE = "unequal_gable"
    MANSARD = "mansard"
    GAMBREL = "gambrel"
    T_SHAPE = "t_shape"
    U_SHAPE = "u_shape"
    CROSS = "cross"
    COURTYARD = "courtyard"
    MULTI_LEVEL_FLAT = "multi_level_flat"


class BrokenForm(StrEnum):
    """The forms of the suite `broken_slopes`, which have functions of their own there."""

    MANSARD = "mansard"
    GAMBREL = "gambrel"
    KICKED_HIP = "kicked_hip"
    KICKED_GABLE = "kicked_gable"
    JERKINHEAD = "jerkinhead"
    CROSS_GABLE = "cross_gable"
    HEXAGONAL_PYRAMID = "hexagonal_pyramid"
    SAWTOOTH = "sawtooth"
    BUTTERFLY = "butterfly"
    GABLE_DORMERS = "gable_dormers"
    SHED_DORMERS = "shed_dormers"
    HIPPED_DORMERS = "hipped_dormers"
    PARAPET = "parapet"
    PARAPET_GABLE = "parapet_gable"


class CurvedForm(StrEnum):
    """The forms of the suite `curved_roofs`, which have functions of their own there."""

    SHALLOW_BARREL = "shallow_barrel"
    BARREL = "barrel"
    HALF_BARREL = "half_barrel"
    ELLIPTIC_BARREL = "elliptic_barrel"
    CONE = "cone"
    DOME = "dome"
    CAP = "cap"
    SQUARE_CAP = "square_cap"


class AdditionKind(StrEnum):
    """A kind of addition to a roof."""

    BOX = "box"
    """A superstructure with a flat top: lift shaft, chimney, attic box."""
    PENT_DORMER = "pent_dormer"
    """A dormer with one face that is flatter than the roof."""
    GABLE_DORMER = "gable_dormer"
    """A dormer with two faces; its ridge runs into the roof."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Addition:
    """Something on a roof, over a rectangle in plan whose sides run along u and v."""

    kind: AdditionKind
    """What it is."""
    u_m: float
    """Its middle along the ridge, in the roof's frame."""
    v_m: float
    """Its middle across the ridge."""
    length_m: float
    """Extent along u."""
    width_m: float
    """Extent along v."""
    height_m: float
    """Box: its top over the highest roof beneath. Dormer: its eave over the roof at its front."""

    def __post_init__(self) -> None:
        """Reject an addition without a body."""
        if not min(self.length_m, self.width_m, self.height_m) > 0:
            raise ValueError(
                f"a {self.kind} of {self.length_m:g} x {self.width_m:g} x {self.height_m:g} m has no body:"
                " all three must be positive"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlatPart:
    """A part of a flat roof of several levels: a rectangle in plan whose sides run along u and v."""

    u_m: float
    """Its middle along u, in the roof's frame."""
    v_m: float
    """Its middle along v."""
    length_m: float
    """Extent along u."""
    width_m: float
    """Extent along v."""
    height_m: float
    """Its level over the eave."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofDimensions:
    """Size of a building's roof."""

    length_m: float
    """Along the ridge."""
    width_m: float
    """Across the ridge."""
    pitch_deg: float = 0.0
    """Slope of every sloping face, 0 to 75; ignored for flat roofs."""
    wing_length_m: float = 0.0
    """L-shape: how far the wing stands out of the main rectangle."""
    wing_width_m: float = 0.0
    """L-shape: width of the wing, less than width_m, so that its ridge stays under the main ridge. T, U, cross: width
    of the wings, at most width_m. Courtyard: width of all four wings."""
    wing_offset_m: float = 0.0
    """T-shape, cross: where along u the middle of the wing stands."""
    second_wing_length_m: float = 0.0
    """U-shape: how far the wing at the rear end stands out; 0: as far as the other."""
    second_pitch_deg: float = 0.0
    """Unequal gable: slope of the left side. Bent hip: of the lower faces. Mansard, gambrel: of the upper faces."""
    break_share: float = 1 / 3
    """Bent hip, mansard, gambrel: where the slope changes, as a share of the way from the eave to the middle. Half-hip:
    share of the rise that the hips take."""
    levels: tuple[FlatPart, ...] = ()
    """Flat roof of several levels: its parts."""
    additions: tuple[Addition, ...] = ()
    """Dormers and superstructures."""

    def __post_init__(self) -> None:
        """Reject dimensions without a roof."""
        if not (self.length_m > 0 and self.width_m > 0):
            raise ValueError(f"a roof of {self.length_m:g} x {self.width_m:g} m has no area: both must be positive")
        if not 0 <= self.pitch_deg <= 75:
            raise ValueError(f"pitch_deg is {self.pitch_deg:g}: use 0 to 75")
        if not 0 <= self.second_pitch_deg <= 75:
            raise ValueError(f"second_pitch_deg is {self.second_pitch_deg:g}: use 0 to 75")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofFaces:
    """A roof in its own frame."""

    vertices: FloatArray
    """(v, 3) float64: u, v, metres above the eave."""
    faces: tuple[FaceRings, ...]
    """The rings of each face."""
    groups: tuple[int, ...]
    """A number for every face; faces with one number count as one."""
