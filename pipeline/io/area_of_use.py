"""Where the coordinates of a file lie on Earth, and whether their CRS is made for that place.

Any coordinates are valid in any projected CRS, so a wrong one goes unnoticed until the place is looked at: Delft in New
Zealand's grid lies in Antarctica. The EPSG registry has the area of use of each CRS as a box of longitudes and
latitudes. Data reach beyond it on purpose, so only what lies far outside is refused.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import textwrap
from typing import TYPE_CHECKING

from pipeline.errors import CrsError
from pipeline.io.crs import horizontal_part, to_degrees

if TYPE_CHECKING:
    import pyproj

ALLOW = "--allow-outside-area-of-use"
"""The option that accepts such a place."""
LARGEST_MARGIN_KM = 600.0
"""National data use one zone for a whole country: Norway reaches 490 km beyond UTM zone 33, and its sea farther."""
LEAST_MARGIN_KM = 100.0
"""For small areas, such as islands: surveys of the sea around them."""
_NAME_LENGTH = 60
"""Names list many countries."""
ROUND_TRIP_M = 1000.0
"""A place on Earth projects back to where it came from; far outside their domain formulas miss by much more."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AreaOfUse:
    """The box for which a CRS is made, in degrees; it may cross the antimeridian, then west is larger than east."""

    name: str
    west: float
    south: float
    east: float
    north: float

    @property
    def margin_km(self) -> float:
        """How far outside data may lie: half of the box's diagonal, within bounds."""
        width = (self.east - self.west) % 360.0 or 360.0
        middle = math.radians((self.south + self.north) / 2.0)
        half_km = 0.5 * KM_A_DEGREE * math.hypot(width * math.cos(middle), self.north - self.south)
        return min(max(half_km, LEAST_MARGIN_KM), LARGEST_MARGIN_KM)

    def distance_km(self, longitude: float, latitude: float) -> float:
        """Distance of a place from the box, about; 0 inside."""
        width = (self.east - self.west) % 360.0 or 360.0
        beyond = (longitude - self.west) % 360.0
        aside = 0.0 if beyond <= width else min(beyond - width, 360.0 - beyond)
        near = min(max(latitude, self.south), self.north)
        return KM_A_DEGREE * _arc_deg(latitude, near, aside)

    def __str__(self) -> str:
        """The name and the box."""
        edges = f"{degrees_of(self.west, 'EW')} to {degrees_of(self.east, 'EW')}"
        name = textwrap.shorten(self.name.rstrip("."), _NAME_LENGTH, placeholder=" …")
        return f"{name} ({edges}, {degrees_of(self.south, 'NS')} to {degrees_of(self.north, 'NS')})"


KM_A_DEGREE = 111.2
"""Length of a degree on a sphere of 6371 km."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Location:
    """The place of a file's middle by its CRS."""

    crs: str
    """Code and name of the CRS."""
    longitude_latitude: tuple[float, float] | None
    """Degrees, WGS 84; None if this CRS puts the coordinates nowhere on Earth."""
    area: AreaOfUse | None
    """None if no registry knows the area of the CRS."""

    @property
    def outside_km(self) -> float:
        """Distance from the area of use: 0 inside or without a known area, infinity if not on Earth."""
        if self.longitude_latitude is None:
            return math.inf
        return 0.0 if self.area is None else self.area.distance_km(*self.longitude_latitude)

    @property
    def is_far_outside(self) -> bool:
        """Whether it lies farther outside a known area than data ever do on purpose."""
        return self.area is not None and self.outside_km > self.area.margin_km

    @property
    def problem(self) -> str:
        """Half a sentence that names the CRS, the place and the area."""
        if self.longitude_latitude is None:
            lies = "would not lie on Earth"
        else:
            lies = f"would lie at {self}, {self.outside_km:.0f} km from the area of use"
        return f"in {self.crs} the tile {lies}: that CRS is made for {self.area}"

    @property
    def fix(self) -> str:
        """What to do about it."""
        return f"Give the right CRS with --crs EPSG:n, or give {ALLOW} if this is the right one"

    def __str__(self) -> str:
        """The place, to a hundredth of a degree."""
        if self.longitude_latitude is None:
            return "not on Earth"
        longitude, latitude = self.longitude_latitude
        return f"{degrees_of(latitude, 'NS')}, {degrees_of(longitude, 'EW')}"


def degrees_of(value: float, signs: str) -> str:
    """An angle in words: positive has the first sign.

    >>> degrees_of(-75.981, "NS"), degrees_of(4.4, "EW")
    ('75.98° S', '4.40° E')
    """
    return f"{abs(value):.2f}° {signs[value < 0.0]}"


def location_of(wkt: str, bounds: tuple[float, float, float, float]) -> Location | None:
    """The place of the middle of x_min, y_min, x_max, y_max in the units of a CRS; None for CRS without such a place.

    Local and engineering CRS have none.
    """
    plane = _plane(wkt)
    if plane is None:
        return None
    x, y = 0.5 * (bounds[0] + bounds[2]), 0.5 * (bounds[1] + bounds[3])
    return Location(crs=plane.name, longitude_latitude=plane.place(x, y), area=plane.area)


def refuse_far_outside(path: str, location: Location | None) -> None:
    """Raise CrsError for a place that is far outside the area of use."""
    if location is not None and location.is_far_outside:
        raise CrsError(path, location.problem, location.fix)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Plane:
    """A projected CRS, ready to look up places."""

    name: str
    area: AreaOfUse | None
    to_degrees: pyproj.Transformer

    def place(self, x: float, y: float) -> tuple[float, float] | None:
        longitude, latitude = self.to_degrees.transform(x, y)
        if not (math.isfinite(longitude) and math.isfinite(latitude)):
            return None
        back = self.to_degrees.transform(longitude, latitude, direction="INVERSE")
        if not math.dist(back, (x, y)) <= ROUND_TRIP_M:
            return None
        return longitude, latitude


@functools.lru_cache(maxsize=64)
def _plane(wkt: str) -> _Plane | None:
    """The horizontal part of a CRS; None if it is not projected, or cannot be computed."""
    import pyproj

    plane = horizontal_part(pyproj.CRS.from_wkt(wkt))
    if not plane.is_projected:
        return None
    # WKT 1 has no area, and orders of axes differ: the lowest confidence still means the same projection
    known = plane.to_authority(min_confidence=25)
    area, name = plane.area_of_use, plane.name
    if known is not None:
        area = area or pyproj.CRS.from_authority(*known).area_of_use
        name = f"{':'.join(known)} ({plane.name})"
    found = None
    if area is not None:
        found = AreaOfUse(name=area.name, west=area.west, south=area.south, east=area.east, north=area.north)
    transformer = to_degrees(plane)
    return None if transformer is None else _Plane(name=name, area=found, to_degrees=transformer)


def _arc_deg(one: float, other: float, aside: float) -> float:
    """Great-circle arc between two latitudes whose meridians are so far apart, by the haversine formula; degrees."""
    first, second = math.radians(one), math.radians(other)
    half = math.sin((second - first) / 2.0) ** 2
    half += math.cos(first) * math.cos(second) * math.sin(math.radians(aside) / 2.0) ** 2
    return math.degrees(2.0 * math.asin(math.sqrt(min(half, 1.0))))
