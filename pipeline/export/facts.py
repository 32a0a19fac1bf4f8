"""What goes into records beside the models: facts of a run, of a candidate, of a rejected object."""

from __future__ import annotations

import dataclasses
import datetime as dt
import math
from collections.abc import Mapping

from shapely import MultiPolygon, Polygon

from pipeline.export.stored_coordinates import SpatialReference
from pipeline.model import Reason


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateFacts:
    """Facts of one candidate that its result does not carry."""

    input_hash: str | None = None
    """Digest of the candidate's ordered points and ground."""
    acquired_from: dt.datetime | None = None
    """Time of the candidate's earliest point, with a time zone; None if the file has no absolute time."""
    acquired_to: dt.datetime | None = None
    """Time of the candidate's latest point."""
    through_share: float = math.nan
    """Share of the candidate's points whose pulse went on to a later return; nan if it is not known."""
    source_attributes: str | None = None
    """The given footprint's columns as the text of a JSON object; None without one."""
    overridden: str | None = None
    """Changes by the user's overrides, such as `accept, method`; None without any."""
    settings_hash: str | None = None
    """Hash of this building's own settings; None if it uses the run's."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordContext:
    """Facts of the run that go into its records."""

    reference: SpatialReference
    """The outputs' coordinate reference system."""
    settings_hash: str
    """Digest of the settings that can change geometry."""
    engine_version: str
    """Version of this program."""
    acquired_from: dt.datetime | None = None
    """Earliest acquisition of the whole run's input, for candidates without facts of their own."""
    acquired_to: dt.datetime | None = None
    """Latest acquisition of the whole run's input."""
    facts: Mapping[str, CandidateFacts] = dataclasses.field(default_factory=dict)
    """Facts by building_id."""
    further_lods: tuple[str, ...] = ()
    """Levels of detail that were asked for beside the finest one: each has mesh files of its own."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RejectedObject:
    """An object that was judged to be no building."""

    object_id: str
    """Made as a building_id: from the CRS and the object's smallest point."""
    origin: tuple[float, float, float]
    """Absolute easting, northing, elevation in metres of the local origin."""
    reason: Reason
    """Why it is not a building."""
    reason_detail: str
    """The measured figure and the threshold."""
    outline: Polygon | MultiPolygon | None
    """Box around the object in local metres; None where its points span no area."""
    area_m2: float
    """Plan area in square metres; nan where it was not measured."""
    height_m: float
    """Height above ground in metres; nan where it was not measured."""
    n_points: int
    """Points of the object."""
    confidence: float = math.nan
    """Probability that it is a building after all; nan where it could not be judged."""
