"""Options that several commands share, as text from a command line."""

from __future__ import annotations

import pytest
import typer
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.cli.options import worker_count


@pytest.mark.parametrize(("text", "workers"), [("auto", None), ("0", 0), ("3", 3), ("1024", 1024)])
def test_workers_are_a_number_or_left_to_the_estimate(text: str, workers: int | None) -> None:
    assert worker_count(text) == workers


@pytest.mark.parametrize("text", ["many", "", "-1", "1.5", "1025", "AUTO", "²"])
def test_workers_that_are_no_number_are_named_with_what_to_use(text: str) -> None:
    with pytest.raises(typer.BadParameter) as raised:
        worker_count(text)
    assert str(raised.value) == f"{text!r}: use auto, or a whole number from 0 to 1024"


@pytest.mark.parametrize(
    "words",
    [
        ("reconstruct", "a.laz", "--out", "run"),
        ("rerun", "run"),
        ("compare", "a.laz", "--methods", "kmeans", "--out", "out"),
        ("classify", "a.laz", "--out", "out"),
        ("demo",),
    ],
    ids=lambda words: words[0],
)
def test_every_command_with_workers_refuses_what_is_no_number(words: tuple[str, ...]) -> None:
    ended = CliRunner().invoke(app, [*words, "--workers", "many"])
    assert ended.exit_code == 2
    assert "'many': use auto, or a whole number from 0 to 1024" in " ".join(ended.stderr.split())
