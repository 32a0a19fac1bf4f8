"""The catalogue of a folder of outputs: which there are, how large, with which sha256. It is written last."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.errors import NoSuchOutputError
from service.outputs.kinds import OUTPUTS

NAME = "outputs.json"
"""File name of the catalogue; a folder without it is not finished."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredOutput:
    """One output as it lies in the folder."""

    size_bytes: int
    """Its size."""
    sha256: str
    """Hexadecimal."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResultsCrs:
    """The coordinate reference system (CRS) of the results."""

    name: str | None
    """As the run told it; None where it is unknown."""
    uri: str | None
    """Of its horizontal part at the OGC; None where it has no EPSG code or is unknown."""
    to_wgs84: str | None
    """PROJ's words for the way to WGS 84; None where the CRS is unknown."""
    accuracy_m: float | None
    """Accuracy of that way in metres; None where PROJ tells none."""

    @property
    def is_known(self) -> bool:
        """Whether there are coordinates in WGS 84."""
        return self.to_wgs84 is not None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Catalogue:
    """What a folder of outputs holds."""

    outputs: Mapping[str, StoredOutput]
    """By id, in the order of `OUTPUTS`."""
    crs: ResultsCrs
    """Of the results."""
    n_buildings: int
    """Rows of the buildings table."""

    def to_json(self) -> str:
        """The catalogue as JSON text."""
        return json.dumps(dataclasses.asdict(self), indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Catalogue:
        """The inverse of `to_json`."""
        found: dict[str, Any] = json.loads(text)
        return cls(
            outputs={name: StoredOutput(**entry) for name, entry in found["outputs"].items()},
            crs=ResultsCrs(**found["crs"]),
            n_buildings=found["n_buildings"],
        )


def read_catalogue(out_dir: Path) -> Catalogue:
    """The catalogue of a folder.

    Raises
    ------
    NoSuchOutputError
        The folder has none: it was removed, or never finished.
    """
    try:
        return Catalogue.from_json((out_dir / NAME).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise NoSuchOutputError("the outputs of this job are no longer in the state folder: submit it again") from None


def output_file(out_dir: Path, output_id: str) -> Path:
    """Where an output lies.

    Raises
    ------
    NoSuchOutputError
        The process has no such output, the job was asked not to make it, or its file is gone.
    """
    stored = read_catalogue(out_dir).outputs
    there = ", ".join(stored) or "none"
    if output_id not in OUTPUTS:
        raise NoSuchOutputError(f"there is no output {output_id!r}; this job has: {there}")
    if output_id not in stored:
        raise NoSuchOutputError(f"this job was asked not to make {output_id}, or had nothing for it; it has: {there}")
    path = out_dir / OUTPUTS[output_id].filename
    if not path.is_file():
        raise NoSuchOutputError(f"the file of {output_id} is no longer in the state folder: submit the job again")
    return path
