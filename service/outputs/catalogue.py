"""The catalogue of a folder of outputs: names, sizes and sha256. It is written last."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import NoSuchOutputError
from service.outputs.kinds import KINDS, OUTPUTS, OutputKind

if TYPE_CHECKING:
    from service.features.feature_crs import RunCrs

NAME = "outputs.json"
"""File name of the catalogue; a folder without it is not finished."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredOutput:
    """One output in the folder."""

    size_bytes: int
    """Its size."""
    sha256: str
    """Hexadecimal."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResultsCrs:
    """The coordinate reference system (CRS) of the results."""

    name: str | None = None
    """Name as in the run; None if unknown."""
    uri: str | None = None
    """URI of its horizontal part at the OGC; None without an EPSG code."""
    to_wgs84: str | None = None
    """PROJ's description of the transformation to WGS 84; None if the CRS is unknown."""
    accuracy_m: float | None = None
    """Accuracy of that transformation in metres; None if PROJ gives none."""
    vertical_unit_m: float | None = None
    """Metres per unit of the columns that are elevations; None if unknown, as in older results."""

    @classmethod
    def of(cls, crs: RunCrs) -> ResultsCrs:
        """That of a run."""
        accuracy_m = None if crs.to_degrees is None else crs.to_degrees.accuracy
        return cls(
            name=crs.name,
            uri=crs.storage_uri,
            to_wgs84=None if crs.to_degrees is None else crs.to_degrees.description,
            accuracy_m=None if accuracy_m is None or accuracy_m < 0 else float(accuracy_m),
            vertical_unit_m=crs.vertical_unit_m,
        )

    @property
    def is_known(self) -> bool:
        """Whether there are coordinates in WGS 84."""
        return self.to_wgs84 is not None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Catalogue:
    """The content of a folder of outputs."""

    outputs: Mapping[str, StoredOutput]
    """By id, in the order of the process's table."""
    crs: ResultsCrs = ResultsCrs()
    """The CRS of the results; unknown for results without coordinates of their own."""
    n_buildings: int = 0
    """Rows of the buildings table."""
    runs: tuple[str, ...] = ()
    """Labels of the runs of a comparison, each with its own folder of outputs; empty otherwise."""

    def write(self, out_dir: Path) -> None:
        """Write the catalogue of a folder, whose outputs are complete."""
        from pipeline.io.storage import LocalStorage

        text = json.dumps(dataclasses.asdict(self), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        LocalStorage(root=out_dir).put(NAME, text.encode())

    @classmethod
    def from_json(cls, text: str) -> Catalogue:
        """The inverse of what `write` writes."""
        found: dict[str, Any] = json.loads(text)
        return cls(
            outputs={name: StoredOutput(**entry) for name, entry in found["outputs"].items()},
            crs=ResultsCrs(**found["crs"]),
            n_buildings=found["n_buildings"],
            runs=tuple(found.get("runs", ())),
        )

    def missing(self, output_id: str) -> NoSuchOutputError:
        """The error for a missing output, with the list of existing ones."""
        there = ", ".join(self.outputs) or "none"
        if self.runs and output_id in OUTPUTS:
            problem = f"{output_id} is an output of each of this job's runs: add ?method= and one of"
            return NoSuchOutputError(f"{problem} {', '.join(self.runs)}")
        if output_id not in KINDS:
            return NoSuchOutputError(f"there is no output {output_id[:80]!r}; this job has: {there}")
        return NoSuchOutputError(f"the request left out {output_id}, or the job had nothing for it; it has: {there}")


NOTHING_YET = Catalogue(outputs={}, crs=ResultsCrs(to_wgs84=""))
"""The catalogue of a job that runs and shows no buildings yet; any coordinates may be asked for."""


def stored_outputs(out_dir: Path, kinds: Iterable[OutputKind]) -> dict[str, StoredOutput]:
    """The entries of some outputs, whose files are complete."""
    from pipeline.io.storage import sha256_of

    paths = {kind.output_id: out_dir / kind.filename for kind in kinds}
    return {name: StoredOutput(size_bytes=path.stat().st_size, sha256=sha256_of(path)) for name, path in paths.items()}


def run_outputs(out_dir: Path, label: str) -> Path:
    """The folder of outputs of one run of a comparison, below those of the comparison."""
    return out_dir / "runs" / label


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
    """The file of an output.

    Raises
    ------
    NoSuchOutputError
        The process has no such output, the request left it out, or its file is gone.
    """
    catalogue = read_catalogue(out_dir)
    if output_id not in catalogue.outputs:
        raise catalogue.missing(output_id)
    path = out_dir / KINDS[output_id].filename
    if not path.is_file():
        raise NoSuchOutputError(f"the file of {output_id} is no longer in the state folder: submit the job again")
    return path
