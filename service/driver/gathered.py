"""The inputs that an attempt has gathered, in a file beside them: an attempt that resumes need not fetch them again."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import TypeAdapter

from service.fetching import JobFiles
from service.jobs import JobRequest

_LIST = "gathered.json"
_FILES = TypeAdapter(JobFiles)


def note_gathered(inputs: Path, files: JobFiles) -> None:
    """Write which inputs are there.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    inputs.mkdir(parents=True, exist_ok=True)
    new = inputs / f".{_LIST}"
    sizes = [one.path.stat().st_size for one in files.all]
    new.write_text(json.dumps({"files": _FILES.dump_python(files, mode="json"), "sizes": sizes}))
    new.rename(inputs / _LIST)


def gathered_before(inputs: Path, request: JobRequest) -> JobFiles | None:
    """The inputs that an attempt before has gathered, if all are there as they were; None otherwise."""
    try:
        noted = json.loads((inputs / _LIST).read_text())
        files = _FILES.validate_python(noted["files"])
        are_same = [one.path.stat().st_size for one in files.all] == noted["sizes"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    wanted = {*request.tiles, request.footprints, request.guides} - {None}
    return files if are_same and {one.reference for one in files.all} == wanted else None
