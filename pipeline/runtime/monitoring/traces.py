"""Whether the environment asks for traces, and what a run adds to them; without traces, no more of them is loaded."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import os
from collections.abc import Mapping
from typing import Any

LOG = logging.getLogger("gablework.tracing")

ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
"""Variables that turn traces on."""
SLOW_BUILDING_S = 1.0
"""Seconds of a building from which it gets a span, unless `GABLEWORK_TRACE_BUILDING_S` has another number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a task that gets a span of its own."""

    name: str
    """Its kind."""
    began_s: float
    ended_s: float
    """Its times in seconds since 1970."""
    error: str | None = None
    """Why it failed."""
    facts: Mapping[str, Any]
    """Its attributes."""


def are_wanted() -> bool:
    """Whether a variable names a collector."""
    return any(os.environ.get(name) for name in ENDPOINTS)


@functools.cache
def slow_building_s() -> float:
    """Seconds of a building from which it gets a span of its own; a number that makes no sense costs a warning."""
    text = os.environ.get("GABLEWORK_TRACE_BUILDING_S", "")
    with contextlib.suppress(ValueError):
        seconds = float(text or SLOW_BUILDING_S)
        if seconds >= 0.0:
            return seconds
    LOG.warning("GABLEWORK_TRACE_BUILDING_S is %r: give seconds from 0 on; %g is used", text, SLOW_BUILDING_S)
    return SLOW_BUILDING_S
