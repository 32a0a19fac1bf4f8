"""Tables of Markdown whose texts come from anywhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    r"""A Markdown table; columns after the first `texts` are set to the right.

    >>> print(markdown_table(("roof", "m2"), [("a|b", "7")]))
    | roof | m2 |
    | --- | ---: |
    | a\|b | 7 |
    """
    marks = ["---"] * texts + ["---:"] * (len(header) - texts)
    lines = [header, marks, *rows]
    return "\n".join("| " + " | ".join(markdown_cell(text) for text in line) + " |" for line in lines)


def markdown_cell(text: str) -> str:
    """A text that is neither HTML nor the border of a cell."""
    safe = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return safe.replace("|", "\\|").replace("\n", " ").replace("\r", " ")
