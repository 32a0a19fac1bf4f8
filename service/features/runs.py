"""Runs that are served as collections: those that the operator publishes, and those of finished jobs."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from service.errors import NoSuchCollectionError, StartUpError

TABLES = ("buildings", "planes", "rejected")
"""Tables of a run that are collections, by the names of the layers of a GeoPackage."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_LIKE_A_JOB = re.compile(r"[0-9a-f]{32}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServedRun:
    """A run whose tables are collections."""

    name: str
    """First part of the ids of its collections: the published name, or the job, or JOB.METHOD of a comparison."""
    place: str
    """The run directory, a path or a URL; no answer shows it."""
    index_dir: Path
    """Folder of its index; made when it is needed."""
    is_job: bool
    """Whether it belongs to a job: such a run never changes."""

    def collection_id(self, table: str) -> str:
        """The id of the collection of a table.

        >>> ServedRun(name="delft", place="/runs/delft", index_dir=Path("i"), is_job=False).collection_id("planes")
        'delft.planes'
        """
        return f"{self.name}.{table}"


def split_id(collection_id: str) -> tuple[str, str]:
    """The name of the run and the table of a collection's id.

    Raises
    ------
    NoSuchCollectionError
        There is no such table.
    """
    name, _, table = collection_id.rpartition(".")
    if not name or table not in TABLES:
        raise NoSuchCollectionError(
            f"there is no collection {collection_id[:80]!r}: an id is RUN.TABLE with a table of {', '.join(TABLES)}; "
            "/collections lists all"
        )
    return name, table


def published_runs(entries: Sequence[str], state: Path) -> Mapping[str, ServedRun]:
    """The runs of the setting `publish` by their names, in the given order.

    Parameters
    ----------
    entries : sequence of str
        Run directories or their URLs, each as RUN or NAME=RUN; without a name the last part of the path is the name.
    state : Path
        The state folder, which holds their indexes.

    Raises
    ------
    StartUpError
        A name cannot be part of a URL, can be the id of a job, or is given twice.

    Examples
    --------
    >>> list(published_runs(["/srv/models_2024/", "old=s3://city/models"], Path("state")))
    ['models_2024', 'old']
    """
    found: dict[str, ServedRun] = {}
    for entry in entries:
        name, given, place = entry.partition("=")
        if not given or "/" in name:
            place, name = entry, entry.rstrip("/").rpartition("/")[2]
        fix = "give NAME=RUN with a name of letters, digits, - and _"
        if not _NAME.fullmatch(name) or _LIKE_A_JOB.fullmatch(name):
            raise StartUpError(f"the published run {entry!r} would have the name {name!r}: {fix}")
        if name in found:
            raise StartUpError(f"two published runs have the name {name!r}: {fix}")
        found[name] = ServedRun(name=name, place=place, index_dir=state / "features", is_job=False)
    return found


def version_of(place: str, *facts: object) -> str:
    """A short text that differs for another place or state of a run; part of a file's name."""
    return hashlib.sha256(repr((place, facts)).encode()).hexdigest()[:24]
