"""Writes the pages of docs/reference/ that can be generated from the code.

`make docs` runs it; tests/house/test_docs.py fails if a page differs from the code.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import typer

from pipeline.batch.batch_file import TABLES
from pipeline.cli import command_line as built
from pipeline.console import EXIT_CODES
from pipeline.export.columns import COLUMNS, KINDS, TILE_COLUMN, Column
from pipeline.extras.party_walls import party_wall_tables
from pipeline.extras.publish_gis import geopackage, pmtiles
from pipeline.extras.solar import solar_table
from pipeline.methods import METHODS
from pipeline.model import Reason
from pipeline.parameters import Parameters
from pipeline.quality import validity as checker
from pipeline.reasons import REASONS
from pipeline.ruler.epochs import change_records as changes_of
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.evaluation.chapters import TITLES
from pipeline.ruler.evaluation.definitions import DEFINITIONS
from pipeline.settings import SECTIONS, GeneralSettings
from pipeline.terrain.candidates import REASON_OF_FAULT
from service.cli import COMMANDS

USUAL = ("400", "401", "403", "404", "422", "429", "500", "503")
"""Answers that most paths give, and that the table of paths leaves out."""
REFERENCE = Path(__file__).resolve().parent / "reference"
NOTE = "<!-- Written by `make docs` from the code; do not edit. -->"

TITLES_OF_TABLES = {layer.name: f"{layer.description}." for layer in geopackage.LAYERS}
FORMATS = {"GeoPackage": "geopackage", "CityJSON": "cityjson", "PMTiles": "pmtiles"}
NOTES_OF_FORMATS = [
    "- GeoPackage has no `bbox`, which the spatial index replaces, and no columns of solids, since a layer has one",
    "  geometry. `geometry` is a MultiPolygon in each layer, a single Polygon too; a MultiPolygon Z in `planes`.",
    "  `decisions` has no geometry. Each column holds its meaning as a comment (`gpkg_data_columns`). A text ends at",
    "  its first zero byte, times are cut to milliseconds.",
    "- CityJSON has the columns of `buildings` as attributes of each building, without `building_id` (the name of the",
    "  object), without columns of geometry and solids (its own geometry), and without those that are null.",
    "  `source_attributes` is an object. A plane has `plane_id`, `slope_deg` and `aspect_deg` at its semantic surface.",
    "- PMTiles have the columns of `buildings` without those of solids and without "
    + ", ".join(f"`{name}`" for name in pmtiles.LEFT_OUT)
    + ".",
    "  `int` and `double` are equal numbers; a double may be stored as an integer or a float that equals it. A null is",
    "  a property that is not there. JavaScript reads integers beyond 2^53 inexactly.",
]


def types_in(kind: str) -> list[str]:
    """What a type of the tables becomes in each of `FORMATS`."""
    return [getattr(KINDS[kind], name) for name in FORMATS.values()]


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
    """An option or argument as written on the command line."""
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    names = ", ".join(f"`{name}`" for name in [*parameter.opts, *parameter.secondary_opts])
    return names if parameter.is_flag or not parameter.metavar else f"{names} {parameter.metavar}"


def default_of(parameter: Any) -> str:
    """The default of an option, as written on the command line."""
    if parameter.required:
        return "required"
    shown = getattr(parameter, "show_default", None)
    if isinstance(shown, str):
        return f"`{shown}`"
    default = parameter.default
    return "" if default is None or default is False or default == () else f"`{default}`"


def commands(group: Any | None = None, prefix: str = "") -> dict[str, Any]:
    """The commands of the console script by their words, those of groups included."""
    found: dict[str, Any] = {}
    for name, command in (group or typer.main.get_command(built(COMMANDS))).commands.items():
        words = f"{prefix}{name}"
        is_group = hasattr(command, "commands")
        if is_group:
            found |= commands(command, f"{words} ")
        if not is_group or command.invoke_without_command:
            found[words] = command
    return dict(sorted(found.items()))


def first_name(row: tuple[str, str, str]) -> str:
    """The first name of an option, from its row."""
    return row[0].split()[0].rstrip(",")


def command_line() -> str:
    """The page of the command line."""
    header = ["option", "default", "meaning"]
    rows = {
        name: [
            (option_names(parameter), default_of(parameter), getattr(parameter, "help", "") or "")
            for parameter in command.params
            if parameter.name != "help"
        ]
        for name, command in commands().items()
    }
    counts = Counter(row for found in rows.values() for row in found if row[0].startswith("`--"))
    # of the meanings of one option, only the most frequent is shared
    often = {first_name(row): row for row, count in sorted(counts.items(), key=lambda item: item[1]) if count > 1}
    shared = sorted(often.values())
    lines = [NOTE, "# The command line", ""]
    lines += ["`gablework COMMAND --help` prints the same. How commands end: [exit codes](exit_codes.md).", ""]
    for name, command in commands().items():
        lines += [f"## gablework {name}", "", (command.help or "").strip(), ""]
        own = [row for row in rows[name] if row not in shared]
        others = [first_name(row) for row in rows[name] if row in shared]
        lines += [*table(header, [list(row) for row in own]), ""] if own else []
        lines += [f"[Shared options](#shared-options): {', '.join(others)}.", ""] if others else []
    lines += ["## Shared options", "", "Options that mean the same in several commands.", ""]
    lines += [*table(header, [list(row) for row in shared]), ""]
    return "\n".join(lines)


def allowed(field: dataclasses.Field[Any]) -> str:
    """The values that a setting accepts."""
    choices, low, high = (field.metadata[key] for key in ("choices", "minimum", "maximum"))
    if choices is not None:
        return ", ".join(f"`{choice}`" for choice in choices)
    if isinstance(field.default, bool):
        return "`true`, `false`"
    if low is None and high is None:
        return "any"
    if isinstance(field.default, str):
        return f"`{field.default}`, or {low:g} to {high:g}"
    if high is None:
        return f"{low:g} or more"
    return f"up to {high:g}" if low is None else f"{low:g} to {high:g}"


def allowed_with_unit(field: dataclasses.Field[Any]) -> str:
    """The values that a setting accepts, with their unit."""
    values, unit = allowed(field), field.metadata["unit"]
    return f"{values} {unit}".rstrip() if values != "any" else ", ".join(filter(None, (values, unit)))


def toml(value: object) -> str:
    """A default as TOML writes it."""
    if isinstance(value, tuple):
        value = list(value)
    return f"`{str(value).lower()}`" if isinstance(value, bool) else f"`{value!r}`".replace("'", '"')


def sections() -> dict[str, list[list[object]]]:
    """Rows of the settings page by table of the settings file."""
    kinds: dict[str, type[Parameters]] = {"settings": GeneralSettings}
    kinds |= {f"settings.{name}": kind for name, kind in SECTIONS.items()}
    kinds |= {f"settings.{name}": entry.settings_type for name, entry in METHODS.items()}
    return {
        name: [
            [
                f"`{field.name}`",
                toml(field.default),
                allowed_with_unit(field),
                field.metadata["doc"] + ("" if field.metadata["changes_geometry"] else " (not hashed)"),
            ]
            for field in dataclasses.fields(kind)
        ]
        for name, kind in kinds.items()
    }


def settings() -> str:
    """The page of settings."""
    lines = [
        NOTE,
        "# Settings",
        "",
        "A settings file is TOML with a table `[settings]` and one table per stage below it; it holds only changes.",
        "An unknown name or a value out of range is refused before anything runs, all faults at once:",
        "",
        "```toml",
        "[settings]",
        'method = "fuzzy-sart"',
        "",
        "[settings.candidates]",
        "min_area_m2 = 15.0",
        "```",
        "",
        "*Not hashed* marks values that cannot change geometry; they are not part of the `settings_hash`.",
        "",
    ]
    header = ["setting", "default", "allowed", "meaning"]
    for name, rows in sections().items():
        lines += [f"## [{name}]", "", *table(header, rows), ""]
    return "\n".join(lines)


def validity() -> str:
    """The page of validity codes: those of the checker's own docstring."""
    codes = re.findall(r"^(\d{3})  +(.+)$", checker.__doc__ or "", re.MULTILINE)
    tolerances: list[list[object]] = [
        [f"`{field.name}`", toml(field.default), field.metadata["unit"], field.metadata["doc"]]
        for field in dataclasses.fields(checker.ValidityTolerances)
    ]
    lines = [
        NOTE,
        "# Validity",
        "",
        "Every solid is judged after its coordinates were rounded to 1 mm, by the rules of ISO 19107 as Ledoux (2013)",
        "and val3dity number them. A solid that breaks one is not delivered: simpler and finer forms of it are tried,",
        "then a labelled LoD1.2 block replaces it, or the candidate is `failed`. The record keeps the faults",
        "(`validity_codes`).",
        "",
        *table(["code", "fault"], [[code, fault] for code, fault in codes]),
        "",
        "The tolerances are val3dity's ([its last report](../results/validators.md)):",
        "",
        *table(["tolerance", "value", "unit", "meaning"], tolerances),
    ]
    return "\n".join(lines) + "\n"


def paths() -> list[list[object]]:
    """Rows of the table of paths."""
    from service.app import create_app
    from service.settings import ServiceSettings

    rows: list[list[object]] = []
    for path, item in create_app(ServiceSettings()).openapi()["paths"].items():
        for method, operation in item.items():
            needs_key = "yes" if "security" in operation else "no"
            answers = ", ".join(status for status in operation["responses"] if status not in USUAL)
            rows.append([f"`{method.upper()} {path}`", operation["summary"], needs_key, answers])
    return rows


def service_settings() -> list[list[object]]:
    """Rows of the table of the service's settings."""
    from service.settings import ServiceSettings

    rows: list[list[object]] = []
    for name, field in ServiceSettings.model_fields.items():
        default = (
            "the user's data folder" if name == "state" else "" if field.default in (None, (), "") else field.default
        )
        rows.append([f"`GABLEWORK_{name.upper()}`", default, field.description])
    return rows


def outputs() -> list[list[object]]:
    """Rows of the table of outputs."""
    from service.outputs.kinds import CLASSIFICATION_OUTPUTS, COMPARISON_OUTPUTS, OUTPUTS

    kinds = {"reconstruct": OUTPUTS, "compare": COMPARISON_OUTPUTS, "classify": CLASSIFICATION_OUTPUTS}
    return [
        [process, f"`{kind.output_id}`", f"`{kind.media_type}`", f"`{kind.filename}`", kind.title]
        for process, found in kinds.items()
        for kind in found.values()
    ]


def service() -> str:
    """The page of the service: paths, outputs, problems, keys, settings."""
    from service.keys import Scope
    from service.problems import FAILURES, FOREIGN, INTERNAL, KINDS
    from service.routes.landing import CLASSES

    kinds = {(kind.status, kind.type_uri, kind.title) for kind in (*KINDS.values(), FOREIGN, INTERNAL)}
    problems: list[list[object]] = [[status, f"`{uri}`", title] for status, uri, title in sorted(kinds)]
    failures: list[list[object]] = [
        [f"`{fault}`", kind.title, kind.status, f"`{kind.type_uri}`"] for fault, kind in FAILURES.items()
    ]
    scopes: list[list[object]] = [[f"`{scope}`", ", ".join(sorted(scope.included))] for scope in Scope]
    lines = [
        NOTE,
        "# The service",
        "",
        "It speaks OGC API - Processes 1.0 and OGC API - Features. `/openapi.json` (OpenAPI 3.0) has every",
        "parameter and answer, `/docs` the same for people. How to run it: [serve](../how_to/serve.md).",
        "",
        "## Paths",
        "",
        "*Key* says whether a key is needed if the service has keys. *Answers* leaves out those that most paths give:",
        f"{', '.join(USUAL)}.",
        "",
        *table(["path", "what it does", "key", "answers"], paths()),
        "",
        "## Outputs",
        "",
        "The results of a job, by process: [how to get them](../how_to/results_by_rest.md). `/processes/{processID}`",
        "describes each one.",
        "",
        *table(["process", "output", "media type", "file", "content"], outputs()),
        "",
        "## Conformance",
        "",
        *(f"- `{uri}`" for uri in CLASSES),
        "",
        "## Problems",
        "",
        "Every error is a problem document (`application/problem+json`, RFC 9457) with `type`, `title`, `status`,",
        "`detail` and `instance`. If there can be several faults, `errors` has one sentence per fault. Statuses",
        "of HTTP itself (405, 406, 415, 416, an unknown path) have the type `about:blank`. 429 and 503 have",
        "`Retry-After`.",
        "",
        *table(["status", "type", "title"], problems),
        "",
        "## Results of a failed job",
        "",
        "`/jobs/{jobID}/results` of a job that failed answers with the status that fits the cause; the same document",
        "is the `exception` of the job's status.",
        "",
        *table(["cause", "title", "status", "type"], failures),
        "",
        "## Keys",
        "",
        "`gablework keys create` makes one; it is sent as `Authorization: Bearer gw_...`.",
        "",
        *table(["scope", "holds"], scopes),
        "",
        "## Settings",
        "",
        "Environment variables; options of `gablework serve` and `gablework driver` override them. Lists are JSON.",
        "",
        *table(["variable", "default", "meaning"], service_settings()),
    ]
    return "\n".join(lines) + "\n"


def reasons() -> str:
    """The page of reasons: those of buildings, then those of rejected objects."""
    rejected = {*REASON_OF_FAULT.values(), Reason.STRIPS_DISAGREE, Reason.OVERRIDDEN}
    modelled = {Reason.TOO_FEW_POINTS, *Reason} - (rejected - {Reason.TOO_FEW_POINTS})

    def rows(chosen: set[Reason]) -> list[list[object]]:
        return [[f"`{reason.value}`", words.meaning] for reason, words in REASONS.items() if reason in chosen]

    lines = [
        NOTE,
        "# Reasons",
        "",
        "The list is closed; `reason_detail` has the figure and the threshold. [Records](records.md#status) has the",
        "statuses, [poisonous buildings](../how_to/poisonous_buildings.md) shows how to replay a bundle.",
        "",
        "## Buildings",
        "",
        "Why a candidate is `doubtful`, `fallback` or `failed`.",
        "",
        *table(["reason", "meaning"], rows(modelled)),
        "",
        "## Rejected objects",
        "",
        "Why an object is not a building.",
        "",
        *table(["reason", "meaning"], rows(rejected)),
    ]
    return "\n".join(lines) + "\n"


def measures() -> str:
    """The page of measures, from their definitions."""
    lines = [
        NOTE,
        "# Measures",
        "",
        "The measures of `gablework evaluate`, by chapter: [how to use it](../how_to/evaluate.md). Shares are of",
        "all reference buildings, faces or points unless the formula says otherwise. Intervals hold 95 % of 1000",
        "resamples of buildings, of blocks of 50 m where cells or ground points are counted, or of drawn outlines and",
        "blocks of outlines in the chapter of form (percentile bootstrap, Efron 1979); a share of 0 or 1 on which all",
        "units agree has the exact binomial limit instead (Clopper and Pearson 1934). If conditions are known, every",
        "figure is given for all buildings, for those without defects (*good*) and for those with defects (*hard*),",
        "except for form and wireframes. Buildings cut by the edge of the data are left out, except for points in",
        "outlines of the raster: in a dense town outlines touch, and the cut ones hold most points.",
        "",
        "The measures follow F. Rottensteiner et al.: The ISPRS benchmark on urban object classification and 3D",
        "building reconstruction (2012), M. Rutzinger, F. Rottensteiner, N. Pfeifer: A comparison of evaluation",
        "techniques for building extraction from airborne laser scanning (2009), A. D. Hofmann, H.-G. Maas, A.",
        "Streilein (2003) for *correct*, *passable* and *false*, and G. Sithole, G. Vosselman: Experimental comparison",
        "of filter algorithms (2004) for the errors of ground filters.",
        "",
    ]
    for group, title in TITLES.items():
        rows: list[list[object]] = [
            [f"`{one.name}`", one.label, ", ".join(filter(None, (one.unit, str(one.better)))), one.formula]
            for one in DEFINITIONS.values()
            if one.group is group
        ]
        lines += [f"## {title}", "", *table(["measure", "what", "unit, better", "formula"], rows), ""]
    return "\n".join(lines)


def batch_file() -> str:
    """The page of the batch file."""
    lines = [
        NOTE,
        "# The batch file",
        "",
        "TOML, for `gablework batch`; how it is used: [city-scale batches](../how_to/batch.md). Paths are relative to",
        "the file. Beside these tables `[settings]` takes all [settings](settings.md) of a run. Unknown names and",
        "values out of range are refused before anything runs, all faults at once.",
    ]
    own: dict[str, list[list[object]]] = {
        "inputs": [
            ["`paths`", "required", "a list", "Files, folders or patterns of point clouds."],
            ["`bbox`", "none", "four numbers", "Only this rectangle: x_min, y_min, x_max, y_max in the CRS's units."],
        ]
    }
    for name, kind in TABLES.items():
        rows = own.get(name, []) + [
            [f"`{field.name}`", toml(field.default), allowed_with_unit(field), field.metadata["doc"]]
            for field in dataclasses.fields(kind)
        ]
        about = (kind.__doc__ or "").strip().split(": ", 1)[-1]
        lines += ["", f"## `[{name}]`", "", f"{about[:1].upper()}{about[1:]}", ""]
        lines += table(["key", "default", "allowed", "meaning"], rows)
    return "\n".join(lines) + "\n"


def setting_row(field: dataclasses.Field[Any]) -> list[object]:
    """A threshold of `gablework batch diff`."""
    return [f"`{field.name}`", toml(field.default), allowed_with_unit(field), field.metadata["doc"]]


def changes() -> str:
    """The page of changes: classes, columns, reasons, doubts, thresholds."""

    def words(meanings: Mapping[Any, str]) -> list[list[object]]:
        return [[f"`{word.value}`", meaning] for word, meaning in meanings.items()]

    columns: list[list[object]] = [
        [f"`{name}`", str(kind).replace("list<item: ", "list<").split("[")[0], meaning]
        for name, kind, meaning in changes_of.COLUMNS
    ]
    lines = [
        NOTE,
        "# Changes between two epochs",
        "",
        "The results of `gablework batch diff`: [how to use it](../how_to/compare_epochs.md). A row of",
        "`changes.parquet` is a building, or several that belong together because the epochs divide them differently.",
        "`changes.geojson` has the same columns as properties, `changes.json` the sums, warnings and thresholds.",
        "",
        "## Classes",
        "",
        *table(["`change`", "meaning"], words(changes_of.CHANGES)),
        "",
        "A building may be raised or lowered *and* reshaped: `is_raised`, `is_lowered` and `is_reshaped` are all set",
        "that apply, and `change` is the one that moved more volume.",
        "",
        "## Reasons",
        "",
        "Why a building is `not_comparable`. The list is closed; if there are several reasons, the first is given.",
        "",
        *table(["`reason`", "meaning"], words(changes_of.INCOMPARABLE)),
        "",
        "## Doubts",
        "",
        "Reasons why a verdict is less certain than others. The list is closed; a row may have several.",
        "",
        *table(["`doubts`", "meaning"], words(changes_of.DOUBTS)),
        "",
        "## Relations",
        "",
        *table(["`relation`", "meaning"], words(changes_of.RELATIONS)),
        "",
        "## Columns",
        "",
        "Columns that end in `_m`, `_m2`, `_m3` are metres whatever the CRS; geometry is in the CRS's own units.",
        "Figures of an epoch without a building there, and of models that do not exist, are null. A column `bbox`",
        "covers the geometry.",
        "",
        *table(["column", "type", "meaning"], columns),
        "",
        "## Thresholds",
        "",
        "The table `[diff]` of a `--settings` file; it holds only values that differ.",
        "",
        *table(
            ["setting", "default", "allowed", "meaning"],
            [setting_row(field) for field in dataclasses.fields(DiffSettings)],
        ),
    ]
    return "\n".join(lines) + "\n"


def column_rows(columns: Iterable[Column]) -> list[list[object]]:
    """Rows of a table of columns."""
    return [
        [
            f"`{one.name}`",
            str(one.kind).replace("list<item: ", "list<").split("[")[0],
            one.unit,
            "" if one.required else "yes",
            f"{one.meaning} ([more]({one.page}))" if one.page else one.meaning,
        ]
        for one in columns
    ]


def columns() -> str:
    """The page of columns: those of each table, and what their types become in each format."""
    lines = [
        NOTE,
        "# Columns",
        "",
        "The columns of every table of a run. A column has the same name and meaning in every format. What the tables",
        "are and how to read them: [records](records.md).",
        "",
        "**Units.** *CRS* is the horizontal unit of the run's CRS, *CRS, vertical* its vertical unit; some formats",
        "have [another unit for elevations](formats.md#crs-and-units). Metres are metres for any CRS. *Null* says",
        "whether a row may lack a value.",
    ]
    for name, columns_of_table in COLUMNS.items():
        lines += ["", f"## {name}", "", TITLES_OF_TABLES[name], ""]
        lines += table(["column", "type", "unit", "null", "meaning"], column_rows(columns_of_table))
    lines += [
        "",
        "## tile",
        "",
        "The folders of the tables carry this column in their names. A GeoPackage and PMTiles have it as a column.",
        "",
        *table(["column", "type", "unit", "null", "meaning"], column_rows([TILE_COLUMN])),
        "",
        "## Types in other formats",
        "",
        "GeoParquet holds the types as they are. The other formats lack some of them.",
        "",
        *table(
            ["type", *FORMATS],
            [[f"`{kind}`", *(getattr(types, name) for name in FORMATS.values())] for kind, types in KINDS.items()],
        ),
        "",
        *NOTES_OF_FORMATS,
    ]
    return "\n".join(lines) + "\n"


def solar() -> str:
    """The page of the columns of `gablework solar`."""
    lines = [
        NOTE,
        "# Solar energy of roof planes",
        "",
        "The table of `gablework solar`: [how to use it](../how_to/solar.md). A row is a roof plane; rows are ordered",
        "by tile, building and plane. Units and *null* are as in [columns](columns.md). A column `bbox` covers the",
        "geometry. The entry `gablework_solar` of the file's metadata holds the assumptions as JSON.",
        "",
        *table(["column", "type", "unit", "null", "meaning"], column_rows(solar_table.COLUMNS)),
    ]
    return "\n".join(lines) + "\n"


def party_walls() -> str:
    """The page of the columns of `gablework party-walls`."""
    header = ["column", "type", "unit", "null", "meaning"]
    lines = [
        NOTE,
        "# Party walls",
        "",
        "The tables of `gablework party-walls`: [how to use them](../how_to/party_walls.md). Units and *null* are as",
        "in [columns](columns.md). A column `bbox` covers the geometry. The entry `gablework_party_walls` of the",
        "files' metadata holds the tolerances as JSON.",
        "",
        "## Pairs of walls",
        "",
        "The file of `--out`. A row is a pair of walls that touch; rows are ordered by tile, building and face.",
        "",
        *table(header, column_rows(party_wall_tables.WALLS)),
        "",
        "## Buildings",
        "",
        "The file of `--buildings`. A row is a building with a model; rows are ordered by tile and building.",
        "",
        *table(header, column_rows(party_wall_tables.BUILDINGS)),
    ]
    return "\n".join(lines) + "\n"


VIEWER_WORDS = REFERENCE.parents[1] / "service" / "viewer" / "tests" / "words.json"
"""The words of the web page, for its own tests: the service puts them into the page."""


def viewer_words() -> str:
    """The words as JSON."""
    from service.page_words import page_words

    return json.dumps(page_words(), indent=1, ensure_ascii=False) + "\n"


PAGES: Mapping[str, Callable[[], str]] = {
    "settings.md": settings,
    "batch_file.md": batch_file,
    "command_line.md": command_line,
    "exit_codes.md": exit_codes,
    "validity.md": validity,
    "service.md": service,
    "measures.md": measures,
    "changes.md": changes,
    "columns.md": columns,
    "reasons.md": reasons,
    "solar.md": solar,
    "party_walls.md": party_walls,
}
"""The generated pages by file name."""


def main() -> None:
    """Write all pages."""
    for name, render in PAGES.items():
        (REFERENCE / name).write_text(render(), encoding="utf-8")
        print(f"wrote docs/reference/{name}")
    VIEWER_WORDS.write_text(viewer_words(), encoding="utf-8")
    print(f"wrote {VIEWER_WORDS.relative_to(REFERENCE.parents[1])}")


if __name__ == "__main__":
    main()
