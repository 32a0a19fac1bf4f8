"""Problem documents (RFC 9457)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from service.wire.base import Answer


class Problem(Answer):
    """A problem document."""

    type: Annotated[str, Field(description="URI of the kind of problem.")]
    title: Annotated[str, Field(description="The same for every problem of this kind.")]
    status: int
    detail: Annotated[str, Field(description="What happened, with the value and the fix.")]
    instance: Annotated[str, Field(description="The path that was requested.")]
    errors: list[str] | None = Field(None, description="Every fault, if there can be several.")
    jobID: str | None = Field(None, description="The job that is under way; only of `schedule-busy`.")
