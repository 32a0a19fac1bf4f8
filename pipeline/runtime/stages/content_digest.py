"""The digest of a run, from what its tiles left when they were published: no table is read again.

The task that publishes a tile leaves the hash of each row. Here these are put in the order of their keys: at once for a
small run, else first for groups of tiles, then for ranges of ids. So no task holds the rows of all tiles, and the
driver holds none.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.runtime.cluster.serial_executor import Executor, run_alone
from pipeline.runtime.monitoring.progress import Watch
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import (
    InParts,
    OutcomeTask,
    Place,
    brief_of,
    brief_within,
    drop_outcomes,
    key_of,
    part_of,
    run_and_store,
)

if TYPE_CHECKING:  # these load Arrow, which the driver does not need
    from pipeline.runtime.digest import Rows

TABLES = ("buildings", "planes", "rejected")
"""The tables in the order in which the digest counts them."""
STAGE = "digest"
"""Name of the stage."""
_TILES_AT_ONCE = 256
"""Tiles whose rows one task puts in order."""
_ALPHABET = "234567abcdefghijklmnopqrstuvwxyz"
"""The first letters of ids in their order; each is as frequent, since ids are digests in base 32."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RowsTask:
    """Rows from some outcomes, put in order."""

    sources: tuple[tuple[Place, int], ...]
    """Outcomes, and the first of their parts that is read: one per table follows."""
    scratch: Scratch
    """Holds them."""
    cut: bool = False
    """Whether they are cut by the first letters of their ids."""


def content_digest(executor: Executor, scratch: Scratch, published: Sequence[Place], watch: Watch) -> str:
    """The sha256 of a run's content, from the outcomes of its tiles' publishing; as `pipeline.runtime.digest` has it.

    Raises RunError if an object comes twice, or the scratch cannot be used.
    """
    sources = [(place, 0) for place in published]
    at_once = len(sources) <= _TILES_AT_ONCE
    if not at_once:
        starts = range(0, len(sources), _TILES_AT_ONCE)
        groups = [RowsTask(sources=tuple(sources[k : k + _TILES_AT_ONCE]), scratch=scratch, cut=True) for k in starts]
        found = _ordered(executor, "tiles", groups, watch)
        ranges = range(len(_ALPHABET))
        ids = [RowsTask(sources=tuple((one, len(TABLES) * k) for one in found), scratch=scratch) for k in ranges]
        sources = [(place, 0) for place in _ordered(executor, "ids", ids, watch)]
    last = RowsTask(sources=tuple(sources), scratch=scratch)
    digest = run_alone(executor, STAGE, digest_of_tiles if at_once else digest_in_order, last, watch)
    drop_outcomes(scratch, STAGE, ())
    return digest


def _ordered(executor: Executor, unit: str, tasks: Sequence[RowsTask], watch: Watch) -> list[Place]:
    """Run tasks that put rows in order; where their outcomes are, in the order of the tasks."""
    places = [Place(STAGE, unit, key_of(unit, number)) for number in range(len(tasks))]
    works = [
        OutcomeTask(
            function=rows_in_order, task=task, place=place, scratch=task.scratch, brief=brief_within, stage=STAGE
        )
        for place, task in zip(places, tasks, strict=True)
    ]
    with contextlib.closing(executor.map(STAGE, run_and_store, works, watch)) as running:
        for _ in running:
            pass
    return places


def rows_in_order(task: RowsTask) -> InParts[tuple[int, ...]]:
    """The rows of some outcomes in order, table by table; if they are cut, one range of ids after the other.

    The brief has the number of rows in each part.
    """
    tables = _merged(task)
    inner = [letter.encode() for letter in _ALPHABET[1:]] if task.cut else []
    edges: list[bytes | None] = [b"", *inner, None]
    parts = [rows.between(low or b"", high) for low, high in itertools.pairwise(edges) for rows in tables]
    return InParts(parts=tuple(parts), brief=tuple(len(rows.hashes) for rows in parts))


def digest_of_tiles(task: RowsTask) -> str:
    """The digest of a run from the rows of its tiles."""
    from pipeline.runtime.digest import digest_of  # loads Arrow, which the driver does not need

    tables = zip(TABLES, _merged(task), strict=True)
    return digest_of({name: (len(rows.hashes), [rows.hashes]) for name, rows in tables})


def digest_in_order(task: RowsTask) -> str:
    """The digest of a run from outcomes that follow each other in the order of the ids."""
    from pipeline.runtime.digest import digest_of  # as above

    def hashes_of(number: int) -> Iterator[Any]:
        for place, first in task.sources:
            rows: Rows = part_of(task.scratch, place, first + number)
            yield rows.hashes

    counts = [brief_of(task.scratch, place) for place, _ in task.sources]
    return digest_of(
        {name: (sum(of[number] for of in counts), hashes_of(number)) for number, name in enumerate(TABLES)}
    )


def _merged(task: RowsTask) -> list[Rows]:
    """The rows of all sources in order, by table."""
    from pipeline.runtime.digest import merged  # as above

    return [
        merged(name, [part_of(task.scratch, place, first + number) for place, first in task.sources])
        for number, name in enumerate(TABLES)
    ]
