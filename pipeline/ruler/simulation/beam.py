"""The kernel of the scanner: one pulse after the other, each a bundle of lines whose hits melt into returns."""

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
    cell_of,
    first_hit,
    is_clear,
    is_wet,
    mixed_bits,
    terrain_hit,
    uniform_of,
)
from pipeline.ruler.simulation.scene_arrays import SceneArrays

LINES_A_BEAM = 7
"""One in the middle, six around it; a beam that meets no edge and no crown needs only the one in the middle."""
MAX_RETURNS = LINES_A_BEAM
"""No more returns than lines."""
COLUMNS = 8
"""Integer columns: return number, return count, class, intensity, building, face, mixed, scan line."""

_CLEAR_RADII = 1.5
"""A sloping face is met a little farther out than a level one."""
_DRAWS_BEFORE_CROWNS = 4 + 2 * MAX_RETURNS
_DRAWS_A_LINE = 4096
"""More than entries in any cell, so that no two lines of a beam share a chance."""
_WRONG_ROW = 0x3C6EF372FE94F82B
"""Tells the random state of a scan line's fault from those of its pulses."""
_ROUNDING_M = 1e-6


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
def _places_in_extent(
    flight: FlightLine, extent: FloatArray, half_swath: float, spacing: float, line: int, pulses_a_line: int
) -> tuple[int, int]:
    """The range of places across a scan line outside of which no pulse aims into the extent."""
    low, high = -half_swath, half_swath
    # A pulse of this line aims this far along the strip, jitter and swing of the mirror included.
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
    stop = min(pulses_a_line, math.ceil((high + half_swath) / spacing) + 1)
    return first, max(first, stop)


@kernel
def scan_lines(
    scene: SceneArrays,
    flight: FlightLine,
    survey: FloatArray,
    extent: FloatArray,
    seed: int,
    first_line: int,
    stop_line: int,
    pulses_a_line: int,
    floats: FloatArray,
    integers: LabelArray,
) -> int:
    """Scan the lines first_line to stop_line - 1 of a strip.

    Parameters
    ----------
    scene : SceneArrays
        What can be hit.
    flight : FlightLine
        The strip.
    survey : ndarray (11,)
        Spacing, half swath, altitude, jitter, range noise, beam radius, range resolution, drop-out, speed, share of
        wrong scan rows, their lift.
    extent : ndarray (4,)
        Pulses that aim outside of it at the terrain's base are not fired.
    seed : int
        Not negative.
    first_line, stop_line, pulses_a_line : int
        What to scan.
    floats : ndarray (capacity, 5)
        Receives x, y, z (scene frame), GPS time, scan angle in degrees.
    integers : ndarray (capacity, COLUMNS) int32
        Receives the rest.

    Returns
    -------
    int
        Number of returns.
    """
    spacing, half_swath, altitude, jitter = survey[0], survey[1], survey[2], survey[3]
    noise, radius, resolution, drop_out, speed = survey[4], survey[5], survey[6], survey[7], survey[8]
    wrong_rows, wrong_lift = survey[9], survey[10]
    right_x, right_y = flight.along_y, -flight.along_x
    terrain, waves, base_z = scene.terrain, scene.waves, scene.terrain[0]
    spot_start, spots = scene.spot_start, scene.spots
    grid, cells_across, cells_up = scene.grid, scene.cells_across, scene.cells_up
    hit_z = np.empty(LINES_A_BEAM)
    hit_kind = np.empty(LINES_A_BEAM, np.int64)
    hit_thing = np.empty(LINES_A_BEAM, np.int64)
    hit_face = np.empty(LINES_A_BEAM, np.int64)
    count = 0
    has_spots = len(spots) > 0
    for line in range(first_line, stop_line):
        first_place, stop_place = _places_in_extent(flight, extent, half_swath, spacing, line, pulses_a_line)
        this_line = line_state(seed, flight.number, line)
        lift = flight.shift_z
        if wrong_rows > 0.0 and row_chance(this_line, 0) < wrong_rows:
            lift += wrong_lift
        for step in range(stop_place - first_place):
            pulse = first_place + step if line % 2 == 0 else pulses_a_line - stop_place + step
            state = _pulse_state(this_line, pulse)
            if uniform_of(state, 0) < drop_out:
                continue
            # The mirror swings to and fro; the aircraft flies on within a line.
            place = pulse if line % 2 == 0 else pulses_a_line - 1 - pulse
            swing = (pulse + 0.5) / pulses_a_line
            across = -half_swath + (place + 0.5 + jitter * (uniform_of(state, 1) - 0.5)) * spacing
            if abs(across) > half_swath:
                continue
            along = (line + 0.5 + jitter * (uniform_of(state, 2) - 0.5) + (swing - 0.5) * 0.5) * spacing
            x = flight.x + along * flight.along_x + across * right_x
            y = flight.y + along * flight.along_y + across * right_y
            if x < extent[0] or y < extent[1] or x >= extent[2] or y >= extent[3]:
                continue
            tangent = across / altitude
            lean_x, lean_y = -tangent * right_x, -tangent * right_y
            x, y, z = terrain_hit(terrain, waves, x, y, base_z, lean_x, lean_y)
            cell = cell_of(grid, cells_across, cells_up, x, y)
            lines = 1
            if cell >= 0 and not is_clear(
                scene,
                cell,
                x,
                y,
                z,
                lean_x,
                lean_y,
                _CLEAR_RADII * radius,
            ):
                lines = LINES_A_BEAM
            turn = 2.0 * math.pi * uniform_of(state, 3)
            hits = 0
            for k in range(lines):
                line_x, line_y, line_z = x, y, z
                if k > 0:
                    angle = turn + (k - 1) * math.pi / 3.0
                    line_x, line_y, line_z = terrain_hit(
                        terrain,
                        waves,
                        x + radius * math.cos(angle),
                        y + radius * math.sin(angle),
                        z,
                        lean_x,
                        lean_y,
                    )
                top, kind, thing, face = first_hit(
                    scene,
                    cell,
                    line_x,
                    line_y,
                    line_z,
                    lean_x,
                    lean_y,
                    state,
                    _DRAWS_BEFORE_CROWNS + k * _DRAWS_A_LINE,
                )
                if has_spots and kind == ROOF:
                    up = top - line_z
                    if is_wet(spot_start, spots, thing, line_x + up * lean_x, line_y + up * lean_y):
                        continue
                hit_z[hits], hit_kind[hits], hit_thing[hits], hit_face[hits] = top, kind, thing, face
                hits += 1
            _sort_downwards(hit_z, hit_kind, hit_thing, hit_face, hits)
            time = flight.time + (line + swing) * spacing / speed
            angle_deg = math.degrees(math.atan(tangent))
            length = math.sqrt(1.0 + tangent * tangent)
            first, returns = 0, 0
            while first < hits:
                stop = first + 1
                total = hit_z[first]
                while stop < hits and hit_z[stop - 1] - hit_z[stop] < resolution:
                    total += hit_z[stop]
                    stop += 1
                main, mixed = _most_frequent(hit_kind, hit_thing, hit_face, first, stop)
                echo_z = total / (stop - first) + noise * _normal_of(state, 4 + 2 * returns) / length
                row = count + returns
                floats[row, 0] = x + (echo_z - z) * lean_x + flight.shift_x
                floats[row, 1] = y + (echo_z - z) * lean_y + flight.shift_y
                floats[row, 2] = echo_z + lift
                floats[row, 3] = time
                floats[row, 4] = angle_deg
                integers[row, 0] = returns + 1
                integers[row, 2] = _class_of(hit_kind[main])
                integers[row, 3] = _intensity(hit_kind[main], (stop - first) / lines)
                is_building = integers[row, 2] == 6
                integers[row, 4] = hit_thing[main] if is_building else -1
                integers[row, 5] = hit_face[main] if is_building else -1
                integers[row, 6] = mixed
                integers[row, 7] = line
                returns += 1
                first = stop
            for row in range(count, count + returns):
                integers[row, 1] = returns
            count += returns
    return count


@kernel
def _sort_downwards(z: FloatArray, kind: IntArray, thing: IntArray, face: IntArray, n: int) -> None:
    """Insertion sort of the hits, highest (nearest to the aircraft) first, equal ones in the order of their lines."""
    for k in range(1, n):
        this_z, this_kind, this_thing, this_face = z[k], kind[k], thing[k], face[k]
        slot = k
        while slot > 0 and z[slot - 1] < this_z:
            z[slot], kind[slot], thing[slot], face[slot] = z[slot - 1], kind[slot - 1], thing[slot - 1], face[slot - 1]
            slot -= 1
        z[slot], kind[slot], thing[slot], face[slot] = this_z, this_kind, this_thing, this_face


@kernel
def _most_frequent(kind: IntArray, thing: IntArray, face: IntArray, first: int, stop: int) -> tuple[int, int]:
    """The hit whose surface has most of the beam (the higher one on ties), and 1 where there are several surfaces."""
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
    """Share of the beam times a reflectance in 16 bits."""
    reflectance = 0.35
    if kind == TREE:
        reflectance = 0.5
    elif kind == GROUND:
        reflectance = 0.25
    return int(share * reflectance * 65535.0)
