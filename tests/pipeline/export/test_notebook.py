"""The notebook and the questions of the tutorials run on a run directory."""

import json
import re
from pathlib import Path

import pytest
from checkout import ROOT
from small_runs import street, write_run

TUTORIALS = ROOT / "docs" / "tutorials"
NOTEBOOK = TUTORIALS / "read_a_run.ipynb"


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run directory `models` in the current folder."""
    monkeypatch.chdir(tmp_path)
    return write_run(tmp_path / "models", street())


def cells() -> list[str]:
    """The code of the notebook, cell by cell."""
    return [
        "".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"
    ]


def run_all(parts: list[str]) -> dict[str, object]:
    """What some pieces of code leave in one namespace."""
    names: dict[str, object] = {"__name__": "__main__"}
    for number, part in enumerate(parts):
        exec(compile(part, f"part {number}", "exec"), names)
    return names


def test_the_notebook_reads_a_run(models: Path) -> None:
    import matplotlib.pyplot as plt

    plt.switch_backend("agg")
    names = run_all(cells())
    plt.close("all")
    assert sorted(names["buildings"]["status"]) == ["failed", "fallback", "ok", "ok"]  # type: ignore[index]
    assert len(names["delivered"]) == 2  # type: ignore[arg-type]
    assert names["planes"].count_rows() > 0  # type: ignore[attr-defined]


def test_the_notebook_holds_no_outputs() -> None:
    code = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []


def test_the_questions_of_the_tutorial_have_answers(models: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = (TUTORIALS / "query_in_duckdb.md").read_text()
    (block,) = re.findall(r"^ *```python\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    run_all([re.sub(r"^ {3}", "", block, flags=re.MULTILINE)])
    printed = capfd.readouterr().out
    assert {"gable", "south_m2", "vegetation"} <= set(re.findall(r"\w+", printed)), printed
