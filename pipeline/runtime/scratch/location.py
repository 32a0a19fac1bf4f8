"""Where the scratch of a run is: in the run directory, in a folder that the user names, or on this machine."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from pathlib import Path
from uuid import uuid4

from pipeline.errors import RunError
from pipeline.io import is_url, shown

SCRATCH = "scratch"
"""In the run directory."""


def check_scratch(work_dir: str, scratch: str | None, scheduler: str | None) -> None:
    """Refuse a run whose workers would have no common scratch.

    Parameters
    ----------
    work_dir : str
        The run directory, a path or URL.
    scratch : str or None
        The folder that the user names.
    scheduler : str or None
        The address of workers elsewhere; None where they are this machine's.

    Raises
    ------
    RunError
        The run directory is a URL, the workers are elsewhere, and no folder is named; or that is a URL itself.
    """
    if scratch is not None and is_url(scratch):
        raise RunError(f"the scratch {shown(scratch)} is a URL: give a folder, such as --scratch /data/scratch")
    if scratch is None and is_url(work_dir) and scheduler is not None:
        raise RunError(
            f"{shown(work_dir)} is no folder, so the workers of {scheduler} have no scratch: give a folder that all of "
            "them and this machine see, by --scratch DIR"
        )


def scratch_folder(work_dir: str, scratch: str | None) -> Path:
    """The folder of a run's scratch, without what an earlier run into the same place left there.

    Parameters
    ----------
    work_dir : str
        The run directory, a path or URL.
    scratch : str or None
        The folder that the user names.

    Raises
    ------
    RunError
        What is left there cannot be removed.
    """
    if scratch is None and is_url(work_dir):
        # nobody else can guess its name, or look into it: what is read from scratch is trusted
        return Path(tempfile.mkdtemp(prefix="gablework-"))
    if scratch is None:
        folder = Path(work_dir).resolve() / SCRATCH
    else:
        place = work_dir if is_url(work_dir) else str(Path(work_dir).resolve())
        # one a run directory: several runs may share a disk for scratch
        name = hashlib.sha256(place.encode()).hexdigest()[:16]
        folder = Path(scratch).resolve() / f"gablework-{name}"
    remove_folder(folder)
    return folder


def remove_folder(folder: Path) -> None:
    """Remove a folder of scratch: renamed first, so that no late task of an earlier run finds it and fills it again.

    Raises
    ------
    RunError
        It cannot be renamed.
    """
    if folder.exists():
        doomed = folder.with_name(f".{folder.name}.{uuid4().hex}")
        try:
            folder.rename(doomed)
        except OSError as error:
            raise RunError(f"{folder} cannot be removed: {error.strerror or error}") from error
        shutil.rmtree(doomed, ignore_errors=True)
