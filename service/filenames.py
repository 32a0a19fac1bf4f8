"""Makes the file names of clients safe, and lists the supported endings."""

from __future__ import annotations

import re
import unicodedata

from pipeline.io.formats import CONVERT, POINT_SUFFIXES, UNREAD_VECTORS, VECTOR_SUFFIXES
from service.errors import RequestError

FOOTPRINT_SUFFIXES = tuple(suffix for suffix in VECTOR_SUFFIXES if suffix != ".shp")
"""Endings of footprints in one file; a Shapefile is several files and is accepted in a zip archive, or by path."""
SUFFIXES = (*POINT_SUFFIXES, *FOOTPRINT_SUFFIXES)
"""Endings of the files that are accepted."""
NAME_LIMIT = 120
"""Maximum bytes of a file's name; a longer stem is cut at its end."""
DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)
"""Names that Windows reserves, with any ending."""
FORBIDDEN = re.compile(r'[<>:"|?*]')
"""Characters that Windows forbids in names."""


def unread(name: str) -> str | None:
    """Why a vector file of this name cannot be sent, with the fix; None if its ending does not say so.

    >>> unread("houses.TAB")
    'MapInfo TAB is not read. Convert it to GeoPackage (.gpkg)'
    """
    if name.lower().endswith(".shp"):
        return "a Shapefile is several files. Send them in a zip archive (.zip)"
    ending = next((ending for ending in UNREAD_VECTORS if name.lower().endswith(ending)), None)
    return None if ending is None else f"{UNREAD_VECTORS[ending]} is not read. {CONVERT}"


def clean_filename(name: str) -> str:
    r"""A name that is safe on every system: no path, no control characters, not too long.

    Raises
    ------
    RequestError
        Nothing is left, or the ending is not that of a supported format.

    >>> clean_filename("../../etc/passwd.laz")
    'passwd.laz'
    >>> clean_filename("C:\\tiles\\Straße 1.las")
    'Straße 1.las'
    >>> clean_filename("con.laz")
    '_con.laz'
    """
    last = re.split(r"[/\\]", unicodedata.normalize("NFC", name))[-1]
    kept = "".join(sign for sign in last if unicodedata.category(sign)[0] != "C")
    cleaned = FORBIDDEN.sub("_", kept).strip(" .")
    suffix = next((ending for ending in SUFFIXES if cleaned.lower().endswith(ending)), "")
    stem = cleaned[: len(cleaned) - len(suffix)].strip(" .")
    if about := unread(cleaned):
        raise RequestError([f"the file {last[:80]!r} cannot be used: {about}"])
    if not suffix or not stem:
        raise RequestError(
            [f"the file's name is {last[:80]!r}: give a name that ends in one of {', '.join(SUFFIXES)}, with a stem"]
        )
    if DEVICES.match(stem):
        stem = "_" + stem
    ending = cleaned[len(cleaned) - len(suffix) :]
    return stem.encode()[: NAME_LIMIT - len(ending)].decode(errors="ignore").rstrip(" .") + ending
