"""The outputs of a finished job."""

from __future__ import annotations

from pydantic import Field, RootModel

from service.wire.base import Answer


class OutputFile(Answer):
    """An output as a file."""

    href: str
    rel: str
    type: str = Field(description="Media type.")
    title: str
    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Results(RootModel[dict[str, OutputFile]]):
    """The outputs by their ids."""
