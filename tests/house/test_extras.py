"""Extras: each is a folder that says what it is. Modules that are named in texts are there."""

import importlib
from collections.abc import Callable
from pathlib import Path

import pytest

import pipeline.extras
from pipeline.registry import EXTRAS, extra
from pipeline.runtime.cluster.worker_setup import STAGES
from pipeline.runtime.isolation.preloading import loads_of

FOLDERS = sorted(path for path in Path(pipeline.extras.__file__).parent.iterdir() if list(path.glob("*.py")))


@pytest.mark.parametrize("name", EXTRAS)
def test_what_the_core_asks_for_by_name_is_there(name: str) -> None:
    assert isinstance(extra(name), Callable)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_each_extra_says_what_it_adds_and_where_it_enters(folder: Path) -> None:
    readme = (folder / "README.md").read_text()
    assert readme.startswith("# ")
    assert "\nEntry: " in readme


def test_the_table_names_no_folder_that_is_not_an_extra() -> None:
    assert {place.partition(".")[0] for place in EXTRAS.values()} <= {folder.name for folder in FOLDERS}


def test_what_workers_and_children_load_ahead_is_there() -> None:
    loads = [*STAGES, *(load for job in ("reconstruct", "classify") for load in loads_of(job, footprints=True))]
    for load in loads:
        module, *name = load.split(":")
        assert hasattr(importlib.import_module(module), name[0] if name else "__name__"), load
