"""Tables of a finished run's figures, for people."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class CountTable:
    """A table of texts."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def statistics_tables(statistics: Mapping[str, Any]) -> list[CountTable]:
    """The figures of `run_statistics` as tables."""
    tables = [_outcome_table(statistics), count_table("Roof types", "type", statistics["roof_types"])]
    if statistics["rejected_reasons"]:
        tables.append(count_table("Rejected objects", "reason", statistics["rejected_reasons"]))
    return [*tables, quantile_table("Over the buildings", statistics["quantiles"])]


def _outcome_table(statistics: Mapping[str, Any]) -> CountTable:
    """Statuses with their shares, and their reasons beneath."""
    rows: list[tuple[str, ...]] = []
    for status, count in statistics["statuses"].items():
        share = statistics["shares"][status]
        rows.append((status, "", f"{count:,}", "" if share is None else f"{100.0 * share:.1f} %"))
        for reason, number in statistics["reasons"].get(status, {}).items():
            rows.append(("", reason, f"{number:,}", f"{100.0 * number / statistics['candidates']:.1f} %"))
    rows.append(("all", "", f"{statistics['candidates']:,}", ""))
    return CountTable(title="Candidates", header=("status", "reason", "count", "share"), rows=tuple(rows))


def count_table(title: str, header: str, counts: Mapping[str, int]) -> CountTable:
    """Counts by name."""
    rows = tuple((name, f"{count:,}") for name, count in counts.items())
    return CountTable(title=title, header=(header, "count"), rows=rows)


def quantile_table(title: str, quantiles: Mapping[str, Mapping[str, float | int | None]]) -> CountTable:
    """Quantiles of figures with their number `n`; nothing for an unknown one."""
    names = list(dict.fromkeys(name for figures in quantiles.values() for name in figures if name != "n"))
    rows = tuple(
        (figure, *("" if known[name] is None else f"{known[name]:,.3f}" for name in names), f"{known['n']:,}")
        for figure, known in quantiles.items()
    )
    return CountTable(title=title, header=("figure", *names, "n"), rows=rows)
