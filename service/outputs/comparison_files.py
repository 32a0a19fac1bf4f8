"""Assembles the outputs of a finished comparison: those of each run, then those of all runs together."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from markupsafe import escape

from pipeline.ruler.evaluation.markdown import markdown_cell
from service.outputs.assemble import Progress, write_outputs
from service.outputs.catalogue import Catalogue, read_catalogue, run_outputs, stored_outputs
from service.outputs.kinds import COMPARISON_OUTPUTS, chosen
from service.outputs.output_files import zip_files, zip_text
from service.outputs.report import cleaner

RUNS = "runs"
"""Folder of the run directories below the comparison's."""

_TEXTS = frozenset({".json", ".html", ".md"})
"""Endings of files that may contain paths of inputs; tables and models do not."""

_PARTS = 100
"""Parts of the work for one run, when progress is counted; a file of the archive is one."""

_KEPT_BACK = frozenset({"quarantine", "scratch"})
"""Folders of a run that are not results."""


def _nothing(done: int, total: int) -> None:
    del done, total


def write_comparison_outputs(
    folder: Path,
    labels: Sequence[str],
    out_dir: Path,
    wanted: Sequence[str] | None = None,
    on_progress: Progress = _nothing,
) -> None:
    """Write the outputs of a finished comparison.

    Each run gets all outputs of a run in its own folder: its buildings can be requested like those of a reconstruction.
    No output names a folder of the server: only the file name of a path remains.

    Parameters
    ----------
    folder : Path
        The comparison's folder: `index.html`, `compare.json`, `buildings.parquet` and `runs/<label>/`.
    labels : sequence of str
        The runs, in the order of the comparison.
    out_dir : Path
        Folder to write into; made if it is missing.
    wanted : sequence of str, optional
        Ids of `COMPARISON_OUTPUTS`; all by default.
    on_progress : callable
        Gets how much is done, and of how much. An exception from it ends the work.

    Raises
    ------
    NoSuchOutputError
        `wanted` holds an unknown id.
    RunError
        A run did not end, or its files are damaged.
    OSError
        A file is missing, or the folder cannot be written.
    """
    from pipeline.io.storage import LocalStorage

    kinds = chosen(wanted, COMPARISON_OUTPUTS)
    files = sorted(_files(folder))
    done, total = 0, len(labels) * _PARTS + len(files)
    for label in labels:

        def progress(part: int, of: int, before: int = done) -> None:
            on_progress(before + _PARTS * part // max(of, 1), total)

        write_outputs(folder / RUNS / label, run_outputs(out_dir, label), on_progress=progress)
        done += _PARTS
    clean = _cleaner(folder, labels)
    storage = LocalStorage(root=out_dir)
    for kind in kinds:
        source = folder / kind.filename
        if kind.output_id == "archive":
            with storage.putting(kind.filename) as path, zipfile.ZipFile(path, "w") as archive:
                for name in files:
                    on_progress(done, total)
                    done += 1
                    _add(archive, folder, name, clean)
        elif source.suffix in _TEXTS:
            storage.put(kind.filename, _cleaned(source, clean).encode())
        else:
            storage.put(kind.filename, source.read_bytes())
    first = read_catalogue(run_outputs(out_dir, labels[0]))
    catalogue = Catalogue(
        outputs=stored_outputs(out_dir, kinds), crs=first.crs, n_buildings=first.n_buildings, runs=tuple(labels)
    )
    catalogue.write(out_dir)
    on_progress(total, total)


def _files(folder: Path) -> Iterator[str]:
    """The files of the archive, relative to the folder."""
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        hidden = any(part.startswith(".") or part in _KEPT_BACK for part in name.parts)
        if path.is_file() and not hidden:
            yield name.as_posix()


def _add(archive: zipfile.ZipFile, folder: Path, name: str, clean: Callable[[str], str]) -> None:
    if (folder / name).suffix in _TEXTS:
        zip_text(archive, name, _cleaned(folder / name, clean))
    else:
        zip_files(archive, folder, [name])


def _cleaner(folder: Path, labels: Sequence[str]) -> Callable[[str], str]:
    """A function that removes the server's folders from a text, also as escaped in a page."""
    manifests = [json.loads((folder / RUNS / label / "run.json").read_text(encoding="utf-8")) for label in labels]
    paths = {entry["path"] for manifest in manifests for entry in manifest["inputs"]}
    # the request repeats them with links resolved
    requests = [manifest.get("request", {}) for manifest in manifests]
    asked = {request.get(name) for request in requests for name in ("footprints", "guides", "overrides", "aoi")}
    paths |= {path for path in asked if path is not None}
    written = paths | {str(escape(path)) for path in paths} | {markdown_cell(path) for path in paths}
    return cleaner(sorted(written), folder)


def _cleaned(path: Path, clean: Callable[[str], str]) -> str:
    """The text of a file without the server's folders and machines."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        # cleans the values: a path may be written with escapes
        document = _mapped(json.loads(text), clean)
        if path.name == "run.json":
            # the name of a process contains that of its machine
            peaks = document["peak_memory_bytes"].values()
            document["peak_memory_bytes"] = {f"process {n}": peak for n, peak in enumerate(peaks, start=1)}
        return json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    return clean(text)


def _mapped(value: Any, clean: Callable[[str], str]) -> Any:
    """A JSON value with every text in it cleaned."""
    if isinstance(value, str):
        return clean(value)
    if isinstance(value, list):
        return [_mapped(item, clean) for item in value]
    if isinstance(value, dict):
        return {name: _mapped(item, clean) for name, item in value.items()}
    return value
