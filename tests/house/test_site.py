"""The site takes its navigation from docs/index.md, and its links lead on."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = {"README.md": "index.md", "docs/index.md": "pages.md", "docs/how_to/a.md": "how_to/a.md", "docs/b.md": "b.md"}


@pytest.fixture(scope="module")
def site() -> ModuleType:
    """docs/site.py as a module."""
    spec = importlib.util.spec_from_file_location("build_site", ROOT / "docs" / "site.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_index_lists_every_page_once(site: ModuleType, tmp_path: Path) -> None:
    site.write(tmp_path)
    assert (tmp_path / "docs" / "index.md").read_text().startswith("# gablework")


def test_a_page_that_the_index_does_not_list_is_named(
    site: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = ROOT / "docs" / "lost.md"
    files = {**site.sources(), "docs/lost.md": "lost.md"}
    read = Path.read_text
    monkeypatch.setattr(site, "sources", lambda: files)
    monkeypatch.setattr(Path, "read_text", lambda path, *args: "# Lost\n" if path == lost else read(path, *args))
    with pytest.raises(SystemExit, match=r"for: lost\.md$"):
        site.write(tmp_path)


def test_sections_and_groups_follow_the_index(site: ModuleType) -> None:
    index = "# All\n\n[B](b.md)\n\n## One\n\n- Named: [a](how_to/a.md), [web](https://a.org)\n\n## None\n\n- A: B.\n"
    assert site.navigation(index, FILES) == [
        "index.md",
        "pages.md",
        {"One": [{"Named": ["how_to/a.md"]}]},
        "b.md",
        "contributing.md",
    ]
    assert site.navigation("# All\n\n## One\n\n- [a](how_to/a.md), [b](b.md)\n", FILES)[2] == {
        "One": ["how_to/a.md", "b.md"]
    }


@pytest.mark.parametrize(
    ("link", "on_the_site"),
    [
        ("[b](../b.md#an-anchor)", "[b](../b.md#an-anchor)"),
        ("[r](../../README.md)", "[r](../index.md)"),
        ("[all](../index.md)", "[all](../pages.md)"),
        ("[`x`](../../pipeline/scene.py)", "`x`"),
        ("[web](https://a.org/b.md)", "[web](https://a.org/b.md)"),
        ("[here](#an-anchor)", "[here](#an-anchor)"),
        ("```\n[r](../../README.md)\n```", "```\n[r](../../README.md)\n```"),
    ],
)
def test_links_lead_to_pages_of_the_site(site: ModuleType, link: str, on_the_site: str) -> None:
    assert site.with_links_of_the_site(link, "docs/how_to/a.md", FILES) == on_the_site


@pytest.mark.parametrize("link", ["[gone](../gone.md)", "![gone](pictures/gone.png)", "[`x`](../../pipeline/gone.py)"])
def test_a_link_that_leads_nowhere_is_named(site: ModuleType, link: str) -> None:
    with pytest.raises(SystemExit, match=r"^docs/how_to/a\.md: \S*gone\.\w+ leads nowhere$"):
        site.with_links_of_the_site(link, "docs/how_to/a.md", FILES)


def test_lists_are_indented_by_four_and_items_after_a_paragraph_have_a_blank_line(site: ModuleType) -> None:
    text = "1. one\n\n   ```sh\n     deep\n   ```\n\n   more\n   - inner\n     lines\n2. two\n\nEnd\n"
    deep = "1. one\n\n    ```sh\n      deep\n    ```\n\n    more\n\n    - inner\n        lines\n2. two\n\nEnd\n"
    assert site.with_deep_lists(text) == deep


def test_a_notebook_becomes_a_page(site: ModuleType) -> None:
    cells = '[{"cell_type": "markdown", "source": ["# T\\n", "x"]}, {"cell_type": "code", "source": ["a = 1"]}]'
    page = site.notebook_page(f'{{"cells": {cells}}}', "t.ipynb")
    assert page.startswith("# T\nx\n\n```python\na = 1\n```\n")
    assert 'href="t.ipynb"' in page
