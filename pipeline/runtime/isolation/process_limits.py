"""The limits of an item that a supervised child process works on, and why one has no result."""

from __future__ import annotations

import dataclasses
import math

from pipeline.errors import SettingsError
from pipeline.model import Reason
from pipeline.options import ResourceOptions

MIN_MEMORY_BYTES = 2**29
"""A child uses a quarter of this before it begins."""

BUNDLE_SUFFIX = ".bundle"
"""Of the file of a building that ended its process."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class IsolationLimits:
    """Limits of one building, above which its process is ended.

    Raises
    ------
    SettingsError
        A limit is too small to model any building.
    """

    timeout_s: float = ResourceOptions.building_timeout_s
    """Wall-clock seconds of one building; protects the run."""
    memory_bytes: int = round(ResourceOptions.building_memory_gib * 2**30)
    """Private resident size of the child process."""

    def __post_init__(self) -> None:
        """Refuse limits that are too small."""
        faults = []
        if not (math.isfinite(self.timeout_s) and self.timeout_s > 0.0):
            faults.append(f"the time-out of a building is {self.timeout_s:g} s: use more than 0")
        if self.memory_bytes < MIN_MEMORY_BYTES:
            minimum = MIN_MEMORY_BYTES / 2**30
            faults.append(
                f"the memory of a building is {self.memory_bytes / 2**30:g} GiB: use at least {minimum:g} GiB"
            )
        if faults:
            raise SettingsError(faults)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loss:
    """Why an item has no result."""

    reason: Reason
    """crashed, timed_out or out_of_memory."""
    detail: str
    """What happened and the limit; the same text each time it happens."""
    seconds: float
    """Time from its beginning to its end."""
    memory_bytes: int
    """Largest observed private memory of its child."""
    stderr: str
    """The last lines of its child's standard error."""
