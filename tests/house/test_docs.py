"""The docs say what the code says: settings, options, columns, reasons, commands and links."""

import dataclasses
import importlib.util
import re
import shlex
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from pipeline.batch.batch_file import read_batch
from pipeline.export.columns import COLUMNS
from pipeline.export.record_rows import SCHEMAS
from pipeline.extras.overrides.overrides_file import overrides_of
from pipeline.extras.papers.paper_settings import FuzzySartSettings
from pipeline.io import SpatialReference
from pipeline.model import Reason, RoofType, Status
from pipeline.parameters import Parameters
from pipeline.reasons import REASONS
from pipeline.roof.roof_settings import RoofSettings, RoofTypeSettings
from pipeline.ruler.epochs.epoch_settings import DiffSettings, read_settings
from pipeline.settings import RunSettings
from service.settings import ServiceSettings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    """docs/generate.py as a module."""
    spec = importlib.util.spec_from_file_location("generate_docs", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATED = (
    "settings.md",
    "batch_file.md",
    "command_line.md",
    "exit_codes.md",
    "validity.md",
    "service.md",
    "measures.md",
    "changes.md",
    "columns.md",
    "reasons.md",
    "solar.md",
    "party_walls.md",
)


@pytest.mark.parametrize("page", GENERATED)
def test_a_generated_page_is_what_the_code_says(generator: ModuleType, page: str) -> None:
    assert tuple(generator.PAGES) == GENERATED
    assert (DOCS / "reference" / page).read_text() == generator.PAGES[page](), "run make docs"


def test_the_words_for_the_tests_of_the_page_are_those_of_the_service(generator: ModuleType) -> None:
    assert generator.VIEWER_WORDS.read_text() == generator.viewer_words(), "run make docs"


def test_every_option_is_in_the_reference(generator: ModuleType) -> None:
    text = (DOCS / "reference" / "command_line.md").read_text()
    sections = dict(re.findall(r"^## gablework ([^\n]+)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL))
    assert set(sections) == set(generator.commands())
    for name, command in generator.commands().items():
        for parameter in command.params:
            if parameter.param_type_name == "option" and parameter.name != "help":
                assert f"`{parameter.opts[0]}`" in sections[name], f"{name} {parameter.opts[0]}"


def test_every_option_explains_itself(generator: ModuleType) -> None:
    silent = [
        f"{name} {parameter.name}"
        for name, command in generator.commands().items()
        for parameter in command.params
        if not getattr(parameter, "help", "")
    ]
    assert silent == []


def test_the_reference_says_defaults_that_are_words_and_all_values_of_numbers_that_may_be_a_word() -> None:
    lines = (DOCS / "reference" / "command_line.md").read_text().splitlines()
    workers = {line.split(" | ")[1] for line in lines if line.startswith("| `--workers` N\\|auto | ")}
    # commands of the pipeline have a default of their own, those of the service take what the environment says
    assert workers == {"`auto`", ""}
    assert '| `workers` | `"auto"` | `auto`, or 0 to 1024 |' in (DOCS / "reference" / "batch_file.md").read_text()


def test_every_setting_of_every_stage_is_in_the_reference(generator: ModuleType) -> None:
    text = (DOCS / "reference" / "settings.md").read_text()
    missing = [
        row[0] for rows in generator.sections().values() for row in rows if str(row[0]) not in text or not str(row[-1])
    ]
    assert missing == []


@pytest.mark.parametrize(
    ("page", "kind"),
    [("fuzzy_sart.md", FuzzySartSettings), ("solids.md", RoofSettings), ("solids.md", RoofTypeSettings)],
)
def test_a_page_of_methods_says_every_setting(page: str, kind: type[Parameters]) -> None:
    text = (DOCS / "methods" / page).read_text()
    assert [field.name for field in dataclasses.fields(kind) if f"`{field.name}" not in text] == []


@pytest.mark.parametrize("page", ["fuzzy_sart.md", "solids.md"])
def test_every_setting_that_a_page_names_exists(generator: ModuleType, page: str) -> None:
    known = {str(row[0]).strip("`") for rows in generator.sections().values() for row in rows}
    known |= {name for schema in SCHEMAS.values() for name in schema.names} | {reason.value for reason in Reason}
    values = {"unit_normal", "spherical_scaled", "all_planes"}
    text = (DOCS / "methods" / page).read_text()
    named = set(re.findall(r"`([a-z]+(?:_[a-z0-9]+)+)(?:: [a-z_]+)?`", text))
    assert named - known - values == set()


def toml_blocks(table: str | None = None) -> list[tuple[str, str]]:
    """Every toml block with a table, or with settings of a run, and its page."""
    return [
        (page.relative_to(ROOT).as_posix(), block)
        for page in PAGES
        for block in re.findall(r"^```toml\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
        if table == next((one for one in ("[[building]]", "[diff]", "[schedule]") if one in block), None)
    ]


@pytest.mark.parametrize("block", [block for _, block in toml_blocks("[schedule]")])
def test_times_of_the_docs_are_valid(block: str, tmp_path: Path) -> None:
    file = tmp_path / "city.toml"
    file.write_text(f'[inputs]\npaths = ["tiles"]\n[output]\npath = "models"\n{block}')
    assert read_batch(file).schedule.cron


@pytest.mark.parametrize(("page", "block"), toml_blocks())
def test_a_settings_file_of_the_docs_is_valid(page: str, block: str) -> None:
    settings = RunSettings.from_mapping(tomllib.loads(block)["settings"])
    if page == "docs/methods/fuzzy_sart.md":
        assert settings.building.method == FuzzySartSettings.faithful()


def test_the_thresholds_of_the_docs_are_valid(tmp_path: Path) -> None:
    blocks = toml_blocks("[diff]")
    assert blocks
    for _, block in blocks:
        path = tmp_path / "diff.toml"
        path.write_text(block)
        assert read_settings(str(path), {}) != DiffSettings()


def test_the_overrides_files_of_the_docs_are_valid() -> None:
    reference = SpatialReference()
    outlines = re.compile(r"footprint = \{[^}]*\}")
    found = []
    for _, block in toml_blocks("[[building]]"):
        document = tomllib.loads(outlines.sub('footprint = "POLYGON ((0 0, 1 0, 1 1, 0 0))"', block))
        found += overrides_of(document, reference, RunSettings())
    assert {entry.action for entry in found} == {None, "accept", "reject"}


def test_every_reason_status_and_roof_type_is_reported() -> None:
    reasons = re.findall(r"^\| `(\w+)` \|", (DOCS / "reference" / "reasons.md").read_text(), re.MULTILINE)
    assert set(reasons) == {reason.value for reason in Reason} == {reason.value for reason in REASONS}
    text = (DOCS / "reference" / "records.md").read_text()
    status = text.split("## Status")[1].split("## Support")[0]
    assert re.findall(r"^\| `(\w+)` \|", status, re.MULTILINE) == [entry.value for entry in Status]
    meaning = next(column.meaning for column in COLUMNS["buildings"] if column.name == "roof_type")
    assert all(f"`{kind.value}`" in meaning for kind in RoofType)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^a-z0-9 -]", "", h.lower()).replace(" ", "-") for h in headings}, target


def test_every_page_can_be_reached_from_the_readme() -> None:
    reached, open_pages = set(), [ROOT / "README.md"]
    while open_pages:
        page = open_pages.pop()
        reached.add(page)
        for target in re.findall(r"\]\(([^)#]+\.md)(?:#[^)]*)?\)", page.read_text()):
            path = (page.parent / target).resolve()
            if "://" not in target and path not in reached:
                open_pages.append(path)
    assert set(PAGES) - reached == set()


def shell_lines() -> list[tuple[str, str]]:
    """Every line of every sh block, with its page."""
    return [
        (page.relative_to(ROOT).as_posix(), line.split(" #")[0].strip())
        for page in PAGES
        for block in re.findall(r"^ *```sh\n(.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL)
        for line in block.replace("\\\n", " ").splitlines()
        if line.strip()
    ]


OTHER_PROGRAMS = {
    *("curl", "docker", ".venv/bin/dask", "kill", "export", "cp", "npm", "pipx", "python3"),
    *("reader/bin/pip", "reader/bin/python", "tested/bin/pip"),
}
"""First words of commands that are not ours and may stand in the docs."""


@pytest.mark.parametrize(("page", "line"), shell_lines())
def test_a_command_of_the_docs_is_one_that_exists(generator: ModuleType, page: str, line: str) -> None:
    words = shlex.split(line)
    while re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    if words[0] in OTHER_PROGRAMS:
        return
    if words[0] == "make":
        targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert [word for word in words[1:] if "=" not in word and word not in targets] == []
        return
    if words[:2] == [".venv/bin/python", "-m"]:
        assert (ROOT / (words[2].replace(".", "/") + ".py")).is_file(), f"{page}: {line}"
        return
    assert words[0] in {".venv/bin/gablework", "gablework"}, f"{page}: {line}"
    known = generator.commands()
    name = next(name for name in (" ".join(words[1:3]), words[1]) if name in known)
    context = known[name].make_context(name, words[1 + len(name.split()) :], resilient_parsing=False)
    assert context.params


def test_the_readme_says_the_two_commands_first() -> None:
    lines = [line for page, line in shell_lines() if page == "README.md"]
    assert lines[:2] == ["make demo", "make test"]


def test_every_variable_in_the_docs_is_read_somewhere() -> None:
    settings = {f"GABLEWORK_{name.upper()}" for name in ServiceSettings.model_fields}
    named = {name for page in PAGES for name in re.findall(r"\bGABLEWORK_[A-Z][A-Z_]*[A-Z]\b", page.read_text())}
    assert len(named & settings) > 30
    sources = [path for folder in ("pipeline", "service", "tests") for path in (ROOT / folder).rglob("*.py")]
    text = "\n".join(path.read_text() for path in [*sources, ROOT / "docker" / "entrypoint.py"])
    assert {name for name in named - settings if f'"{name}"' not in text} == set()
