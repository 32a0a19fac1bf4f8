"""Point files like those of a sparser survey.

A point stays if the hash of its place in whole millimetres is below the wanted share. The choice does not depend on
order, files or a random generator, and every denser survey contains the points of a sparser one. All classes
are thinned alike, for a sparser survey has less ground too. The points left are as irregular as drawn ones: a flight
that is planned for that density is more even.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import laspy
import numpy as np
import numpy.typing as npt
import shapely

from pipeline.model import BoolArray, IntArray
from pipeline.ruler.evaluation.reference import Reference

_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_MIXERS = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_SHIFTS = (30, 27, 31)

Change = Callable[[laspy.LasData], laspy.LasData]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofDensity:
    """How densely the roofs of a reference were measured."""

    points: int
    """Points of class 6 inside the outlines of the buildings."""
    area_m2: float
    """Area of the outlines, overlaps once."""

    @property
    def per_m2(self) -> float:
        """Points per square metre."""
        return self.points / self.area_m2


def roof_density(reference: Reference) -> RoofDensity:
    """The density of class 6 inside the outlines of the reference buildings. Reads all points once."""
    return RoofDensity(
        points=sum(int(points.is_roof.sum()) for points in reference.points()),
        area_m2=float(shapely.union_all([building.footprint for building in reference.buildings]).area),
    )


def place_hash(xyz_mm: IntArray) -> npt.NDArray[np.uint64]:
    """A number between 0 and 2^64 for each place, evenly spread and unrelated between neighbours.

    The coordinates (n, 3) in whole millimetres are weighted by odd numbers and mixed by the finaliser of SplitMix64
    (Steele, Lea and Flood 2014, Fast splittable pseudorandom number generators), axis after axis.
    """
    mixed = np.zeros(len(xyz_mm), np.uint64)
    for axis, weight in enumerate(_ODD):
        mixed += (xyz_mm[:, axis].astype(np.uint64) + np.uint64(1)) * weight
        for shift, mixer in zip(_SHIFTS, _MIXERS, strict=False):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(mixer)
        mixed ^= mixed >> np.uint64(_SHIFTS[-1])
    return mixed


def kept(xyz_mm: IntArray, share: float) -> BoolArray:
    """Which points (n, 3) of a survey, in whole millimetres, stay: about this share of them, all from 1 on."""
    if share >= 1.0:
        return np.ones(len(xyz_mm), np.bool_)
    below: BoolArray = place_hash(xyz_mm) < np.uint64(int(share * 2.0**64))
    return below


def thinned(share: float) -> Change:
    """The change that leaves about a share of the points."""

    def change(las: laspy.LasData) -> laspy.LasData:
        places = np.rint(np.column_stack((las.x, las.y, las.z)) * 1e3).astype(np.int64)
        las.points = las.points[kept(places, share)]
        return las

    return change


def write_changed(tiles: Sequence[Path], folder: Path, change: Change) -> tuple[Path, ...]:
    """Change LAS or LAZ files, each read as a whole; the new files have their names, in their order, in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for tile in tiles:
        target = folder / tile.name
        change(laspy.read(tile)).write(target)
        written.append(target)
    return tuple(written)
