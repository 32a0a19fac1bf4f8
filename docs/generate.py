"""Writes the pages of docs/reference/ that the code itself can tell: settings, command line, exit codes.

`make docs` runs it; tests/00_house/test_docs.py fails where a page says other than the code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import typer

from pipeline.console import EXIT_CODES
from pipeline.settings import RunSettings
from service.cli import app

REFERENCE = Path(__file__).resolve().parent / "reference"
NOTE = "<!-- Written by `make docs` from the code; do not edit. -->"


def cell(text: object) -> str:
    """A value as the cell of a Markdown table."""
    return str(text).replace("|", "\\|").replace("\n", " ")


def table(header: list[str], rows: list[list[object]]) -> list[str]:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell(value) for value in line) + " |" for line in lines]


def exit_codes() -> str:
    """The page of exit codes."""
    rows: list[list[object]] = [[int(code), meaning] for code, meaning in EXIT_CODES.items()]
    lines = [NOTE, "# Exit codes", "", "Every command ends with one of these.", "", *table(["code", "meaning"], rows)]
    return "\n".join(lines) + "\n"


def option_names(parameter: Any) -> str:
    """How an option or argument is written."""
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    names = ", ".join(f"`{name}`" for name in [*parameter.opts, *parameter.secondary_opts])
    return names if parameter.is_flag or not parameter.metavar else f"{names} {cell(parameter.metavar)}"


def default_of(parameter: Any) -> str:
    """The default of an option, as written on the command line."""
    if parameter.required:
        return "required"
    default = parameter.default
    return "" if default is None or default is False or default == () else f"`{default}`"


def command_line() -> str:
    """The page of the command line."""
    group = typer.main.get_command(app)
    lines = [NOTE, "# The command line", ""]
    lines += ["`gablework COMMAND --help` prints the same. How commands end: [exit codes](exit_codes.md).", ""]
    for name, command in sorted(group.commands.items()):  # type: ignore[attr-defined]
        rows: list[list[object]] = [
            [option_names(parameter), default_of(parameter), getattr(parameter, "help", "") or ""]
            for parameter in command.params
            if parameter.name != "help"
        ]
        lines += [f"## gablework {name}", "", (command.help or "").strip(), ""]
        lines += [*table(["option", "default", "meaning"], rows), ""]
    return "\n".join(lines)


def settings() -> str:
    """The page of settings."""
    lines = [NOTE, "# Settings", ""]
    lines += [
        "A settings file is TOML, one table a stage; every value has a default, an unknown or wrong one is refused, all faults at once.",
        "Values that cannot change results (marked *no* under *geometry*) are not part of the `settings_hash`.",
        "",
    ]
    for section, rows in sections().items():
        lines += [f"## {section}", "", *table(["setting", "default", "unit", "allowed", "geometry", "meaning"], rows), ""]
    return "\n".join(lines)


def sections() -> dict[str, list[list[object]]]:
    """Rows of the settings page by section."""
    found: dict[str, list[list[object]]] = {}
    for row in RunSettings.describe():
        found.setdefault(row.section, []).append(
            [f"`{row.name}`", f"`{row.default}`", row.unit, row.allowed, "yes" if row.changes_geometry else "no", row.doc]
        )
    return found


PAGES: Mapping[str, Callable[[], str]] = {
    "settings.md": settings,
    "command_line.md": command_line,
    "exit_codes.md": exit_codes,
}
"""The generated pages by file name."""


def main() -> None:
    """Write all pages."""
    for name, render in PAGES.items():
        (REFERENCE / name).write_text(render(), encoding="utf-8")
        print(f"wrote docs/reference/{name}")


if __name__ == "__main__":
    main()
