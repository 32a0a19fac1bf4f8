"""Rewrites messages of the engine: keys of the batch file in place of options of the command line."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping

from pipeline.errors import GableworkError, InputError, SettingsError

KEYS: Mapping[str, str] = {
    "--out": "[output] path",
    "--overwrite": "[output] overwrite = true",
    "--bbox": "[inputs] bbox",
    "--aoi": "[inputs] aoi",
    "--crs EPSG:n": '[inputs] crs = "EPSG:n"',
    "--crs": "[inputs] crs",
    "--vertical-unit": "[inputs] vertical_unit",
    "--allow-outside-area-of-use": "[inputs] allow_outside_area_of_use = true",
    "--footprints": "[inputs] footprints",
    "--layer": "[inputs] footprints_layer",
    "--guides": "[inputs] guides",
    "--workers 1": "[cluster] workers = 1",
    "--workers": "[cluster] workers",
    "--tls-ca": "[cluster] tls_ca",
    "--tls-cert": "[cluster] tls_cert",
    "--tls-key": "[cluster] tls_key",
    "--input-timeout": "[cluster] input_timeout_s",
    "--building-timeout": "[cluster] building_timeout_s",
    "--building-memory": "[cluster] building_memory_gib",
}
"""Keys by option. `--scheduler` is missing: the engine names it for workers, which have no batch file."""

_OPTION = re.compile("|".join(rf"{re.escape(option)}(?![\w-])" for option in sorted(KEYS, key=len, reverse=True)))


def as_keys(text: str) -> str:
    """A message with keys in place of options.

    >>> as_keys("a.laz is not empty: give another --out, or --overwrite")
    'a.laz is not empty: give another [output] path, or [output] overwrite = true'
    >>> as_keys("start it with --tls-ca-file")
    'start it with --tls-ca-file'
    """
    return _OPTION.sub(lambda found: KEYS[found.group()], text)


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
