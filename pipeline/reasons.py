"""What the reasons of records mean: in short for the page, and in full for the reference and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from pipeline.model import Reason


class Words(NamedTuple):
    """A reason in words."""

    short: str
    """Why an object is not a building, or has no model of its own kind, in plain words."""
    meaning: str
    """The same with its terms and limits."""


REASONS: Mapping[Reason, Words] = {
    Reason.TOO_FEW_POINTS: Words(
        "too few points for a plane",
        "fewer points than a plane needs; or fewer than `min_points`, of which the model explains less than three "
        "quarters; or too few anywhere on an object to show whether it is planar. In `buildings` only if a "
        "footprint or an override says that there is a building",
    ),
    Reason.NO_PLANE: Words("no roof plane was found in its points", "no plane passed the refinement"),
    Reason.NO_PARTITION: Words(
        "the roof planes could not be turned into faces",
        "the planes could not be turned into roof faces",
    ),
    Reason.INVALID_SOLID: Words(
        "the solid is not valid",
        "the solid broke a validity rule; `validity_codes` lists which",
    ),
    Reason.TOO_COMPLEX: Words("it exceeded the work limit of one building", "the counted work passed its bound"),
    Reason.NO_FOOTPRINT: Words("no outline could be made from its points", "no outline could be made from the points"),
    Reason.HEIGHT_GIVEN: Words(
        "too few points; a block of the height that its footprint states",
        "no model could be made of the points; the block has the height that an attribute of its footprint gives",
    ),
    Reason.POOR_FIT: Words(
        "too few of its points lie on the model",
        "`doubtful`: too few of its roof returns lie on the model",
    ),
    Reason.SCATTERED: Words(
        "its points scatter more than those of a roof",
        "`doubtful`: its roof returns scatter about the model more than a roof does: a tree, a heap",
    ),
    Reason.NOT_SEEN: Words(
        "too much of the roof has no points",
        "`doubtful`: too much of the roof is drawn where no point is, or may lie where none is",
    ),
    Reason.TOO_MANY_FACES: Words(
        "too few points for so many faces",
        "`doubtful`: too few roof returns for so many roof faces",
    ),
    Reason.UNCERTAIN: Words(
        "it may not be a building",
        "`doubtful`: it may not be a building; the detail is the confidence, or how much of a level roof the "
        "ground reaches",
    ),
    Reason.ABOVE_POINTS: Words(
        "a roof face rises above all its points",
        "`doubtful`: a roof face rises above all its points by more than their noise and its rise over two point "
        "spacings",
    ),
    Reason.LEVEL_THROUGH_SLOPE: Words(
        "a level roof face runs through a slope",
        "`doubtful`: most points within a level roof face lie on a slope that is not modelled",
    ),
    Reason.INTERNAL_ERROR: Words(
        "a fault of the program in this one building",
        "a fault of gablework in this one building; the detail names the exception; kept as a bundle",
    ),
    Reason.CRASHED: Words(
        "it crashed its process; a bundle for a replay is kept",
        "its process died at it, twice, the second time alone; the detail names the signal or the exit code; kept "
        "as a bundle",
    ),
    Reason.TIMED_OUT: Words(
        "it took too long; a bundle for a replay is kept",
        "it took longer than the limit that protects the run (`--building-timeout`); kept as a bundle",
    ),
    Reason.OUT_OF_MEMORY: Words(
        "it needed too much memory; a bundle for a replay is kept",
        "it took more memory than its process may have (`--building-memory`), or the machine had no more; kept as "
        "a bundle",
    ),
    Reason.TOO_SMALL: Words("its area is below that of the smallest building", "plan area below the smallest building"),
    Reason.TOO_LOW: Words("it is lower than the lowest building", "height above ground below the lowest building"),
    Reason.BELOW_Z_AVG: Words(
        "it lies below the walls around it: a street or a yard",
        "the surface lies below the Z_avg of the walls around it: a street, a yard",
    ),
    Reason.NO_WALLS: Words(
        "too little of its outline is wall: a mound or a bank",
        "too little of its outline is wall: a mound, a bank",
    ),
    Reason.VEGETATION: Words(
        "vegetation: rough, many returns, ground seen beneath",
        "rough, many returns, ground seen beneath",
    ),
    Reason.TOO_NARROW: Words(
        "narrower than a building: a wall, a hedge or a wire",
        "narrower than a building: a wall, a hedge, a wire",
    ),
    Reason.BRIDGE: Words(
        "the deck of a bridge",
        "level with the ground along two opposite ends, or one end of a long surface, and free along its sides: "
        "the deck of a bridge",
    ),
    Reason.VEHICLE: Words(
        "narrow, low and free all around: a vehicle or a container",
        "narrow, low and free all around: a van, a truck, a row of them, a container",
    ),
    Reason.STRIPS_DISAGREE: Words(
        "flight strips that do not fit each other here: it may be a building",
        "the flight strips that saw it lie above one another by more than `min_strip_offset_m`, so it may be a "
        "building; the detail names the offset, and what it looks like",
    ),
    Reason.OVERRIDDEN: Words(
        "an override says that it is not a building",
        "the user's overrides reject it; the detail is their note",
    ),
}
"""All reasons."""
