"""The landing page, conformance and health."""

from __future__ import annotations

from typing import Literal

from service.wire.base import Answer, Link


class LandingPage(Answer):
    """Links to everything else."""

    title: str
    description: str | None = None
    links: list[Link]


class Conformance(Answer):
    """The implemented parts of OGC API - Processes."""

    conformsTo: list[str]


class Health(Answer):
    """Whether the service works."""

    status: Literal["ok", "degraded", "unavailable"]
    checks: dict[str, str] | None = None
