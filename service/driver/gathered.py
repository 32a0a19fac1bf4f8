"""The inputs that an attempt has gathered, in a file beside them: an attempt that resumes need not fetch them again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.fetching import Fetched, JobFiles
from service.jobs import InputReference, JobRequest

_LIST = "gathered.json"


def note_gathered(inputs: Path, files: JobFiles) -> None:
    """Write which inputs are there.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    inputs.mkdir(parents=True, exist_ok=True)
    new = inputs / f".{_LIST}"
    new.write_text(json.dumps([_plain(one) for one in files.all]))
    new.rename(inputs / _LIST)


def gathered_before(inputs: Path, request: JobRequest) -> JobFiles | None:
    """The inputs that an attempt before has gathered, if all are there as they were; None otherwise."""
    try:
        listed = json.loads((inputs / _LIST).read_text())
        found = {reference: fetched for entry in listed for reference, fetched in [_fetched(entry)]}
        optional = [None if one is None else found[one] for one in (request.footprints, request.guides)]
        return JobFiles(tiles=[found[tile] for tile in request.tiles], footprints=optional[0], guides=optional[1])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _plain(one: Fetched) -> dict[str, Any]:
    return {
        "kind": one.reference.kind,
        "value": one.reference.value,
        "path": str(one.path),
        "size": one.path.stat().st_size,
        "points": one.points,
        "sha256": one.sha256,
    }


def _fetched(entry: Mapping[str, Any]) -> tuple[InputReference, Fetched]:
    """An entry of the list; raises ValueError if its file has another size."""
    reference, path = InputReference(kind=entry["kind"], value=entry["value"]), Path(entry["path"])
    if path.stat().st_size != entry["size"]:
        raise ValueError(f"{path} has changed")
    return reference, Fetched(reference=reference, path=path, points=entry["points"], sha256=entry["sha256"])
