"""The outputs of a finished classification: its files under their names, and the catalogue."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from service.outputs.assemble import Progress
from service.outputs.catalogue import Catalogue, stored_outputs
from service.outputs.kinds import CLASSIFICATION_OUTPUTS, RASTERS, chosen
from service.outputs.output_files import zip_files

if TYPE_CHECKING:
    from pipeline.extras.classify.classify import ClassifySummary


def write_classification_outputs(
    summary: ClassifySummary,
    out_dir: Path,
    wanted: Sequence[str] | None,
    on_progress: Progress,
    scrub: Callable[[str], str],
) -> None:
    """Write the outputs of a finished classification. Its own folder is removed: the outputs hold all of it.

    Parameters
    ----------
    summary : ClassifySummary
        What was written, and where.
    out_dir : Path
        Folder to write into; made if it is missing.
    wanted : sequence of str or None
        Ids of `CLASSIFICATION_OUTPUTS`; None for all.
    on_progress : callable
        Gets the number of finished files and of all. An exception from it ends the work.
    scrub : callable
        Removes the paths of this machine from a message.

    Raises
    ------
    NoSuchOutputError
        `wanted` holds an unknown id.
    OSError
        A file is missing, or the folder cannot be written.
    """
    from pipeline.io.storage import LocalStorage

    kinds = chosen(wanted, CLASSIFICATION_OUTPUTS)
    folder, storage = Path(summary.out), LocalStorage(root=out_dir)
    names = [Path(file.path).name for file in summary.files]
    for kind in kinds:
        if kind.output_id == "points":
            with storage.putting(kind.filename) as temporary, zipfile.ZipFile(temporary, "w") as archive:
                for done, name in enumerate(names):
                    on_progress(done, len(names))
                    zip_files(archive, folder, [name])
        elif kind.output_id in RASTERS:
            out_dir.mkdir(parents=True, exist_ok=True)
            (folder / kind.filename).replace(out_dir / kind.filename)
        else:
            storage.put(kind.filename, _counts(summary, scrub))
    on_progress(len(names), len(names))
    Catalogue(outputs=stored_outputs(out_dir, kinds)).write(out_dir)
    shutil.rmtree(folder, ignore_errors=True)


def _counts(summary: ClassifySummary, scrub: Callable[[str], str]) -> bytes:
    """The content of `classes.json`."""
    found = {
        "classes": {str(code): count for code, count in summary.classes.items()},
        "files": [
            {
                "name": Path(file.path).name,
                "points": file.points,
                "classes": {str(c): n for c, n in file.classes.items()},
            }
            for file in summary.files
        ],
        "buildings": summary.buildings,
        "warnings": [scrub(warning) for warning in summary.warnings],
        "timings_s": {name: round(seconds, 3) for name, seconds in summary.timings_s.items()},
    }
    return (json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
