"""Builds the documentation as web pages into build/docs/site by Zensical; `make site` runs it.

The pages are those of docs/, the README as the first one, CONTRIBUTING and the notices. docs/index.md is the
navigation: a section per heading, a group per list item that begins with its name and a colon, and all pages that are
linked there. A broken link, a broken anchor or a page that the index does not list ends the build.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build" / "docs"
"""The pages with links of the site in `docs/`, the built site in `site/`."""
SETTINGS = "zensical.yml"
"""Zensical's settings, written as JSON, which is YAML."""
MOVED = {
    "README.md": "index.md",
    "docs/index.md": "pages.md",
    "CONTRIBUTING.md": "contributing.md",
    "THIRD_PARTY_NOTICES.md": "notices.md",
}
"""Pages of the repository with another name on the site."""
FIRST = ("index.md", "pages.md")
LAST = ("contributing.md",)
"""Pages before all others and after them. Those that the index names above its sections come after the sections."""
KINDS = {".md", ".png", ".ipynb", ".js", ".css"}
"""Files of docs/ that go to the site."""
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^ *```")


def sources() -> dict[str, str]:
    """The files of the site: their paths in the repository and on the site, with slashes."""
    docs = ROOT / "docs"
    files = [path.relative_to(ROOT).as_posix() for path in sorted(docs.rglob("*")) if path.suffix in KINDS]
    return {name: MOVED.get(name, name.removeprefix("docs/")) for name in (*MOVED, *files)}


def page_of(name: str) -> str:
    """The page on the site of a file of the site: a notebook is shown on one."""
    return str(PurePosixPath(name).with_suffix(".md")) if name.endswith(".ipynb") else name


def with_links_of_the_site(text: str, source: str, files: dict[str, str]) -> str:
    """The Markdown of a page with links as the site has them.

    A link to a file that is in the repository and not on the site, such as a module, becomes its text. Zensical
    checks anchors and links, and overlooks missing pictures.

    Parameters
    ----------
    source : str
        Path of the page in the repository.
    files : dict of str to str
        `sources()`.

    Raises
    ------
    SystemExit
        A link leads to no file of the repository.
    """
    here = PurePosixPath(files[source]).parent

    def linked(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        path, hash_mark, anchor = target.partition("#")
        if "://" in target or not path:
            return match[0]
        found = os.path.normpath(PurePosixPath(source).parent / path)
        if found in files:
            new = os.path.relpath(page_of(files[found]), here)
            return f"{mark}[{words}]({new}{hash_mark}{anchor})"
        if not (ROOT / found).exists():
            sys.exit(f"{source}: {target} leads nowhere")
        return words

    parts, code = [], False
    for line in text.splitlines(keepends=True):
        code ^= bool(FENCE.match(line))
        parts.append(line if code else LINK.sub(linked, line))
    return "".join(parts)


def with_deep_lists(text: str) -> str:
    """Markdown as Python-Markdown wants it: lists are indented by four, and an item after a paragraph has a blank line.

    The pages are CommonMark, which takes less.
    """
    lines, starts, code, paragraphs = [], [], False, False
    for line in text.splitlines():
        words = line.lstrip(" ")
        indent = len(line) - len(words)
        while not code and words and starts and indent < starts[-1]:
            starts.pop()
        here = starts[-1] if starts else 0
        item = None if code else re.match(r"([-*]|\d+\.) +", words)
        if item and paragraphs and lines[-1]:
            lines.append("")
        paragraphs = not item and (paragraphs or not words)
        lines.append(f"{' ' * (4 * len(starts) + max(indent - here, 0))}{words}" if words else "")
        code ^= words.startswith("```")
        if item:
            starts.append(indent + item.end())
    return "\n".join([*lines, ""])


def notebook_page(text: str, name: str) -> str:
    """A notebook as Markdown: its text and its code; the outputs are not stored.

    Parameters
    ----------
    text : str
        The notebook, as JSON.
    name : str
        Its file's name, offered for download.
    """
    cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]]
    parts = [source if kind == "markdown" else f"```python\n{source}\n```" for kind, source in cells]
    return "\n\n".join([*parts, f'<a href="{name}" download>Download this notebook</a>', ""])


def navigation(index: str, files: dict[str, str]) -> list[Any]:
    """The navigation of the site, as Zensical takes it: pages by path, and sections as tables with one list.

    Parameters
    ----------
    index : str
        The Markdown of docs/index.md.
    files : dict of str to str
        `sources()`.
    """
    sections: list[Any] = []
    for title, body in re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", index, re.MULTILINE | re.DOTALL):
        entries: list[Any] = []
        for item in re.split(r"^- ", body, flags=re.MULTILINE):
            pages = list(_pages(item, files))
            group = re.match(r"([^:\[\]]+):", item)
            entries += [{group[1]: pages}] if group and pages else pages
        if entries:
            sections.append({title: entries})
    return [*FIRST, *sections, *_pages(index.partition("\n## ")[0], files), *LAST]


def _pages(text: str, files: dict[str, str]) -> Iterator[str]:
    for _, _, target in LINK.findall(text):
        found = os.path.normpath(PurePosixPath("docs") / target)
        if found in files:
            yield page_of(files[found])


def listed(entries: list[Any]) -> Iterator[str]:
    """All pages of a navigation."""
    for entry in entries:
        if isinstance(entry, dict):
            for below in entry.values():
                yield from listed(below)
        else:
            yield entry


def write(folder: Path) -> None:
    """Write the pages and Zensical's settings into a folder.

    Raises
    ------
    SystemExit
        docs/index.md does not list a page, or lists it twice; or a link leads nowhere.
    """
    files = sources()
    for source, name in files.items():
        path = folder / "docs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            path.write_text(with_deep_lists(with_links_of_the_site((ROOT / source).read_text(), source, files)))
        else:
            shutil.copyfile(ROOT / source, path)
        if path.suffix == ".ipynb":
            path.with_suffix(".md").write_text(notebook_page(path.read_text(), path.name))
    tree = navigation((ROOT / "docs" / "index.md").read_text(), files)
    found = sorted(listed(tree))
    pages = sorted({page_of(name) for name in files.values() if page_of(name).endswith(".md")})
    if found != pages:
        differ = sorted(set(found) ^ set(pages)) or sorted({name for name in found if found.count(name) > 1})
        sys.exit(f"docs/index.md must list every page once, which it does not for: {', '.join(differ)}")
    settings = tomllib.loads((ROOT / "docs" / "zensical.toml").read_text())["project"]
    (folder / SETTINGS).write_text(json.dumps(settings | {"nav": tree, "site_dir": "site"}))


def build() -> None:
    """Build the site. What an earlier build left is replaced.

    Raises
    ------
    SystemExit
        Zensical is not installed, or there is a broken link or anchor.
    """
    zensical = Path(sys.executable).with_name("zensical")
    if not zensical.is_file():
        sys.exit(f"{zensical} is missing: run make site, which installs it")
    shutil.rmtree(BUILD, ignore_errors=True)
    write(BUILD)
    built = subprocess.run([zensical, "build", "--strict", "--config-file", BUILD / SETTINGS], check=False)  # noqa: S603 - our own words
    if built.returncode:
        shutil.rmtree(BUILD / "site", ignore_errors=True)
        sys.exit("the pages have the faults above")


if __name__ == "__main__":
    build()
