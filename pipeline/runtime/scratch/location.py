"""The place of a run's scratch: in the run directory, in a folder that the user names, or on this machine."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

from pipeline.errors import RunError
from pipeline.io import is_url, shown
from pipeline.runtime.scratch.folder import Scratch

SCRATCH = "scratch"
"""In the run directory."""


def check_scratch(run_dir: str, scratch: str | None, scheduler: str | None) -> None:
    """Refuse a run whose workers would have no common scratch: the folder that the user names, if any.

    Raises RunError if the run directory is a URL, the workers are elsewhere (a scheduler's address is given), and no
    folder is named; or if the folder is a URL itself.
    """
    if scratch is not None and is_url(scratch):
        raise RunError(f"the scratch {shown(scratch)} is a URL: give a folder, such as --scratch /data/scratch")
    if scratch is None and is_url(run_dir) and scheduler is not None:
        raise RunError(
            f"{shown(run_dir)} is no folder, so the workers of {scheduler} have no scratch: give a folder that all of "
            "them and this machine see, by --scratch DIR"
        )


@contextlib.contextmanager
def run_scratch(run_dir: str, scratch: str | None) -> Iterator[Scratch]:
    """Scratch for the duration of a run; raises RunError if scratch of an earlier run cannot be removed."""
    with contextlib.ExitStack() as stack:
        if scratch is None and is_url(run_dir):
            from pipeline.io.temporary import temporary_folder

            # no other user can guess its name, or look into it: tasks trust what they read from scratch
            folder = stack.enter_context(temporary_folder()) / SCRATCH
        else:
            folder = _scratch_folder(run_dir, scratch)
        found = Scratch(str(folder / uuid4().hex))
        found.create()
        try:
            yield found
        finally:
            remove_folder(folder)


def _scratch_folder(run_dir: str, scratch: str | None) -> Path:
    """The folder for the scratch of a run; what an earlier run into the same place left there is removed."""
    if scratch is None:
        folder = Path(run_dir).resolve() / SCRATCH
    else:
        place = run_dir if is_url(run_dir) else str(Path(run_dir).resolve())
        # one per run directory: several runs may share a disk for scratch
        name = hashlib.sha256(place.encode()).hexdigest()[:16]
        folder = Path(scratch).resolve() / f"gablework-{name}"
    remove_folder(folder)
    return folder


def remove_folder(folder: Path) -> None:
    """Rename a folder of scratch, then remove it: no late task of an earlier run can find it and fill it again.

    Raises RunError if it cannot be renamed.
    """
    if folder.exists():
        doomed = folder.with_name(f".{folder.name}.{uuid4().hex}")
        try:
            folder.rename(doomed)
        except OSError as error:
            raise RunError(f"{folder} cannot be removed: {error.strerror or error}") from error
        shutil.rmtree(doomed, ignore_errors=True)
