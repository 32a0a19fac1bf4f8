"""Tables of a finished run's figures, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table


def statistics_tables(statistics: Mapping[str, Any]) -> list[Table]:
    """The figures of `run_statistics` as rich tables for a terminal."""
    tables = [_outcome_table(statistics), _count_table("Roof types", "type", statistics["roof_types"])]
    if statistics["rejected_reasons"]:
        tables.append(_count_table("Rejected objects", "reason", statistics["rejected_reasons"]))
    tables.append(_quantile_table(statistics))
    return tables


def _outcome_table(statistics: Mapping[str, Any]) -> Table:
    """Statuses with their shares, and their reasons beneath."""
    table = Table(title="Candidates", title_justify="left")
    table.add_column("status")
    table.add_column("reason")
    table.add_column("count", justify="right")
    table.add_column("share", justify="right")
    for status, count in statistics["statuses"].items():
        share = statistics["shares"][status]
        table.add_row(status, "", str(count), "" if share is None else f"{share:.1%}")
        for reason, number in statistics["reasons"].get(status, {}).items():
            table.add_row("", reason, str(number), f"{number / statistics['candidates']:.1%}")
    table.add_section()
    table.add_row("all", "", str(statistics["candidates"]), "")
    return table


def _count_table(title: str, header: str, counts: Mapping[str, int]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(header)
    table.add_column("count", justify="right")
    for name, count in counts.items():
        table.add_row(name, str(count))
    return table


def _quantile_table(statistics: Mapping[str, Any]) -> Table:
    """Quantiles of the figures over the buildings."""
    table = Table(title="Over the buildings", title_justify="left")
    table.add_column("figure")
    names = list(
        dict.fromkeys(name for quantiles in statistics["quantiles"].values() for name in quantiles if name != "n")
    )
    for name in names:
        table.add_column(name, justify="right")
    table.add_column("n", justify="right")
    for figure, quantiles in statistics["quantiles"].items():
        values = ["" if quantiles[name] is None else f"{quantiles[name]:.3f}" for name in names]
        table.add_row(figure, *values, str(quantiles["n"]))
    return table
