"""Zip files without times, and the lines of one building in an OBJ file."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator
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


def building_lines(path: Path, building_id: str) -> Iterator[str]:
    r"""The lines of one building in an OBJ file that may hold several, with its vertices counted from 1.

    Objects are named after the building and the number of the solid; comments before the first object are kept.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "tile.obj"
    ...     _ = path.write_text("# m\no a-0\nv 0 0 0\nf 1 1 1\no b-0\nv 1 1 1\nf 2 2 2\n")
    ...     list(building_lines(path, "b"))
    ['# m', 'o b-0', 'v 1 1 1', 'f 1 1 1']
    """
    mine, seen, before = False, 0, 0
    with path.open(encoding="ascii") as stream:
        for raw in stream:
            line = raw.rstrip("\n")
            kind, _, rest = line.partition(" ")
            if kind == "#":
                yield line
                continue
            if kind == "o":
                if rest.rpartition("-")[0] == building_id:
                    # solids of one building follow one another
                    before = before if mine else seen
                    mine = True
                elif mine:
                    return
            seen += kind == "v"
            if mine:
                yield line if kind != "f" else "f " + " ".join(str(int(i) - before) for i in rest.split())
