"""The simple roofs, vertex by vertex."""

from __future__ import annotations

import math

import numpy as np

from pipeline.ruler.simulation.roof_dimensions import RoofDimensions, RoofFaces


def _faces(vertices: list[tuple[float, float, float]], *faces: tuple[int, ...]) -> RoofFaces:
    return RoofFaces(
        vertices=np.array(vertices, dtype=np.float64),
        faces=tuple((face,) for face in faces),
        groups=tuple(range(len(faces))),
    )


def _corners(size: RoofDimensions, left_height: float = 0.0) -> list[tuple[float, float, float]]:
    """The main rectangle, counter-clockwise from the rear right; the two left corners may stand higher."""
    u, v = size.length_m / 2, size.width_m / 2
    return [(-u, -v, 0.0), (u, -v, 0.0), (u, v, left_height), (-u, v, left_height)]


def flat(size: RoofDimensions) -> RoofFaces:
    """One horizontal face."""
    return _faces(_corners(size), (0, 1, 2, 3))


def pent(size: RoofDimensions) -> RoofFaces:
    """One sloping face, low at the right side (v < 0)."""
    return _faces(_corners(size, size.width_m * math.tan(math.radians(size.pitch_deg))), (0, 1, 2, 3))


def gable(size: RoofDimensions) -> RoofFaces:
    """Two faces that meet in the ridge."""
    u, rise = size.length_m / 2, size.width_m / 2 * math.tan(math.radians(size.pitch_deg))
    return _faces([*_corners(size), (-u, 0.0, rise), (u, 0.0, rise)], (0, 1, 5, 4), (2, 3, 4, 5))


def hip(size: RoofDimensions) -> RoofFaces:
    """Four faces of equal pitch; a square footprint gives a pyramid. ValueError if it is wider than long."""
    half_ridge = (size.length_m - size.width_m) / 2
    if half_ridge < 0:
        raise ValueError(f"a hip roof {size.length_m:g} m long and {size.width_m:g} m wide has no ridge: turn it")
    rise = size.width_m / 2 * math.tan(math.radians(size.pitch_deg))
    if half_ridge == 0:
        return _faces([*_corners(size), (0.0, 0.0, rise)], (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4))
    ridge = [(-half_ridge, 0.0, rise), (half_ridge, 0.0, rise)]
    return _faces([*_corners(size), *ridge], (0, 1, 5, 4), (1, 2, 5), (2, 3, 4, 5), (3, 0, 4))


def l_shape(size: RoofDimensions) -> RoofFaces:
    """Two crossing gables of one pitch and one eave; the wing stands at the far end of the left side.

    Both valleys run from the end of the wing's ridge, inside the main roof, to the eave. The main gable's end wall and
    the wing's outer wall are one plane. Raises ValueError if the wing is as wide as the main part, longer than its
    side, or missing.
    """
    u, v, wing, out = size.length_m / 2, size.width_m / 2, size.wing_width_m, size.wing_length_m
    if not (0 < wing < min(size.width_m, size.length_m) and out > 0):
        raise ValueError(f"a wing {wing:g} m wide and {out:g} m long does not fit {size.length_m:g} x {size.width_m:g}")
    slope = math.tan(math.radians(size.pitch_deg))
    rise, wing_rise, middle = v * slope, wing / 2 * slope, u - wing / 2
    vertices = [
        *((-u, -v, 0.0), (u, -v, 0.0), (u, v, 0.0), (u, v + out, 0.0)),
        *((u - wing, v + out, 0.0), (u - wing, v, 0.0), (-u, v, 0.0)),
        *((-u, 0.0, rise), (u, 0.0, rise), (middle, v - wing / 2, wing_rise), (middle, v + out, wing_rise)),
    ]
    return _faces(vertices, (0, 1, 8, 7), (7, 8, 2, 9, 5, 6), (9, 2, 3, 10), (9, 10, 4, 5))
