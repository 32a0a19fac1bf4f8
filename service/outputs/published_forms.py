"""A finished run in the formats of `gablework publish`, as outputs of its job.

What is a folder is laid out as the service serves it: `results/<format>/<file>` below the job, and `run/<file>` for the
files of the run. So relative paths in the files, such as those of a catalogue to the run, hold in both places.
"""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pipeline.extras.publish.publishing import FORMS, Form
from pipeline.registry import loaded
from service.outputs.kinds import FORMATS, OUTPUTS
from service.outputs.output_files import zip_files

if TYPE_CHECKING:
    from pipeline.runtime.monitoring.progress import Listener

_TILE = r"x-?\d{1,9}_y-?\d{1,9}"
FILES: Mapping[str, re.Pattern[str]] = MappingProxyType(
    {name: re.compile(form.files, re.ASCII) for name, form in FORMS.items() if form.files}
)
"""The paths of the files below an output that is a folder."""
ROOTS: Mapping[str, str] = MappingProxyType({name: FORMS[name].root for name in FILES})
"""The file to open first, by output."""
RUN_FILE = re.compile(
    rf"(buildings|planes|rejected|decisions)/tile={_TILE}/part-0\.parquet|(cityjson|terrain)/tile={_TILE}/part-0\.city\.jsonl|"
    rf"meshes/(?P<tile>{_TILE})/(?P=tile)(-lod1[23])?\.(obj|glb)",
    re.ASCII,
)
"""Matches the files of a run that a catalogue lists."""


def _nothing(done: int, total: int) -> None:
    del done, total


def publish(
    run_dir: Path,
    out_dir: Path,
    formats: Sequence[str],
    *,
    name: str,
    geoid_height_m: float | None = None,
    on_progress: Callable[[int, int], None] = _nothing,
) -> dict[str, Exception]:
    """Write a finished run in some formats, beside its outputs; returns why those that are missing could not be made.

    A format that fails leaves nothing behind. The caller must report its error, which may be unexpected.

    Parameters
    ----------
    run_dir : Path
        A run directory whose run ended.
    out_dir : Path
        The folder of outputs; made if it is missing.
    formats : sequence of str
        Words of `FORMATS`.
    name : str
        Name of the run in a catalogue.
    geoid_height_m : float, optional
        Height of the geoid above the ellipsoid, for 3D Tiles.
    on_progress : callable
        Gets the number of finished formats and of all, after each tile, too. RunCancelledError from it
        ends the work.

    Raises
    ------
    OSError
        The folder cannot be made.
    MemoryError
        A format does not fit into memory.
    """
    from pipeline.errors import RunCancelledError

    # what is about the run as a whole names folders of the server
    options = {"name": name, "geoid_height_m": geoid_height_m, "documents": ()}
    problems: dict[str, Exception] = {}
    out_dir.mkdir(parents=True, exist_ok=True)
    for done, form in enumerate(formats):

        def heard(_event: Any, done: int = done) -> None:
            on_progress(done, len(formats))

        on_progress(done, len(formats))
        try:
            _write(FORMS[form], run_dir, out_dir, options, heard)
        except (RunCancelledError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - the caller reports it
            problems[form] = error
            shutil.rmtree(out_dir / form, ignore_errors=True)
            for output_id in FORMATS[form]:
                (out_dir / OUTPUTS[output_id].filename).unlink(missing_ok=True)
    on_progress(len(formats), len(formats))
    return problems


def _write(form: Form, run_dir: Path, out_dir: Path, options: Mapping[str, Any], on_event: Listener) -> None:
    """Write a run in one format, and make its outputs of what was written."""
    given = {name: options[name] for name in form.options}
    given |= {name: str(out_dir / OUTPUTS[output_id].filename) for name, output_id in form.beside.items()}
    first = form.outputs[0]
    place = out_dir / (first.filename if first.holds == "file" else form.name)
    form.write(str(run_dir), str(place), on_event=on_event, **given)
    for output in form.outputs:
        if output.holds == "zip":
            _zip(place, out_dir / output.filename)
        elif output.holds == "root":
            content = loaded(form.moved)((place / form.root).read_bytes(), form.name)
            (out_dir / output.filename).write_bytes(content)
    if first.holds == "zip":
        shutil.rmtree(place)


def _zip(folder: Path, target: Path) -> None:
    """All files of a folder in a zip file, by name."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    with zipfile.ZipFile(target, "w") as archive:
        zip_files(archive, folder, names)


def formats_of(outputs: Sequence[str]) -> tuple[str, ...]:
    """The formats that some outputs need, in the order of `FORMATS`.

    >>> formats_of(["report", "3dtiles-zip", "3dtiles"])
    ('3dtiles',)
    """
    return tuple(form for form, ids in FORMATS.items() if not set(ids).isdisjoint(outputs))
