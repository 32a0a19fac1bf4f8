"""The words of the web page that describe what the engine and the service define: the page gets them with its HTML."""

from __future__ import annotations

import functools
import json
from typing import Any

from pipeline.export.columns import BUILDINGS, COUNT, ELEVATIONS, SHARE, SHOWN
from pipeline.io.formats import POINT_SUFFIXES
from pipeline.options import served
from pipeline.reasons import REASONS
from pipeline.runtime.monitoring.stages import STAGES
from service.filenames import FOOTPRINT_SUFFIXES
from service.outputs.kinds import FORMATS, KINDS

UNITS = {SHARE: "%", COUNT: "", "m2": "m²", "m3": "m³", "1/m2": "per m²"}
"""Units on the page, where they differ; elevations are shown in metres."""


def page_words() -> dict[str, Any]:
    """The words, as `Tables` of `service/viewer/src/words/tables.ts`."""
    units = {column.name: UNITS.get(column.unit, column.unit) for column in BUILDINGS}
    elevations = ELEVATIONS["buildings"]
    return {
        "stages": [{"name": one.name, "words": one.does, "unit": one.unit, "of": one.of} for one in STAGES],
        "reasons": {reason: words.short for reason, words in REASONS.items()},
        "columns": {
            name: {
                "label": label,
                "unit": "m" if name in elevations else units[name],
                "digits": digits,
                "section": section,
                "isElevation": name in elevations,
            }
            for section, columns in SHOWN.items()
            for name, (label, digits) in columns.items()
        },
        "inputs": {one.input: one.meta["label"] for one in served(files=True) if one.type in (str, bool)}
        | {"publish": "Publish", "title": "Title"},
        "formats": {name: KINDS[outputs[0]].title for name, outputs in FORMATS.items()},
        "endings": {"tiles": ",".join(POINT_SUFFIXES), "vectors": ",".join(FOOTPRINT_SUFFIXES)},
    }


@functools.cache
def words_element() -> str:
    """The words as an element of the page, which its scripts read."""
    text = json.dumps(page_words(), ensure_ascii=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="words">{text}</script>'
