"""The kernel of the scanner: each pulse is a bundle of rays whose hits melt into returns."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.ruler.simulation.first_hit import (
    BOX,
    GROUND,
    ROOF,
    TREE,
    Ray,
    cell_of,
    first_hit,
    is_clear,
    is_wet,
    mixed_bits,
    terrain_hit,
    uniform_of,
)
from pipeline.ruler.simulation.scene_arrays import SceneArrays

RAYS_PER_BEAM = 7
"""One in the middle and six around it; a beam that meets no edge and no crown needs only the one in the middle."""
MAX_RETURNS = RAYS_PER_BEAM
"""At most one return per ray."""
COLUMNS = 8
"""Integer columns: return number, return count, class, intensity, building, face, mixed, scan line."""

_CLEAR_RADII = 1.5
"""In beam radii; more than 1, for a ray meets a sloping face a little farther out than a level one."""
_DRAWS_BEFORE_CROWNS = 4 + 2 * MAX_RETURNS
_DRAWS_PER_RAY = 4096
"""More than the entries in any cell: no two rays of a beam share a chance."""
_WRONG_ROW = 0x3C6EF372FE94F82B
"""Separates the random state of a fault of a scan line from the states of its pulses."""
_ROUNDING_M = 1e-6
"""Numerical guard: bounds are widened by this."""


class FlightLine(NamedTuple):
    """One strip, scene frame."""

    number: int
    """Counted from 0."""
    x: float
    """Start, easting."""
    y: float
    """Start, northing."""
    along_x: float
    """Unit vector of the flight, east."""
    along_y: float
    """Unit vector of the flight, north."""
    length: float
    """Metres."""
    time: float
    """GPS time at the start, seconds."""
    shift_x: float
    """The strip's own error, east, metres."""
    shift_y: float
    """The strip's own error, north."""
    shift_z: float
    """The strip's own error, up."""


class Survey(NamedTuple):
    """Everything that is the same for all strips of a scan; metres unless stated."""

    spacing: float
    """Between scan lines, and between pulses in a line."""
    half_swath: float
    """Half the width of a strip."""
    altitude: float
    """Flying height over the base of the terrain."""
    jitter: float
    """Random shift of a pulse, as a share of the spacing."""
    range_noise: float
    """Standard deviation along the beam."""
    beam_radius: float
    """Radius of the footprint on the ground."""
    range_resolution: float
    """Echoes closer than this melt into one return."""
    drop_out: float
    """Share of pulses that never come back."""
    speed: float
    """Metres per second."""
    wrong_row_share: float
    """Share of scan lines with wrong elevations."""
    wrong_row_lift: float
    """Error of their elevations."""
    pulses_per_line: int
    """Places across a strip."""
    extent: FloatArray
    """(4,) float64: pulses that aim outside of it at the base of the terrain are not fired."""
    seed: int
    """Not negative."""


class _Hits(NamedTuple):
    """The hits of one beam, in working arrays of one entry per ray."""

    z: FloatArray
    """Elevation."""
    kind: IntArray
    """GROUND, ROOF, WALL, TREE or BOX."""
    thing: IntArray
    """Number of the object."""
    face: IntArray
    """Roof face; -1 for none."""


class _Pulse(NamedTuple):
    """One pulse that was fired."""

    state: np.uint64
    """Its random state."""
    ray: Ray
    """Its axis, given by the point on the terrain."""
    tangent: float
    """Tangent of the scan angle."""
    line: int
    """Number of the scan line."""
    time: float
    """GPS time, seconds."""
    lift: float
    """Error of its elevations."""
    rays: int
    """Rays of the beam."""


@kernel(inline="always")
def _normal_of(state: np.uint64, draw: int) -> float:
    """A standard normal number from two draws (Box and Muller 1958)."""
    radius = math.sqrt(-2.0 * math.log(uniform_of(state, draw)))
    return radius * math.cos(2.0 * math.pi * uniform_of(state, draw + 1))


@kernel
def line_state(seed: int, strip: int, line: int) -> np.uint64:
    """The random state of one scan line."""
    state = mixed_bits(np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15))
    state = mixed_bits(state ^ mixed_bits(np.uint64(strip) + np.uint64(0xD1B54A32D192ED03)))
    return mixed_bits(state ^ mixed_bits(np.uint64(line) + np.uint64(0x8CB92BA72F3D8DD7)))


@kernel(inline="always")
def _pulse_state(line: np.uint64, pulse: int) -> np.uint64:
    """The random state of one pulse, from that of its line."""
    return mixed_bits(line ^ mixed_bits(np.uint64(pulse) + np.uint64(0xABC98388FB8FAC03)))


@kernel(inline="always")
def row_chance(line: np.uint64, draw: int) -> float:
    """A number in (0, 1) that decides a fault of a whole scan line, from the line's state."""
    return uniform_of(line ^ np.uint64(_WRONG_ROW), draw)


@kernel
def _places_in_extent(flight: FlightLine, survey: Survey, line: int) -> tuple[int, int]:
    """The range of places across a scan line outside of which no pulse aims into the extent."""
    extent, half_swath, spacing = survey.extent, survey.half_swath, survey.spacing
    low, high = -half_swath, half_swath
    # A pulse of this line aims this far along the strip, including jitter and the swing of the mirror.
    near, far = (line - 0.25) * spacing - _ROUNDING_M, (line + 1.25) * spacing + _ROUNDING_M
    for axis in range(2):
        start, along, right = flight.x, flight.along_x, flight.along_y
        if axis == 1:
            start, along, right = flight.y, flight.along_y, -flight.along_x
        least = extent[axis] - start - max(along * near, along * far) - _ROUNDING_M
        most = extent[axis + 2] - start - min(along * near, along * far) + _ROUNDING_M
        if abs(right) * half_swath < _ROUNDING_M:
            if least > 2.0 * _ROUNDING_M or most < -2.0 * _ROUNDING_M:
                return 0, 0
        else:
            low = max(low, min(least / right, most / right))
            high = min(high, max(least / right, most / right))
    first = max(0, math.floor((low + half_swath) / spacing - 1.0))
    stop = min(survey.pulses_per_line, math.ceil((high + half_swath) / spacing) + 1)
    return first, max(first, stop)


@kernel
def scan_lines(
    scene: SceneArrays,
    flight: FlightLine,
    survey: Survey,
    first_line: int,
    stop_line: int,
    floats: FloatArray,
    integers: LabelArray,
) -> int:
    """Scan the lines first_line to stop_line - 1 of a strip; returns the number of returns.

    `floats` (capacity, 5) receives x, y, z (scene frame), GPS time, scan angle in degrees; `integers`
    (capacity, COLUMNS) the rest.
    """
    grid, cells_across, cells_up = scene.grid, scene.cells_across, scene.cells_up
    things, faces = np.empty(RAYS_PER_BEAM, np.int64), np.empty(RAYS_PER_BEAM, np.int64)
    hits = _Hits(np.empty(RAYS_PER_BEAM), np.empty(RAYS_PER_BEAM, np.int64), things, faces)
    count = 0
    for line in range(first_line, stop_line):
        first_place, stop_place = _places_in_extent(flight, survey, line)
        this_line = line_state(survey.seed, flight.number, line)
        lift = flight.shift_z
        if survey.wrong_row_share > 0.0 and row_chance(this_line, 0) < survey.wrong_row_share:
            lift += survey.wrong_row_lift
        for step in range(stop_place - first_place):
            pulse = first_place + step if line % 2 == 0 else survey.pulses_per_line - stop_place + step
            state = _pulse_state(this_line, pulse)
            if uniform_of(state, 0) < survey.drop_out:
                continue
            swing = (pulse + 0.5) / survey.pulses_per_line
            is_fired, aim, tangent = _aimed(flight, survey, scene.terrain[0], state, line, pulse, swing)
            if not is_fired:
                continue
            ray = terrain_hit(scene.terrain, scene.waves, aim)
            cell = cell_of(grid, cells_across, cells_up, ray.x, ray.y)
            is_single = cell < 0 or is_clear(scene, cell, ray, _CLEAR_RADII * survey.beam_radius)
            time = flight.time + (line + swing) * survey.spacing / survey.speed
            fired = _Pulse(state, ray, tangent, line, time, lift, 1 if is_single else RAYS_PER_BEAM)
            n_hits = _beam_hits(scene, cell, fired, survey.beam_radius, hits)
            count += _write_returns(flight, survey, fired, hits, n_hits, floats[count:], integers[count:])
    return count


@kernel(inline="always")
def _aimed(
    flight: FlightLine, survey: Survey, base_z: float, state: np.uint64, line: int, pulse: int, swing: float
) -> tuple[bool, Ray, float]:
    """Whether a pulse is fired, its ray at the base of the terrain, and the tangent of the scan angle.

    The mirror swings to and fro, so every second line runs backwards; the aircraft moves on within a line.
    """
    extent, right_x, right_y = survey.extent, flight.along_y, -flight.along_x
    place = pulse if line % 2 == 0 else survey.pulses_per_line - 1 - pulse
    across = -survey.half_swath + (place + 0.5 + survey.jitter * (uniform_of(state, 1) - 0.5)) * survey.spacing
    along = (line + 0.5 + survey.jitter * (uniform_of(state, 2) - 0.5) + (swing - 0.5) * 0.5) * survey.spacing
    x = flight.x + along * flight.along_x + across * right_x
    y = flight.y + along * flight.along_y + across * right_y
    is_inside = not (x < extent[0] or y < extent[1] or x >= extent[2] or y >= extent[3])
    tangent = across / survey.altitude
    ray = Ray(x, y, base_z, -tangent * right_x, -tangent * right_y)
    return is_inside and abs(across) <= survey.half_swath, ray, tangent


@kernel(inline="always")
def _beam_hits(scene: SceneArrays, cell: int, pulse: _Pulse, radius: float, hits: _Hits) -> int:
    """Write the hits of the rays of a beam, from the highest to the lowest; returns their number."""
    axis = pulse.ray
    turn = 2.0 * math.pi * uniform_of(pulse.state, 3)
    has_spots = len(scene.spots) > 0
    n = 0
    for k in range(pulse.rays):
        ray = axis
        if k > 0:
            angle = turn + (k - 1) * math.pi / 3.0
            beside_x, beside_y = axis.x + radius * math.cos(angle), axis.y + radius * math.sin(angle)
            ray = terrain_hit(scene.terrain, scene.waves, Ray(beside_x, beside_y, axis.z, axis.lean_x, axis.lean_y))
        draw = _DRAWS_BEFORE_CROWNS + k * _DRAWS_PER_RAY
        top, kind, thing, face = first_hit(scene, cell, ray, pulse.state, draw)
        if has_spots and kind == ROOF:
            up = top - ray.z
            if is_wet(scene.spot_start, scene.spots, thing, ray.x + up * ray.lean_x, ray.y + up * ray.lean_y):
                continue
        hits.z[n], hits.kind[n], hits.thing[n], hits.face[n] = top, kind, thing, face
        n += 1
    _sort_downwards(hits, n)
    return n


@kernel(inline="always")
def _write_returns(
    flight: FlightLine,
    survey: Survey,
    pulse: _Pulse,
    hits: _Hits,
    n_hits: int,
    floats: FloatArray,
    integers: LabelArray,
) -> int:
    """Melt sorted hits into returns and write them to the first rows of both arrays; returns their number."""
    ray = pulse.ray
    angle_deg = math.degrees(math.atan(pulse.tangent))
    length = math.sqrt(1.0 + pulse.tangent * pulse.tangent)
    first, row = 0, 0
    while first < n_hits:
        stop = first + 1
        total = hits.z[first]
        while stop < n_hits and hits.z[stop - 1] - hits.z[stop] < survey.range_resolution:
            total += hits.z[stop]
            stop += 1
        main, mixed = _most_frequent(hits, first, stop)
        echo_z = total / (stop - first) + survey.range_noise * _normal_of(pulse.state, 4 + 2 * row) / length
        floats[row, 0] = ray.x + (echo_z - ray.z) * ray.lean_x + flight.shift_x
        floats[row, 1] = ray.y + (echo_z - ray.z) * ray.lean_y + flight.shift_y
        floats[row, 2] = echo_z + pulse.lift
        floats[row, 3] = pulse.time
        floats[row, 4] = angle_deg
        integers[row, 0] = row + 1
        integers[row, 2] = _class_of(hits.kind[main])
        integers[row, 3] = _intensity(hits.kind[main], (stop - first) / pulse.rays)
        is_building = integers[row, 2] == 6
        integers[row, 4] = hits.thing[main] if is_building else -1
        integers[row, 5] = hits.face[main] if is_building else -1
        integers[row, 6] = mixed
        integers[row, 7] = pulse.line
        row += 1
        first = stop
    integers[:row, 1] = row
    return row


@kernel
def _sort_downwards(hits: _Hits, n: int) -> None:
    """Insertion sort of n hits, highest (nearest to the aircraft) first, equal ones in the order of their rays."""
    z, kind, thing, face = hits
    for k in range(1, n):
        this_z, this_kind, this_thing, this_face = z[k], kind[k], thing[k], face[k]
        slot = k
        while slot > 0 and z[slot - 1] < this_z:
            z[slot], kind[slot], thing[slot], face[slot] = z[slot - 1], kind[slot - 1], thing[slot - 1], face[slot - 1]
            slot -= 1
        z[slot], kind[slot], thing[slot], face[slot] = this_z, this_kind, this_thing, this_face


@kernel
def _most_frequent(hits: _Hits, first: int, stop: int) -> tuple[int, int]:
    """The hit whose surface has most of the beam (the higher one on ties), and 1 if there are several surfaces."""
    _, kind, thing, face = hits
    best, most = first, 0
    for k in range(first, stop):
        same = 0
        for other in range(first, stop):
            if kind[other] == kind[k] and thing[other] == thing[k] and face[other] == face[k]:
                same += 1
        if same > most:
            best, most = k, same
    return best, 0 if most == stop - first else 1


@kernel(inline="always")
def _class_of(kind: int) -> int:
    """ASPRS class of a kind of hit."""
    if kind == GROUND:
        return 2
    if kind == TREE:
        return 5
    if kind == BOX:
        return 1
    return 6


@kernel(inline="always")
def _intensity(kind: int, share: float) -> int:
    """Share of the beam times the reflectance of its surface (plausible constants), in 16 bits."""
    reflectance = 0.35
    if kind == TREE:
        reflectance = 0.5
    elif kind == GROUND:
        reflectance = 0.25
    return int(share * reflectance * 65535.0)
