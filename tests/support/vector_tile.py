"""Mapbox vector tiles, read by the words of their specification 2.1: https://github.com/mapbox/vector-tile-spec."""

import dataclasses
import struct
from collections.abc import Iterator
from typing import Any

import shapely


@dataclasses.dataclass(frozen=True)
class Feature:
    """A polygon of a tile."""

    properties: dict[str, Any]
    area: float
    """In squared units of the tile: positive for outer rings, which run clockwise as the y axis points down."""


def layers_of(tile: bytes) -> dict[str, tuple[int, list[Feature]]]:
    """The layers of a tile by name: the extent and the features."""
    return dict(_layer(layer) for number, layer in _fields(tile) if number == 3)


def _layer(data: bytes) -> tuple[str, tuple[int, list[Feature]]]:
    fields = list(_fields(data))
    one = dict(fields)
    assert one[15] == 2, "version"
    keys = [value.decode() for number, value in fields if number == 3]
    values = [_value(value) for number, value in fields if number == 4]
    features = [_feature(value, keys, values) for number, value in fields if number == 2]
    return one[1].decode(), (one.get(5, 4096), features)


def _feature(data: bytes, keys: list[str], values: list[Any]) -> Feature:
    one = dict(_fields(data))
    assert one[3] == 3, "a polygon"
    tags = list(_varints(one.get(2, b"")))
    properties = {keys[key]: values[value] for key, value in zip(tags[::2], tags[1::2], strict=True)}
    return Feature(properties, sum(shapely.Polygon(ring).area * _turn(ring) for ring in _rings(one[4])))


def _turn(ring: list[tuple[int, int]]) -> int:
    """1 for an outer ring, -1 for a hole."""
    return -1 if shapely.is_ccw(shapely.LinearRing([(x, -y) for x, y in ring])) else 1


def _rings(data: bytes) -> Iterator[list[tuple[int, int]]]:
    """The rings of a geometry: commands with relative positions."""
    numbers, x, y = _varints(data), 0, 0
    ring: list[tuple[int, int]] = []
    for command in numbers:
        if command & 7 == 7:
            yield ring
            ring = []
            continue
        for _ in range(command >> 3):
            x, y = x + _zigzag(next(numbers)), y + _zigzag(next(numbers))
            ring.append((x, y))


def _value(data: bytes) -> Any:
    ((number, value),) = _fields(data)
    readers: dict[int, Any] = {
        1: bytes.decode,
        2: lambda raw: struct.unpack("<f", raw)[0],
        3: lambda raw: struct.unpack("<d", raw)[0],
        4: lambda raw: raw - 2**64 if raw >= 2**63 else raw,
        5: int,
        6: _zigzag,
        7: bool,
    }
    return readers[number](value)


def _zigzag(number: int) -> int:
    return (number >> 1) ^ -(number & 1)


def _fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Number and value of each field of a message of protocol buffers."""
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        if key & 7 == 0:
            value, place = _varint(data, place)
            yield key >> 3, value
            continue
        size, place = _varint(data, place) if key & 7 == 2 else ({1: 8, 5: 4}[key & 7], place)
        yield key >> 3, data[place : place + size]
        place += size


def _varints(data: bytes) -> Iterator[int]:
    place = 0
    while place < len(data):
        number, place = _varint(data, place)
        yield number


def _varint(data: bytes, place: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = data[place]
        number |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return number, place
