"""A vector file in a zip archive, unpacked for as long as it is read."""

from __future__ import annotations

import contextlib
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NoReturn

from pipeline.errors import UnreadableInputError
from pipeline.extras.vector_files.gdal_source import VALID
from pipeline.extras.vector_files.nearby import Shape
from pipeline.io.formats import CONVERT, LAS, UNREAD_VECTORS, VECTOR_FILE_SUFFIXES, first_bytes
from pipeline.io.library_faults import in_our_words
from pipeline.io.temporary import temporary_folder

ZIP_MAGIC = b"PK\x03\x04"
UNPACKED_LIMIT = 2**32
"""Maximum number of bytes of what is read of a zip archive, when it is unpacked."""
_ENCRYPTED = 1
"""The flag of an encrypted member."""
SHAPE_PARTS = (".shp", ".shx", ".dbf", ".prj", ".cpg", ".cst")
"""Files that make a Shapefile."""


@contextlib.contextmanager
def unpacked(path: Path, layer: str | None, shape: Shape) -> Iterator[tuple[Path, str | None]]:
    """The vector file in a zip archive, for as long as it is read, and the layer in it; any other file as it is.

    Of several files the layer names one. Raises UnreadableInputError if the archive is damaged, encrypted or too
    large, or if it is not clear which file is meant.
    """
    if not first_bytes(path).startswith(ZIP_MAGIC):
        yield path, layer
        return
    with temporary_folder() as folder:
        with in_our_words(path, "a zip archive", "Pack it again, or give the file in it"):
            with zipfile.ZipFile(path) as archive:
                members, of_several = _chosen(path, archive.infolist(), layer, shape)
                for member in members:
                    place = PurePosixPath(member.filename)
                    with archive.open(member) as packed, (folder / _plain_name(place)).open("wb") as to:
                        shutil.copyfileobj(packed, to)
            first = PurePosixPath(members[0].filename)
        yield folder / _plain_name(first), None if of_several else layer


def _plain_name(place: PurePosixPath) -> str:
    """The name of a member once it is unpacked: programs look for the parts of a Shapefile in small letters."""
    return place.stem + place.suffix.lower()


def vector_members(members: Sequence[zipfile.ZipInfo]) -> dict[str, zipfile.ZipInfo]:
    """The vector files of an archive by the names that choose among them: without folder and ending, if that is clear.

    JSON counts only where nothing else is there: a Shapefile often comes with JSON about it.
    """
    found = [one for one in members if one.filename.lower().endswith(VECTOR_FILE_SUFFIXES)]
    found = [one for one in found if "__MACOSX/" not in one.filename]
    found = [one for one in found if not one.filename.lower().endswith(".json")] or found
    by_stem = {PurePosixPath(one.filename).stem: one for one in found}
    return by_stem if len(by_stem) == len(found) else {one.filename: one for one in found}


def refuse_without_vectors(path: Path, members: Sequence[zipfile.ZipInfo]) -> NoReturn:
    """Refuse an archive without a vector file, by what else is in it; raises UnreadableInputError."""
    names = [one.filename.lower() for one in members]
    for ending, kind in UNREAD_VECTORS.items():
        if any(name.endswith(ending) for name in names):
            raise UnreadableInputError(str(path), f"{kind} is not read", CONVERT)
    if any(name.endswith(LAS.suffixes) for name in names):
        raise UnreadableInputError(str(path), "it is a zip archive of point clouds", "Give each point cloud unpacked")
    raise UnreadableInputError(str(path), "it is a zip archive with 0 vector files", VALID)


def _chosen(
    path: Path, members: Sequence[zipfile.ZipInfo], layer: str | None, shape: Shape
) -> tuple[list[zipfile.ZipInfo], bool]:
    """The vector file of an archive and what belongs to it, and whether the layer chose it among several."""
    there = vector_members(members)
    if not there:
        refuse_without_vectors(path, members)
    of_several = len(there) > 1
    wanted = there.get(layer or "") if of_several else next(iter(there.values()), None)
    if wanted is None:
        problem = f"it is a zip archive with {len(there)} vector files"
        problem += f", none of them {layer!r}" if layer is not None and of_several else ""
        named = ", ".join(sorted(there)[:20])
        raise UnreadableInputError(str(path), problem, f"{shape.choose}: {named}")
    stem = PurePosixPath(wanted.filename).with_suffix("")
    parts = [one for one in members if one.filename.lower().endswith(SHAPE_PARTS)]
    parts = [one for one in parts if PurePosixPath(one.filename).with_suffix("") == stem]
    chosen = [wanted, *(one for one in parts if one is not wanted)]
    size = sum(one.file_size for one in chosen)
    if size > UNPACKED_LIMIT or any(one.flag_bits & _ENCRYPTED for one in chosen):
        problem = f"it unpacks to {size} bytes" if size > UNPACKED_LIMIT else "it is encrypted"
        raise UnreadableInputError(str(path), problem, "Unpack it, and give the file in it")
    return chosen, of_several
