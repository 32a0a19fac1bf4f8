"""Rewrites messages of the engine: keys of the batch file in place of options of the command line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from pipeline.errors import GableworkError, InputError, SettingsError
from pipeline.options import all_options
from pipeline.renaming import Renaming

as_keys = Renaming(
    (
        (one, f"[{one.meta['table']}] {one.name}{' = true' if one.type is bool else ''}")
        for one in all_options()
        # the engine names the scheduler for workers, which have no batch file
        if one.meta["table"] and one.name != "scheduler"
    ),
    {
        "--out": "[output] path",
        "--overwrite": "[output] overwrite = true",
        "--crs EPSG:n": '[inputs] crs = "EPSG:n"',
        "--workers 1": "[cluster] workers = 1",
    },
)
"""A message with keys in place of options."""


@contextlib.contextmanager
def errors_with_keys() -> Iterator[None]:
    """Rewrite the errors of the block: they name keys in place of options."""
    try:
        yield
    except InputError as error:
        error.problem, error.fix = as_keys(error.problem), as_keys(error.fix)
        error.args = (as_keys(str(error)),)
        raise
    except SettingsError as error:
        error.faults = tuple(as_keys(fault) for fault in error.faults)
        error.args = (as_keys(str(error)),)
        raise
    except GableworkError as error:
        error.args = (as_keys(str(error)),)
        raise
