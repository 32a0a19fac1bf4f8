"""Some buildings of an OBJ file, without a numerical library."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator


def lines_of_buildings(lines: Iterable[str], kept: Collection[str]) -> Iterator[str]:
    r"""The lines of some buildings of a file of `pipeline.export.obj`, with their vertices counted from 1.

    Objects are named after the building and the number of the solid; those of one building follow one another. Comments
    before the last of these buildings are kept.

    Examples
    --------
    >>> text = "# m\no a-0\nv 0 0 0\nf 1 1 1\no b-0\nv 1 1 1\nf 2 2 2\no c-0\nv 2 2 2\nf 3 3 3"
    >>> list(lines_of_buildings(text.split("\n"), ["b"]))
    ['# m', 'o b-0', 'v 1 1 1', 'f 1 1 1']
    >>> list(lines_of_buildings(text.split("\n"), ["a", "c"]))[-3:]
    ['o c-0', 'v 2 2 2', 'f 2 2 2']
    """
    waiting, current, skipped = set(kept), "", 0
    for line in lines:
        kind, _, rest = line.partition(" ")
        if kind == "o" and (name := rest.rpartition("-")[0]) != current:
            waiting.discard(current)
            if not waiting:
                return
            current = name
        if current and current not in waiting:
            skipped += kind == "v"
        elif kind == "f":
            yield "f " + " ".join(str(int(vertex) - skipped) for vertex in rest.split())
        else:
            yield line
