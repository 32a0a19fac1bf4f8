"""Readers of models of any program: run directories, CityJSON, CityJSONSeq and OBJ."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from pipeline.errors import InputError
from pipeline.io import is_url, shown
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.ruler.evaluation.reading.cityjson_models import is_cityjson, read_cityjson_files, read_cityjsonseq_files
from pipeline.ruler.evaluation.reading.collected import Collected, Kind
from pipeline.ruler.evaluation.reading.obj_models import read_obj_files
from pipeline.ruler.evaluation.reading.run_models import is_run, read_run

CITYJSON = (".city.json", ".json")
CITYJSONSEQ = (".city.jsonl", ".jsonl")
OBJ = (".obj",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reader:
    """A reader of one format."""

    description: str
    """The format, for messages."""
    recognises: Callable[[Path], bool]
    """Whether a path has this format, by its name and content."""
    read: Callable[[Path], ModelSet]


def read_models(path: str | Path) -> ModelSet:
    """The models of a file or folder, in metres.

    The path is a run directory, or its URL; the truth of a simulated data set; a CityJSON, CityJSONSeq or OBJ file; or
    a folder of such files of one kind, with its subfolders. Raises InputError if it has no format that can be read, is
    broken, or its coordinates are degrees, and RunError if a run directory is damaged.
    """
    if isinstance(path, str) and is_url(path):
        if is_run(path):
            return read_run(path)
        raise InputError(shown(path), "no run directory is there", "Give one, or fetch the files of other programs")
    place = Path(path)
    if not place.exists():
        raise InputError(str(place), "nothing is there", f"Give one of: {_readable()}")
    for reader in READERS:
        if reader.recognises(place):
            return reader.read(place)
    raise InputError(str(place), _what_is_there(place), f"Give one of: {_readable()}")


def _readable() -> str:
    return "; ".join(reader.description for reader in READERS)


def _what_is_there(place: Path) -> str:
    """Why a path cannot be read."""
    if place.is_file():
        return f"a file that ends in {place.suffix!r} holds no models" if place.suffix else "not a file with models"
    runs = sorted(folder.parent for folder in place.glob("*/buildings") if folder.is_dir())
    if runs:
        return f"no models by themselves, but a run directory in {runs[0].name}"
    kinds = [", ".join(endings) for endings in (CITYJSON, CITYJSONSEQ, OBJ) if _files(place, endings)]
    if len(kinds) > 1:
        return f"files of several kinds ({'; '.join(kinds)}), which may be the same models"
    return "a folder without files of models"


def _files(place: Path, endings: tuple[str, ...]) -> list[Path]:
    """The file, or all files below a folder with one of the endings, sorted, without hidden ones and other JSON."""
    if place.is_file():
        return [place] if place.name.lower().endswith(endings) else []
    found = (path for path in place.rglob("*") if path.name.lower().endswith(endings))
    files = sorted(path for path in found if path.is_file() and not path.name.startswith("."))
    return [path for path in files if endings != CITYJSON or _says_cityjson(path)]


def _says_cityjson(path: Path) -> bool:
    """Whether a JSON file is CityJSON by its name or its content."""
    return path.name.lower().endswith(CITYJSON[0]) or is_cityjson(path)


def _only(endings: tuple[str, ...]) -> Callable[[Path], bool]:
    """Whether a path is a file with such an ending, or a folder of such files and of no other kind."""

    def recognises(place: Path) -> bool:
        if not _files(place, endings):
            return False
        others = [other for other in (CITYJSON, CITYJSONSEQ, OBJ) if other != endings]
        return place.is_file() or not (any(_files(place, other) for other in others) or any(place.glob("*/buildings")))

    return recognises


def _reads(
    kind: Kind, endings: tuple[str, ...], read: Callable[[list[Path], Collected], None]
) -> Callable[[Path], ModelSet]:
    """A reader of a file or of a folder of files."""

    def reads(place: Path) -> ModelSet:
        into = Collected()
        files = _files(place, endings)
        read(files, into)
        if len(files) > 1:
            into.note(f"read from {len(files)} files")
        name = place.name
        for ending in endings:
            name = name.removesuffix(ending)
        return into.finish(name=name or str(place), kind=kind, path=str(place))

    return reads


READERS: tuple[Reader, ...] = (
    Reader(
        description="a run directory, or the folder `truth` of a simulated data set (with run.json or buildings/)",
        recognises=is_run,
        read=read_run,
    ),
    Reader(
        description="a CityJSON 1.0, 1.1 or 2.0 file (.city.json, .json), or a folder of them",
        recognises=_only(CITYJSON),
        read=_reads("cityjson", CITYJSON, read_cityjson_files),
    ),
    Reader(
        description="a CityJSONSeq file (.city.jsonl, .jsonl), or a folder of them",
        recognises=_only(CITYJSONSEQ),
        read=_reads("cityjsonseq", CITYJSONSEQ, read_cityjsonseq_files),
    ),
    Reader(
        description="an OBJ file (.obj), or a folder of them",
        recognises=_only(OBJ),
        read=_reads("obj", OBJ, read_obj_files),
    ),
)
"""The readers, in the order in which they are tried."""
