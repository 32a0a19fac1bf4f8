"""Rewrites messages of the engine for clients: inputs of a process in place of options of the command line.

The page writes the labels of its fields in place of these inputs (`service/viewer/src/words/fields.ts`).
"""

from __future__ import annotations

from pipeline.options import served
from pipeline.renaming import Renaming

as_inputs = Renaming(
    ((one, f"the input {one.input}") for one in served(files=True)),
    {"--crs EPSG:n": "the input crs", "--bbox and --aoi": "the input bbox"},
)
"""A message with inputs in place of options; clients do not meet messages with others."""
