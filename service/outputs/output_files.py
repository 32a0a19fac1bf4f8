"""Files of outputs: zip files without times."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

_EPOCH = (1980, 1, 1, 0, 0, 0)
_FILE_MODE = 0o100644 << 16


def zip_files(archive: zipfile.ZipFile, run_dir: Path, names: list[str]) -> None:
    """Add files of a run under their own names, streamed, without times: the same files give the same bytes.

    Parameters
    ----------
    archive : ZipFile
        Open for writing.
    run_dir : Path
        The run directory.
    names : list of str
        Paths relative to it, in the order of the archive.
    """
    for name in names:
        entry = _entry(name)
        source_path = run_dir / name
        entry.file_size = source_path.stat().st_size
        with source_path.open("rb") as source, archive.open(entry, "w") as target:
            shutil.copyfileobj(source, target)


def zip_text(archive: zipfile.ZipFile, name: str, text: str) -> None:
    """Add a text as a file, also without a time."""
    archive.writestr(_entry(name), text.encode())


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, date_time=_EPOCH)
    entry.compress_type = zipfile.ZIP_STORED if name.endswith(".laz") else zipfile.ZIP_DEFLATED
    entry.external_attr = _FILE_MODE
    return entry
