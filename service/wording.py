"""Rewrites messages of the engine for clients: inputs of a process in place of options of the command line.

The page writes the labels of its fields in place of these inputs (`service/viewer/src/words/fields.ts`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping

INPUTS: Mapping[str, str] = {
    "--crs EPSG:n": "the input crs",
    "--crs": "the input crs",
    "--vertical-unit": "the input verticalUnit",
    "--bbox and --aoi": "the input bbox",
    "--bbox": "the input bbox",
    "--footprints": "the input footprints",
    "--layer": "the input footprintsLayer",
    "--guides": "the input guides",
    "--classes": "the input classes",
    "--allow-outside-area-of-use": "the input allowOutsideAreaOfUse",
}
"""Inputs by option; clients do not meet messages with other options."""

_OPTION = re.compile("|".join(rf"{re.escape(option)}(?![\w-])" for option in sorted(INPUTS, key=len, reverse=True)))


def as_inputs(text: str) -> str:
    """A message with inputs in place of options.

    >>> as_inputs("no CRS: give --crs EPSG:n; or give --vertical-unit if it differs")
    'no CRS: give the input crs; or give the input verticalUnit if it differs'
    """
    return _OPTION.sub(lambda found: INPUTS[found.group()], text)
