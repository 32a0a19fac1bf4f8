"""Building work in a supervised child process, so that a building can cost only itself."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class IsolationLimits:
    """What one building may take before its process is ended."""

    timeout_s: float = 600.0
    """Wall-clock seconds of one building; protects the run, and is told as such."""
    memory_bytes: int = 4 * 2**30
    """Resident size of the child process."""
