"""No tracked text holds a word of the ban list in CONTRIBUTING."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIST = "CONTRIBUTING.md"
"""Defines the banned words, so it may hold them."""
BINARY = {".png", ".lock"}
QUOTED = {"LICENSE"}
"""Text of others."""
AS_OF = re.compile(r"\bas of (?!\d|version|today|now)", re.IGNORECASE)
"""`as of` before a date or a version is good English."""


def banned_words() -> list[str]:
    """The words of the table in CONTRIBUTING, without `as of`, which depends on what follows."""
    table = (ROOT / LIST).read_text().split("| banned | write |")[1].split("\n\n")[0]
    return re.findall(r"^\| (\w+) \|", table, re.MULTILINE)


def found_in(text: str) -> list[str]:
    """Lines with a banned word, as `number: line`."""
    banned = re.compile(rf"\b({'|'.join(banned_words())})\b", re.IGNORECASE)
    lines = enumerate(text.splitlines(), start=1)
    return [f"{number}: {line.strip()[:100]}" for number, line in lines if banned.search(line) or AS_OF.search(line)]


def tracked_texts() -> list[Path]:
    """All tracked text files except the list itself."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    names = [
        name for name in listed.stdout.splitlines() if Path(name).suffix not in BINARY and name not in {LIST, *QUOTED}
    ]
    return [ROOT / name for name in names if (ROOT / name).is_file() and (ROOT / name) != Path(__file__).resolve()]


def test_the_list_names_the_words() -> None:
    assert {"told", "whoever", "nobody", "somebody"} <= set(banned_words())


@pytest.mark.parametrize("text", ["It was TOLD.", "Whoever reads", "x = 1  # as of the run", "Nobody, somebody"])
def test_a_banned_word_is_found(text: str) -> None:
    assert found_in(text)


@pytest.mark.parametrize("text", ["stored", "as of 2026-01-01", "as of version 3", "told_counts"])
def test_other_words_pass(text: str) -> None:
    assert found_in(text) == []


def test_no_tracked_text_holds_a_banned_word() -> None:
    found = [f"{path.relative_to(ROOT)}:{line}" for path in tracked_texts() for line in found_in(path.read_text())]
    assert found == [], "\n".join(found)
