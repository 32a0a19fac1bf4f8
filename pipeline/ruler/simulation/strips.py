"""The survey: its settings, its flight lines, and which scan lines of them can touch a scene."""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np

from pipeline.model import BoolArray, FloatArray
from pipeline.parameters import Parameters, parameter
from pipeline.ruler.simulation.beam import FlightLine
from pipeline.ruler.simulation.scene_arrays import landing_m, steepest_slope
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain

_FIRST_GPS_TIME_S = 427_536_018.0
"""Start of the first strip: 1 April 2025, 10:00 UTC, as adjusted standard GPS time."""
_TURN_S = 120.0
"""From the end of a strip to the start of the next."""


class Returns(StrEnum):
    """The returns of a pulse that an instrument records."""

    ALL = "all"
    """As many as the beam has."""
    FIVE = "five"
    """The first five."""
    FIRST_AND_LAST = "first_and_last"
    """Two."""
    FIRST = "first"
    """One."""
    LAST = "last"
    """One."""


class ScannerSettings(Parameters):
    """The survey: instrument, flight and noise."""

    pulse_density_per_m2: float = parameter(
        8.0, "Pulses per square metre of one strip.", unit="1/m2", minimum=0.01, maximum=500.0
    )
    range_noise_m: float = parameter(0.03, "Standard deviation along the beam.", unit="m", minimum=0.0, maximum=2.0)
    altitude_m: float = parameter(600.0, "Flying height over the terrain's base.", unit="m", minimum=50.0)
    strip_spacing_m: float = parameter(120.0, "Distance of neighbouring flight lines.", unit="m", minimum=5.0)
    strip_overlap: float = parameter(
        0.15, "Share by which the swath is wider than the spacing.", minimum=0.0, maximum=2.0
    )
    flight_azimuth_deg: float = parameter(
        0.0, "Direction of the strips, clockwise from north.", unit="deg", minimum=0.0, maximum=360.0
    )
    jitter: float = parameter(
        0.5,
        "Random shift of each pulse along and across the line, as a share of the spacing.",
        minimum=0.0,
        maximum=1.0,
    )
    beam_radius_m: float = parameter(0.12, "Radius of the beam's footprint.", unit="m", minimum=0.0, maximum=2.0)
    range_resolution_m: float = parameter(
        1.2, "Echoes of one beam that are closer than this melt into one return.", unit="m", minimum=0.0, maximum=10.0
    )
    drop_out: float = parameter(0.005, "Share of pulses that never come back.", minimum=0.0, maximum=1.0)
    strip_shift_m: float = parameter(
        0.0, "Standard deviation of a strip's own horizontal shift, each axis.", unit="m", minimum=0.0, maximum=5.0
    )
    strip_lift_m: float = parameter(
        0.0, "Standard deviation of a strip's own vertical shift.", unit="m", minimum=0.0, maximum=5.0
    )
    strip_step_m: float = parameter(
        0.0, "By how much every second strip is too high.", unit="m", minimum=-5.0, maximum=5.0
    )
    wrong_row_share: float = parameter(
        0.0, "Share of scan rows whose elevations are wrong, all over the survey.", minimum=0.0, maximum=1.0
    )
    wrong_row_lift_m: float = parameter(
        0.0, "By how much the wrong rows are too high.", unit="m", minimum=-100.0, maximum=100.0
    )
    speed_m_s: float = parameter(60.0, "Speed of the aircraft.", unit="m/s", minimum=1.0, maximum=500.0)

    @property
    def half_swath_m(self) -> float:
        """Half the width of a strip on the ground."""
        return self.strip_spacing_m * (1.0 + self.strip_overlap) / 2.0

    @property
    def max_lean(self) -> float:
        """Tangent of the largest scan angle."""
        return self.half_swath_m / self.altitude_m

    @property
    def pulse_spacing_m(self) -> float:
        """Distance of scan lines, and of pulses in a line."""
        return 1.0 / math.sqrt(self.pulse_density_per_m2)


def survey_extent(scene: Scene) -> tuple[float, float, float, float]:
    """Extent of the whole survey if the scene is one tile of it, else of the scene."""
    return scene.survey_extent or scene.extent


def reach_m(
    terrain: Terrain, extent: tuple[float, float, float, float], settings: ScannerSettings, height_m: float
) -> float:
    """How far outside an extent the pulses that aim into it can hit objects of a height.

    A tile of a survey must contain all objects up to this distance, in metres; objects farther out cannot change its
    returns. `height_m` is that of the highest object over the lowest terrain below it. Raises as `landing_m` does.
    """
    lean = settings.max_lean
    beams = landing_m(terrain, extent, lean) + height_m * lean / (1.0 - steepest_slope(terrain) * lean)
    return beams + 2.0 * settings.beam_radius_m + settings.pulse_spacing_m


def flight_lines(scene: Scene, settings: ScannerSettings, seed: int) -> list[FlightLine]:
    """The strips over the scene or over the survey that it is a tile of, every second one flown backwards."""
    azimuth = math.radians(settings.flight_azimuth_deg)
    along = np.array([math.sin(azimuth), math.cos(azimuth)])
    across = np.array([along[1], -along[0]])
    x0, y0, x1, y1 = survey_extent(scene)
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    low, high = (corners @ across).min(), (corners @ across).max()
    start, end = (corners @ along).min() - settings.pulse_spacing_m, (corners @ along).max() + settings.pulse_spacing_m
    count = max(1, math.ceil((high - low) / settings.strip_spacing_m))
    first = (low + high) / 2 - (count - 1) / 2 * settings.strip_spacing_m
    random = np.random.default_rng([seed, 0x57])
    time, lines = _FIRST_GPS_TIME_S, []
    for k in range(count):
        sign = 1.0 if k % 2 == 0 else -1.0
        shift = random.normal(0.0, 1.0, 3) * (settings.strip_shift_m, settings.strip_shift_m, settings.strip_lift_m)
        middle = across * (first + k * settings.strip_spacing_m)
        begin = middle + along * (start if sign > 0 else end)
        lines.append(
            FlightLine(
                number=k,
                x=float(begin[0]),
                y=float(begin[1]),
                along_x=float(sign * along[0]),
                along_y=float(sign * along[1]),
                length=float(end - start),
                time=time,
                shift_x=float(shift[0]),
                shift_y=float(shift[1]),
                shift_z=float(shift[2]) + (settings.strip_step_m if k % 2 else 0.0),
            )
        )
        time += (end - start) / settings.speed_m_s + _TURN_S
    return lines


def strip_shifts_m(scene: Scene, settings: ScannerSettings, seed: int) -> list[tuple[float, float, float]]:
    """The shift of every strip by its number, east, north and up in metres: those flown, then the others of faults.

    The return of another strip has the shift of the fault on top of that of the strip flown over it.
    """
    lines = flight_lines(scene, settings, seed)
    shifts = [(line.shift_x, line.shift_y, line.shift_z) for line in lines]
    others = {fault.other_strip: fault for fault in scene.survey_faults if fault.other_strip is not None}
    for number in range(max(others, default=-1) + 1):
        if number not in others:
            shifts.append((0.0, 0.0, 0.0))
            continue
        x0, y0, x1, y1 = others[number].extent
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        over = min(lines, key=lambda line: abs((x - line.x) * line.along_y - (y - line.y) * line.along_x))
        east, north, up = others[number].shift
        shifts.append((over.shift_x + east, over.shift_y + north, over.shift_z + up))
    return shifts


def reached(places: FloatArray, scene: Scene, settings: ScannerSettings) -> BoolArray:
    """Which places (n, 3) of the scene frame some strip can hit: n flags.

    Pulses aim at the base elevation of the terrain. On higher ground they land nearer to the flight line, and the
    points end inside the extent.
    """
    x0, y0, x1, y1 = survey_extent(scene)
    x, y, z = places.T
    found = np.zeros(len(places), np.bool_)
    for line in flight_lines(scene, settings, 0):
        across = (x - line.x) * line.along_y - (y - line.y) * line.along_x
        aim = across / (1.0 - (z - scene.terrain.base_z_m) / settings.altitude_m)
        aim_x, aim_y = x + (aim - across) * line.along_y, y - (aim - across) * line.along_x
        in_extent = (aim_x >= x0) & (aim_y >= y0) & (aim_x <= x1) & (aim_y <= y1)
        found |= in_extent & (np.abs(aim) <= settings.half_swath_m)
    return found


def lines_over(flight: FlightLine, scene: Scene, settings: ScannerSettings) -> range:
    """The scan lines of a strip that can hold pulses which aim into the scene's extent."""
    spacing = settings.pulse_spacing_m
    x0, y0, x1, y1 = scene.extent
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) - (flight.x, flight.y)
    across = corners @ (flight.along_y, -flight.along_x)
    if across.min() > settings.half_swath_m + spacing or across.max() < -settings.half_swath_m - spacing:
        return range(0)
    along = corners @ (flight.along_x, flight.along_y) / spacing
    # Jitter and the swing of the mirror move a pulse by 0.75 of a line at most.
    first, stop = math.floor(along.min()) - 2, math.ceil(along.max()) + 2
    return range(max(0, first), max(0, min(math.ceil(flight.length / spacing), stop)))
